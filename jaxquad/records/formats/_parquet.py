from pathlib import Path

from .._log import Log
from ._isolated import read_isolated


def sniff(head: bytes, path: Path) -> bool:
    return head.startswith(b"PAR1")


def load(path: Path) -> Log:
    """The numeric columns of a Parquet table; time stamps and durations come in s."""
    return read_isolated(path, module="_parquet_tables", kind="a Parquet table")
