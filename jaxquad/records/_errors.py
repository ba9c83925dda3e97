from pathlib import Path


class RecordError(ValueError):
    """A record that cannot be used as it is: says what was wrong, the value and what to do."""


class ReadError(RecordError):
    """A file that cannot be read as a record; `offset` is the byte where that showed, if known."""

    def __init__(self, reason: str, *, offset: int | None = None):
        super().__init__(reason)
        self.offset = offset

    def __str__(self) -> str:
        where = "" if self.offset is None else f" (at byte {self.offset})"
        return f"{self.args[0]}{where}"


class RecordWarning(UserWarning):
    """A record that can be used, with a doubt worth knowing."""


def located(error: ReadError, path: Path | str) -> ReadError:
    """The same error, with the file named."""
    return ReadError(f"{path}: {error.args[0]}", offset=error.offset)
