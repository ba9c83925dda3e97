"""Rows of numbers parsed by the million."""

import numpy as np
from jaxtyping import Bool, Float


_PLAIN = np.zeros(256, dtype=bool)
_PLAIN[list(b"0123456789+-.eEnNaAiIfF")] = True  # numbers, nan, inf


def parsed(
    block: bytes, separator: str | None, columns: int
) -> Float[np.ndarray, "rows columns"] | None:
    """The numbers of whole lines; None where they are not one plain number per cell."""
    block = block.rstrip(b"\n")
    if not block:
        return np.empty((0, columns))
    text = np.frombuffer(block, np.uint8)
    blank = (text == ord(" ")) | (text == ord("\t"))
    line_end = text == ord("\n")
    mark = np.zeros_like(blank) if separator is None else text == ord(separator)
    if not (_PLAIN[text] | blank | line_end | mark).all():
        return None
    if not _is_regular(blank & ~mark, line_end, mark, separator is None, columns):
        return None
    spaced = block if separator is None else block.replace(separator.encode(), b" ")
    try:
        numbers = np.fromstring(spaced.decode(), sep=" ")
    except ValueError:  # Letters of numbers that make none.
        return None
    rows = int(line_end.sum()) + 1
    return numbers.reshape(rows, columns) if numbers.size == rows * columns else None


def _is_regular(
    blank: Bool[np.ndarray, " bytes"],
    line_end: Bool[np.ndarray, " bytes"],
    mark: Bool[np.ndarray, " bytes"],
    by_blanks: bool,
    columns: int,
) -> bool:
    """Whether every line has so many cells, and each of them one word."""
    solid = ~(blank | line_end | mark)
    begins = solid & ~np.concatenate([[False], solid[:-1]])
    words = np.cumsum(begins, dtype=np.int32)
    stops = np.flatnonzero(line_end if by_blanks else line_end | mark)
    per_cell = np.diff(words[stops], prepend=0, append=words[-1])
    if (per_cell != (columns if by_blanks else 1)).any():
        return False
    line_words = np.diff(words[np.flatnonzero(line_end)], prepend=0, append=words[-1])
    return bool((line_words == columns).all())
