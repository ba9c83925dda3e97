"""What a setting may hold, and how a shell, TOML, JSON and Python say it."""

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeGuard

from jaxquad.records import AXES, MixError, parse_mix


Pair = tuple[float, float]
Value = Any  # of a setting: a text, number, switch, pair, ... as its `Kind` converts it


class SettingsError(ValueError):
    """Settings that cannot be used. Keys stand in backticks: the command line shows its flags."""


@dataclasses.dataclass(frozen=True)
class Kind:
    """What a setting holds: `convert` takes what Python, TOML, JSON or a shell give.

    `convert` raises ValueError for other values. A shell gives `words` words, each read by `read`
    and written by `write`, and may repeat them if `repeated`.
    """

    convert: Callable[[object], Value]
    read: Callable[[str], object] = str
    write: Callable[[Value], str] = str
    words: int = 1
    repeated: bool = False
    metavar: str | tuple[str, ...] | None = None
    choices: tuple[str, ...] | None = None


def convert(key: str, kind: Kind, value: object) -> Value:
    """Raises SettingsError where the value is none of its kind."""
    try:
        return kind.convert(value)
    except ValueError as error:
        shown = list(value) if isinstance(value, tuple) else value
        raise SettingsError(f"`{key}` is {shown!r}: {error}") from error


def _text(value: object) -> str:
    if isinstance(value, str | Path):
        return str(value)
    raise ValueError("give a text")


def _one_of(*choices: str) -> Kind:
    def convert(value: object) -> str:
        if isinstance(value, str) and value in choices:
            return value
        raise ValueError(f"choose one of {', '.join(choices)}")

    return Kind(convert, choices=choices)


def _number(value: object) -> float:
    if _is_number(value):
        return float(value)
    raise ValueError("give a number")


def _is_number(value: object) -> TypeGuard[float | int]:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return math.isfinite(value)


def _positive(value: object) -> float:
    if _is_number(value) and value > 0:
        return float(value)
    raise ValueError("give a number above 0")


def _not_negative(value: object) -> float:
    if _is_number(value) and value >= 0:
        return float(value)
    raise ValueError("give a number of at least 0")


def _hold(value: object) -> float | str:
    if isinstance(value, str) and value == "dt":
        return value
    if _is_number(value) and value >= 0:
        return float(value)
    raise ValueError('give the seconds for which the input keeps each value, 0 or more, or "dt"')


def _read_hold(text: str) -> float | str:
    return text if text == "dt" else float(text)


def _whole(least: int) -> Callable[[object], int]:
    def convert(value: object) -> int:
        if isinstance(value, int) and not isinstance(value, bool) and value >= least:
            return value
        raise ValueError(f"give a whole number of at least {least}")

    return convert


def _switch(value: object) -> bool:
    if isinstance(value, bool):
        return value
    raise ValueError("give true or false")


def _mix(value: object) -> str:
    """A channel, or a weighted sum as text or as `{"roll": {"m1": -1.0, "m2": 0.5}}`."""
    text = mix_text(value) if isinstance(value, Mapping) else value
    if not isinstance(text, str):
        raise ValueError('give a channel, or a weighted sum such as "roll=-m1+0.5*m2"')
    try:
        parse_mix(text)
    except MixError as error:
        raise ValueError(error.reason) from error
    return text


def mix_text(mix: Mapping[str, Mapping[str, float]]) -> str:
    """A mix as `jaxquad.records.parse_mix` reads it."""
    [(name, weights)] = mix.items()
    if dict(weights) == {name: 1.0}:
        return name
    return f"{name}=" + "".join(f"{weight:+}*{channel}" for channel, weight in weights.items())


def _rising(value: object) -> Pair | None:
    if isinstance(value, Sequence) and not isinstance(value, str) and len(value) == 2:
        low, high = map(_number, value)
        return (low, high) if low < high else None
    return None


def _band(value: object) -> Pair:
    pair = _rising(value)
    if pair is None or pair[0] <= 0:
        raise ValueError("give two numbers above 0, the lower one first")
    return pair


def _segment(value: object) -> Pair:
    """`[22, 30.5]`, or `22:30.5`."""
    try:
        pair = _rising([float(x) for x in value.split(":")] if isinstance(value, str) else value)
    except ValueError:
        pair = None
    if pair is None:
        raise ValueError(f"{value!r} is no START:STOP in s: write 22:30.5, the start first")
    return pair


def _segments(value: object) -> tuple[Pair, ...]:
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise ValueError("give a list of [start, stop], in s")
    return tuple(_segment(each) for each in value)


