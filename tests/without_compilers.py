"""A plugin of pytest (`-p without_compilers`) that blocks the import of `jaxquad._xla`."""

import sys


sys.modules["jaxquad._xla"] = None  # pyright: ignore[reportArgumentType]
