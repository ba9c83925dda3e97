"""What stderr shows while a command computes: stages, and a bar where there is a count."""

import argparse
import contextlib
import logging
import sys
import threading
from collections.abc import Iterator

from jaxquad._core import STAGES


def add_quiet(declared: argparse._ArgumentGroup) -> None:
    text = "do not show on stderr what is being done"
    declared.add_argument("--quiet", action="store_true", help=text)


@contextlib.contextmanager
def shown_stages(options: argparse.Namespace) -> Iterator[None]:
    """Within it, each stage that takes longer than 1 s is a line on stderr, without --quiet."""
    if vars(options).get("quiet", True):
        yield
        return
    shown, level = _Stages(), STAGES.level
    STAGES.addHandler(shown)
    STAGES.setLevel(logging.INFO)
    try:
        yield
    finally:
        STAGES.removeHandler(shown)
        STAGES.setLevel(level)
        shown.forget()


_PATIENCE = 1.0  # s


class _Stages(logging.Handler):
    """Prints the stage that runs once it has run for a second."""

    waiting: threading.Timer | None = None

    def emit(self, record: logging.LogRecord) -> None:
        self.forget()
        text = f"{record.getMessage()} ..."
        self.waiting = threading.Timer(_PATIENCE, print, [text], {"file": sys.stderr})
        self.waiting.daemon = True
        self.waiting.start()

    def forget(self) -> None:
        """The stage has ended."""
        if self.waiting is not None:
            self.waiting.cancel()


class ProgressBar:
    """A bar on a terminal, plain lines elsewhere, nothing if `quiet`."""

    def __init__(self, total: int, *, quiet: bool = False):
        from tqdm import tqdm

        self._bar = tqdm(total=total, unit="log", leave=False, disable=True if quiet else None)
        self.total, self.done, self.quiet = total, 0, quiet

    def advance(self, text: str) -> None:
        """One more is done; `text` says which."""
        self.done += 1
        plain = "".join(c if c.isprintable() else "?" for c in text)
        if not self._bar.disable:
            self._bar.set_postfix_str(plain, refresh=False)
            self._bar.update()
        elif not self.quiet:
            print(f"{self.done}/{self.total} {plain}", file=sys.stderr, flush=True)

    def close(self) -> None:
        self._bar.close()
