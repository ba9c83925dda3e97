"""How much a file may hold, decided on what it declares before any of that is read."""

from .._errors import ReadError


LARGEST = 4 * 2**30  # bytes of decoded arrays
_DENSEST = 250  # decoded bytes per byte of the file: real logs stay far below
_HARMLESS = 64 * 2**20  # bytes that any file may hold


def allowance(stored: int) -> int:
    """How many bytes `stored` ones may decode to."""
    return min(LARGEST, max(_HARMLESS, _DENSEST * stored))


def check_size(what: str, declared: int, stored: int, *, offset: int | None = None) -> None:
    """Raise ReadError where `declared` bytes from `stored` ones look like a bomb."""
    if declared > allowance(stored):
        raise ReadError(oversize(what, declared, stored), offset=offset)


def oversize(what: str, declared: int, stored: int) -> str:
    """The sentence for that error."""
    return (
        f"{what} declares {declared:.4g} bytes out of {stored:.4g} stored, above the limit of "
        f"{allowance(stored):.4g}: it is damaged, made to fill the memory, or to be cut in pieces"
    )
