"""What a setting may hold, and how a shell, TOML, JSON and Python say it."""

import dataclasses
import difflib
import functools as ft
import math
import re
import tomllib
from collections.abc import Callable, Iterable, Mapping, Sequence
from inspect import cleandoc
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard, TypeVar

from jaxquad.records import AXES, MixError, parse_mix


Pair = tuple[float, float]
Value = Any  # of a setting: a text, number, switch, pair, ... as its `Kind` converts it


class SettingsError(ValueError):
    """Settings that cannot be used. Keys stand in backticks: the command line shows its flags."""


@dataclasses.dataclass(frozen=True)
class Kind:
    """What a setting holds, as Python, TOML, JSON or a shell give it."""

    convert: Callable[[object], Value]  # raises ValueError for other values
    read: Callable[[str], object] = str  # one word of a shell
    write: Callable[[Value], str] = str
    words: int = 1
    repeated: bool = False  # whether a shell may say it several times
    metavar: str | tuple[str, ...] | None = None
    choices: tuple[str, ...] | None = None


class Option(NamedTuple):
    """How a setting is said on the command line, and what its help says."""

    kind: Kind
    help: str
    group: str
    flag: str


_REQUIRED = dataclasses.MISSING
REPLACED: Mapping[str, Sequence[str]] = {  # the keys that a key takes the place of
    "segments": ("start", "stop"),
    "start": ("segments",),
    "stop": ("segments",),
    "band": ("band_rad",),
    "band_rad": ("band",),
}


S = TypeVar("S", bound="Settings")
# Of a docstring: the title of a group, or a setting with its flag, if that has another name.
_ITEM = r"^(?:\*\*(.+):\*\*$|- `(\w+)`(?: \(`(--.+)`\))?: (.+(?:\n  \S.*)*))"


class Settings:
    """Frozen dataclasses whose fields are annotated with a `Kind`, and explained one by one."""

    __no_type_check__ = True  # in tests: fields are converted, such as a list to a tuple

    @classmethod
    @ft.cache
    def options(cls) -> Mapping[str, Option]:
        """How each setting is said, by its key, with the texts of the class's docstring."""
        texts, group = {}, ""
        for title, key, flag, text in re.findall(_ITEM, cleandoc(cls.__doc__ or ""), re.M):
            group = "" if title == "Arguments" else title.lower() or group
            texts[key] = flag, " ".join(text.split()), group
        options = {}
        for one in dataclasses.fields(cls):  # pyright: ignore[reportArgumentType]
            for kind in getattr(one.type, "__metadata__", ()):
                flag, text, group = texts.get(one.name, ("", "", ""))
                flag = flag or f"--{one.name.replace('_', '-')}"
                options[one.name] = Option(kind, text, group, flag)
        return options

    @classmethod
    def defaults(cls) -> dict[str, Value]:
        fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
        return {x.name: {} if x.default is _REQUIRED else x.default for x in fields}

    @classmethod
    def from_mapping(cls: type[S], content: Mapping[str, object], where: str = "") -> S:
        """Settings from what TOML or JSON hold; `where` begins the message of an error.

        Raises SettingsError for an unknown key, with the most similar known one, for a required
        key that is missing, and for values that cannot be.
        """
        fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
        required = [x.name for x in fields if x.default is x.default_factory is _REQUIRED]
        try:
            check_keys(content, cls.options())
            if missing := [key for key in required if key not in content]:
                options = cls.options()
                texts = (f"`{key}` ({options[key].help.partition(';')[0]})" for key in missing)
                raise SettingsError(f"give {' and '.join(texts)}")
            return cls(**content)
        except SettingsError as error:
            raise within_file(where, error) from error

    @classmethod
    def from_toml(cls: type[S], path: str | Path) -> S:
        """As `from_mapping`, from a TOML file."""
        try:
            content = tomllib.loads(Path(path).read_text())
        except FileNotFoundError as error:
            raise SettingsError(f"{path}: there is no such file in {Path.cwd()}") from error
        except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise SettingsError(f"{path}: not TOML: {error}") from error
        return cls.from_mapping(content, str(path))

    def content(self) -> dict[str, Value]:
        """All settings, for JSON; `from_mapping` reads them."""
        return {key: vars(self)[key] for key in self.options()}

    def changes(self) -> dict[str, Value]:
        """The settings that differ from their defaults."""
        defaults = self.defaults()
        return {key: value for key, value in self.content().items() if value != defaults[key]}

    def changed(self: S, changes: Mapping[str, object]) -> S:
        """These settings with others for some keys; `band` takes the place of `band_rad`, etc."""
        return self.from_mapping(updated(self.changes(), changes))

    def words(self) -> list[str]:
        """The options on the command line that stand for these settings."""
        options, words = self.options(), []
        for key, value in self.changes().items():
            kind, flag = options[key].kind, options[key].flag
            if kind.repeated:
                items = value.items() if isinstance(value, Mapping) else value
                for text in map(kind.write, items):
                    # A negative start by itself would be taken for an option.
                    words += [f"{flag}={text}"] if text.startswith("-") else [flag, text]
            else:
                values = () if kind.words == 0 else value if kind.words > 1 else [value]
                words += [flag, *map(kind.write, values)]
        return words

    def __post_init__(self):
        defaults = self.defaults()
        for key, option in self.options().items():
            value = vars(self)[key]
            if value is not None or defaults[key] is not None:
                object.__setattr__(self, key, convert(key, option.kind, value))
        for text in self.clashes():
            raise SettingsError(text)

    def clashes(self) -> Iterable[str]:
        """Why settings exclude each other, or change nothing beside each other."""
        return ()


