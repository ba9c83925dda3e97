"""Results of studies: small JSON files from which the validation page is made."""

import json
from pathlib import Path

import numpy as np


FOLDER = Path(__file__).parent / "results"
KEYS = ("title", "command", "columns", "rows")


def write(name: str, study: dict | list[dict]) -> Path:
    """Write one study to `results/<name>.json`; refuse one that lacks what the page prints."""
    for table in tables(study):
        missing = [key for key in KEYS if key not in table]
        if missing:
            raise ValueError(f"study {name!r} has no {', '.join(missing)}: see README.md")
        for row in table["rows"]:
            if len(row) != len(table["columns"]):
                raise ValueError(f"study {name!r}: the row {row} does not fit the columns")
    path = FOLDER / f"{name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(study, indent=1, default=_plain) + "\n")
    return path


def read(name: str) -> list[dict]:
    """The tables of one study."""
    return tables(json.loads((FOLDER / f"{name}.json").read_text()))


def tables(study: dict | list[dict]) -> list[dict]:
    return [study] if isinstance(study, dict) else study


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{value!r} is neither a number nor an array of numbers")
