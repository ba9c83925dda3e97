"""Units as headers of tables write them."""

import re
from collections.abc import Sequence
from typing import NamedTuple


_UNITS = (
    "s", "ms", "us", "ns", "Hz", "rad", "deg", "rad/s", "deg/s", "rad/s^2", "deg/s^2",
    "m", "m/s", "m/s^2", "N", "N m", "V", "rpm",
)  # fmt: skip
_SAME = {
    "sec": "s", "seconds": "s", "msec": "ms", "usec": "us", "\u00b5s": "us", "\u03bcs": "us",
    "radians": "rad", "degrees": "deg", "\u00b0": "deg",
    "rad/sec": "rad/s", "deg/sec": "deg/s", "\u00b0/s": "deg/s", "dps": "deg/s",
    "rad/s2": "rad/s^2", "rad/s\u00b2": "rad/s^2", "rad/s/s": "rad/s^2",
    "deg/s2": "deg/s^2", "deg/s\u00b2": "deg/s^2", "deg/s/s": "deg/s^2",
    "m/s2": "m/s^2", "m/s\u00b2": "m/s^2", "m/s/s": "m/s^2",
    "Nm": "N m", "N*m": "N m", "N.m": "N m", "N\u00b7m": "N m", "RPM": "rpm",
}  # fmt: skip
_TITLE = re.compile(r"(.*\S)\s*(?:\[([^\[\]()]+)\]|\(([^\[\]()]+)\))")


def known_unit(text: str) -> str:
    """A unit as this library writes it; empty for one that is not known to be one."""
    plain = text.strip()
    return plain if plain in _UNITS else _SAME.get(plain, "")


class Column(NamedTuple):
    """What the cell of a header names, and its unit: empty where it has none."""

    name: str
    unit: str


def columns_of(titles: Sequence[str]) -> dict[str, Column]:
    """The cells of a header, such as `q [deg/s]` and `time (us)`, as names and units.

    A cell keeps its whole text as a name where it ends in no known unit, and where the name alone
    would be that of another cell.
    """
    parts = {title: _split(title) for title in titles}
    names = [name for name, _ in parts.values()]
    clear = {title: names.count(parts[title].name) == 1 for title in titles}
    return {t: part if clear[t] else Column(t, part.unit) for t, part in parts.items()}


def _split(title: str) -> Column:
    found = _TITLE.fullmatch(title)
    unit = known_unit(found[2] or found[3]) if found else ""
    return Column(found[1], unit) if found and unit else Column(title, "")
