class RecordError(ValueError):
    """A record that cannot be used as it is: says what was wrong, the value and what to do."""


class ReadError(RecordError):
    """A file that cannot be read as a record."""


class RecordWarning(UserWarning):
    """A record that can be used, with a doubt worth knowing."""