def convert(key: str, kind: Kind, value: object) -> Value:
    """Raises SettingsError where the value is none of its kind."""
    try:
        return kind.convert(value)
    except ValueError as error:
        shown = list(value) if isinstance(value, tuple) else value
        raise SettingsError(f"`{key}` is {shown!r}: {error}") from error


def within_file(where: str, error: SettingsError) -> SettingsError:
    """In a file, keys are what they are: no flags of the command line stand for them."""
    return SettingsError(f"{where}: {error}".replace("`", "") if where else str(error))


def check_keys(content: Mapping[str, object], keys: Iterable[str]) -> None:
    """Raise SettingsError for the first key that is none of the `keys`."""
    keys = list(keys)
    for key in content:
        if key not in keys:
            near = difflib.get_close_matches(key, keys, n=1, cutoff=0.4)
            hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(keys)}"
            raise SettingsError(f"unknown key {key!r}; {hint}")


def updated(content: Mapping[str, object], changes: Mapping[str, object]) -> dict[str, object]:
    """`content` with `changes`; keys that say the same in another way go (band for band_rad)."""
    gone = {old for key in changes for old in REPLACED.get(key, ()) if old not in changes}
    return {key: value for key, value in content.items() if key not in gone} | dict(changes)


def mix_text(mix: Mapping[str, Mapping[str, float]]) -> str:
    """A mix as `jaxquad.records.parse_mix` reads it."""
    [(name, weights)] = mix.items()
    if dict(weights) == {name: 1.0}:
        return name
    return f"{name}=" + "".join(f"{weight:+}*{channel}" for channel, weight in weights.items())


def _require(
    test: Callable[[Any], bool], advice: str, make: Callable[[Any], Value] = lambda value: value
) -> Callable[[object], Value]:
    """A conversion of the values that pass a test."""

    def convert(value: object) -> Value:
        if test(value):
            return make(value)
        raise ValueError(advice)

    return convert


def _one_of(*choices: str) -> Kind:
    chosen = lambda value: isinstance(value, str) and value in choices
    return Kind(_require(chosen, f"choose one of {', '.join(choices)}"), choices=choices)


def _is_number(value: object) -> TypeGuard[float | int]:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return math.isfinite(value)


def _is_list(value: object) -> TypeGuard[Sequence[Any]]:
    return isinstance(value, Sequence) and not isinstance(value, str)


_text = _require(lambda value: isinstance(value, str | Path), "give a text", str)
_number = _require(_is_number, "give a number", float)
_positive = _require(lambda x: _is_number(x) and x > 0, "give a number above 0", float)
_not_negative = _require(lambda x: _is_number(x) and x >= 0, "give a number of at least 0", float)
_hold = _require(
    lambda value: value == "dt" if isinstance(value, str) else _is_number(value) and value >= 0,
    'give the seconds for which the input keeps each value, 0 or more, or "dt"',
    lambda value: value if value == "dt" else float(value),
)
_count, _size = (
    _require(
        lambda x, least=least: isinstance(x, int) and not isinstance(x, bool) and x >= least,
        f"give a whole number of at least {least}",
    )
    for least in (0, 1)
)


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


def _mixes(value: object) -> tuple[str, ...]:
    """One text alone is one mix."""
    return tuple(map(_mix, value if _is_list(value) else [value]))


def _rising(value: object) -> Pair | None:
    """Two numbers, the lower one first; None for anything else, ValueError for other entries."""
    if not _is_list(value) or len(value) != 2:
        return None
    low, high = map(_number, value)
    return (low, high) if low < high else None


def _span(value: object) -> Pair | None:
    """Likewise of `[22, 30.5]` or `22:30.5`; None for anything else."""
    try:
        return _rising([float(x) for x in value.split(":")] if isinstance(value, str) else value)
    except ValueError:
        return None


def _band(value: object) -> Pair:
    pair = _rising(value)
    if pair is None or pair[0] <= 0:
        raise ValueError("give two numbers above 0, the lower one first")
    return pair


