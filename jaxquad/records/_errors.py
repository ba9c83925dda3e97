import difflib
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path

from jaxquad._core import marked_text, Message


class RecordError(ValueError):
    """A record that cannot be used: the message says what is wrong, the value and what to do."""

    def __init__(self, reason: str):
        super().__init__(Message(reason))


class ReadError(RecordError):
    """A file that cannot be read, and the byte `offset` where the fault shows, if known."""

    def __init__(self, reason: str, *, offset: int | None = None):
        self.reason, self.offset = marked_text(reason), offset
        where = "" if offset is None else f" (at byte {offset})"
        super().__init__(f"{self.reason.rstrip('.')}{where}.")


class GapError(RecordError):
    """Samples are missing for too long; `gaps` are first and last time in s of each, in order."""

    def __init__(self, reason: str, gaps: Sequence[tuple[float, float]] = ()):
        super().__init__(reason)
        self.gaps = tuple(gaps)


class RecordWarning(UserWarning):
    """A record can be used, but something in it was repaired, left out or looks wrong."""

    def __init__(self, reason: str):
        super().__init__(Message(reason))


def warn(reason: str) -> None:
    """Warn whoever called the function that says this."""
    warnings.warn(reason, RecordWarning, stacklevel=3)


def located(error: ReadError, path: Path | str) -> ReadError:
    """The same error, with the file named."""
    return ReadError(f"{path}: {error.reason}", offset=error.offset)


def unknown_name(name: str, channels: Iterable[str]) -> str:
    """What an error says of a `name` that is not among the `channels`, with the nearest."""
    channels = list(channels)
    names = {channel.lower(): channel for channel in channels}
    near = difflib.get_close_matches(name.lower(), names, n=1)
    guess = f" Did you mean {names[near[0]]!r}?" if near else ""
    return f"there is no channel {name!r}.{guess} The channels are: {listed(channels)}."


def choose_range(it: str) -> str:
    """Advice to leave a part of the data out."""
    return f"Choose a range without {it} («start=», «stop=»)« in jq.read, or cut the arrays»"


def mend_holes(it: str) -> str:
    """Advice where values are missing."""
    return f"{choose_range(it)}, or let gaps up to some length in s be interpolated («max_gap=»)."


def listed(names: Iterable[str]) -> str:
    """The names, separated by commas; of many, the first 40."""
    names = list(names)
    more = f", and {len(names) - 40} more" if len(names) > 40 else ""
    return f"{', '.join(names[:40]) or 'none'}{more}"


def printable(text: str) -> str:
    """Text from a file without terminal control characters, cut to 500 characters."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text[:500])
