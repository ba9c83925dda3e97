"""Progress of long work: a line on stderr that is written over, only on a terminal."""

import shutil
import sys
import time


class Bar:
    """How many of `total` are done, and how long the rest takes at this pace."""

    def __init__(self, total: int, *, shown: bool | None = None):
        self.total, self.done, self.start = total, 0, time.monotonic()
        self.shown = sys.stderr.isatty() if shown is None else shown

    def advance(self, text: str = "") -> None:
        """One more is done; `text` says which."""
        self.done += 1
        if self.shown:
            print(f"\r\x1b[K{self._line(text)}", end="", file=sys.stderr, flush=True)

    def close(self) -> None:
        """Clear the line."""
        if self.shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)

    def _line(self, text: str) -> str:
        spent = time.monotonic() - self.start
        left = spent / self.done * max(self.total - self.done, 0)
        full = 20 * self.done // max(self.total, 1)
        bar = f"[{'#' * full}{'.' * (20 - full)}]"
        line = f"{bar} {self.done}/{self.total}, {left:.0f} s left  {text}"
        plain = "".join(c if c.isprintable() else "?" for c in line)
        return plain[: shutil.get_terminal_size().columns - 1]