def _part(value: object) -> Pair:
    if (pair := _rising(value)) is None:
        raise ValueError("give two times in s, the first one first")
    return pair


def _segments(value: object) -> tuple[Pair, ...]:
    if not _is_list(value):
        raise ValueError("give a list of [start, stop], in s")
    spans = [_span(part) for part in value]
    for part, span in zip(value, spans, strict=True):
        if span is None:
            raise ValueError(f"{part!r} is no START:STOP in s: write 22:30.5, the start first")
    return tuple(filter(None, spans))


def _by_name(value: object, advice: str) -> list[tuple[object, Any, Any]]:
    """What is said, the name and the value, from a mapping or a list of pairs or NAME=VALUE."""
    pairs = list(value.items()) if isinstance(value, Mapping) else value
    if not _is_list(pairs):
        raise ValueError(advice)
    split = lambda pair: pair.partition("=")[::2] if isinstance(pair, str) else pair
    parts = ((pair, split(pair)) for pair in pairs)
    two = ((pair, x if _is_list(x) and len(x) == 2 else (None, None)) for pair, x in parts)
    return [(pair, name, content) for pair, (name, content) in two]


def _units(value: object) -> dict[str, str]:
    units = {}
    advice = 'give the unit of each channel, such as { q = "rad/s" }'
    for pair, name, unit in _by_name(value, advice):
        if not all(isinstance(text, str) and text.strip() for text in (name, unit)):
            raise ValueError(f"{pair!r} is no NAME=UNIT: write q=rad/s, for instance")
        units[name.strip()] = unit.strip()
    return units


def _ranges(value: object) -> dict[str, Pair]:
    ranges, advice = {}, "give the valid range of each channel, such as { q = [-20, 20] }"
    for pair, name, limits in _by_name(value, advice):
        ends = _span(limits)
        if not (isinstance(name, str) and name.strip()) or ends is None:
            raise ValueError(f"{pair!r} is no NAME=LOW:HIGH: write q=-20:20, the lower one first")
        ranges[name.strip()] = ends
    return ranges


def _patterns(value: object) -> tuple[str, ...]:
    patterns = (value,) if isinstance(value, str) else value
    if not (_is_list(patterns) and patterns and all(x and isinstance(x, str) for x in patterns)):
        raise ValueError('give a file pattern or a list of them, such as "**/*.ulg"')
    if any(pattern.startswith("/") for pattern in patterns):
        raise ValueError("give patterns relative to the folder of the logs, without a / in front")
    return tuple(patterns)


def _plain(number: float) -> str:
    return repr(number).removesuffix(".0")


def _joined(parts: Sequence[object]) -> str:
    return ":".join(_plain(part) if isinstance(part, float) else str(part) for part in parts)


TEXT, FILE, ADDRESS = Kind(_text), Kind(_text, metavar="FILE"), Kind(_text, metavar="ADDRESS")
MIX, PATTERNS = Kind(_mix, metavar="CHANNEL"), Kind(_patterns, metavar="PATTERN")
POSITIVE, DURATION, HERTZ, DEGREES, INERTIA = (
    Kind(_positive, float, _plain, metavar=unit) for unit in ("NUMBER", "S", "HZ", "DEG", "J")
)
NOT_NEGATIVE, DEVIATION = (
    Kind(_not_negative, float, _plain, metavar=unit) for unit in ("NUMBER", "DEG")
)
TIME, TORQUE = (Kind(_number, float, _plain, metavar=unit) for unit in ("S", "NM"))
HOLD = Kind(_hold, lambda text: text if text == "dt" else float(text), str, metavar="S")
COUNT, SIZE = Kind(_count, int, metavar="N"), Kind(_size, int, metavar="N")
SWITCH = Kind(_require(lambda value: isinstance(value, bool), "give true or false"), words=0)
BAND = Kind(_band, float, _plain, words=2, metavar=("LOW", "HIGH"))
PART = Kind(_part, float, _plain, words=2, metavar=("START", "STOP"))
MIXES = Kind(_mixes, repeated=True, metavar="CHANNEL")
SEGMENTS = Kind(_segments, write=_joined, repeated=True, metavar="START:STOP")
UNITS = Kind(_units, write="=".join, repeated=True, metavar="NAME=UNIT")
RANGES = Kind(
    _ranges, write=lambda pair: f"{pair[0]}={_joined(pair[1])}", repeated=True,
    metavar="NAME=LOW:HIGH",
)  # fmt: skip
AXIS, TIME_UNIT = _one_of(*AXES), _one_of("s", "ms", "us", "ns")
ONE_OR_ALL_AXES, LAW = _one_of(*AXES, "all"), _one_of("pid", "adrc")
ESTIMATOR, COST = _one_of("local", "composite", "welch"), _one_of("ml", "coherence")
