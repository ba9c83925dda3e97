"""`jaxquad app`: a page of this machine on which a log is seen, tuned and compared.

It shows what the workflows compute, in a process of their own, and holds no mathematics.
"""

from ._server import serve as serve


__all__ = ["serve"]