def _unit(value: object) -> tuple[str, str]:
    """`("q", "rad/s")`, or `q=rad/s`."""
    pair = value.partition("=")[::2] if isinstance(value, str) else value
    if isinstance(pair, Sequence) and len(pair) == 2:
        name, unit = pair
        if isinstance(name, str) and isinstance(unit, str) and name.strip() and unit.strip():
            return name.strip(), unit.strip()
    raise ValueError(f"{value!r} is no NAME=UNIT: write q=rad/s, for instance")


def _units(value: object) -> dict[str, str]:
    pairs = list(value.items()) if isinstance(value, Mapping) else value
    if not isinstance(pairs, Sequence) or isinstance(pairs, str):
        raise ValueError('give the unit of each channel, such as { q = "rad/s" }')
    return dict(_unit(each) for each in pairs)


def _range(value: object) -> tuple[str, Pair]:
    """`("q", (-20, 20))`, or `q=-20:20`."""
    name, limits = value.partition("=")[::2] if isinstance(value, str) else _pair(value)
    try:
        pair = _rising([float(x) for x in limits.split(":")] if isinstance(limits, str) else limits)
    except ValueError:
        pair = None
    if not (isinstance(name, str) and name.strip()) or pair is None:
        raise ValueError(f"{value!r} is no NAME=LOW:HIGH: write q=-20:20, the lower one first")
    return name.strip(), pair


def _pair(value: object) -> tuple[object, object]:
    if isinstance(value, Sequence) and len(value) == 2:
        return value[0], value[1]
    return None, None


def _ranges(value: object) -> dict[str, Pair]:
    pairs = list(value.items()) if isinstance(value, Mapping) else value
    if not isinstance(pairs, Sequence) or isinstance(pairs, str):
        raise ValueError("give the valid range of each channel, such as { q = [-20, 20] }")
    return dict(_range(each) for each in pairs)


def _patterns(value: object) -> tuple[str, ...]:
    found = (value,) if isinstance(value, str) else value
    if (
        not isinstance(found, Sequence)
        or not found
        or not all(isinstance(each, str) and each for each in found)
    ):
        raise ValueError('give a file pattern or a list of them, such as "**/*.ulg"')
    if any(pattern.startswith("/") for pattern in found):
        raise ValueError("give patterns relative to the folder of the logs, without a / in front")
    return tuple(found)


def _plain(number: float) -> str:
    return repr(number).removesuffix(".0")


def _joined(parts: Sequence[object]) -> str:
    return ":".join(_plain(part) if isinstance(part, float) else str(part) for part in parts)


TEXT, FILE = Kind(_text), Kind(_text, metavar="FILE")
MIX = Kind(_mix, metavar="CHANNEL")
POSITIVE = Kind(_positive, float, _plain, metavar="NUMBER")
NOT_NEGATIVE = Kind(_not_negative, float, _plain, metavar="NUMBER")
TIME = Kind(_number, float, _plain, metavar="S")
HOLD = Kind(_hold, _read_hold, str, metavar="S")
DURATION = Kind(_positive, float, _plain, metavar="S")
HERTZ = Kind(_positive, float, _plain, metavar="HZ")
DEGREES = Kind(_positive, float, _plain, metavar="DEG")
COUNT, SIZE = Kind(_whole(0), int, metavar="N"), Kind(_whole(1), int, metavar="N")
SWITCH = Kind(_switch, words=0)
BAND = Kind(_band, float, _plain, words=2, metavar=("LOW", "HIGH"))
SEGMENTS = Kind(_segments, write=_joined, repeated=True, metavar="START:STOP")
UNITS = Kind(_units, write="=".join, repeated=True, metavar="NAME=UNIT")
RANGES = Kind(
    _ranges, write=lambda one: f"{one[0]}={_joined(one[1])}", repeated=True,
    metavar="NAME=LOW:HIGH",
)  # fmt: skip
PATTERNS = Kind(_patterns, metavar="PATTERN")
INERTIA = Kind(_positive, float, _plain, metavar="J")
DEVIATION = Kind(_not_negative, float, _plain, metavar="DEG")
TORQUE = Kind(_number, float, _plain, metavar="NM")
ADDRESS = Kind(_text, metavar="ADDRESS")
AXIS, TIME_UNIT = _one_of(*AXES), _one_of("s", "ms", "us", "ns")
ONE_OR_ALL_AXES = _one_of(*AXES, "all")
LAW = _one_of("pid", "adrc")
ESTIMATOR, COST = _one_of("local", "composite", "welch"), _one_of("ml", "coherence")
