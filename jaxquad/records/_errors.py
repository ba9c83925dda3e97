from pathlib import Path


class RecordError(ValueError):
    """A record that cannot be used: the message says what is wrong, the value and what to do."""


class ReadError(RecordError):
    """A file that cannot be read.

    **Arguments:**

    - `reason`: what is wrong, and what to do.
    - `offset`: the byte of the file where the fault shows, if known.
    """

    def __init__(self, reason: str, *, offset: int | None = None):
        super().__init__(reason)
        self.offset = offset

    def __str__(self) -> str:
        where = "" if self.offset is None else f" (at byte {self.offset})"
        return f"{str(self.args[0]).rstrip('.')}{where}."


class RecordWarning(UserWarning):
    """A record can be used, but something in it was repaired, left out or looks wrong."""


def located(error: ReadError, path: Path | str) -> ReadError:
    """The same error, with the file named."""
    return ReadError(f"{path}: {error.args[0]}", offset=error.offset)
