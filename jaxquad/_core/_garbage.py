"""How often Python looks for garbage in a process that computes once, or one log after another."""

import atexit
import gc


_NEW = 500_000  # objects: an identification makes fewer that stay


def collect_seldom() -> None:
    """Look for garbage among half a million new objects, and not at the end of the process.

    Modules, traced functions and compiled programs stay to its end: to look for garbage among them
    takes a tenth of the time. Python's last look takes half a second. For processes that belong to
    jaxquad: importing it never sets this.
    """
    gc.set_threshold(_NEW, 10, 10)
    atexit.register(gc.freeze)
