import difflib
import tomllib
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from math import inf
from pathlib import Path
from typing import Any, NamedTuple

from jaxquad.records import AXES, parse_mix


_NUMBER, _SWITCH, _COUNT, _TEXT = (int, float), (bool,), (int,), (str,)
_KINDS: Mapping[str, tuple[type, ...]] = {
    "input": _TEXT, "output": _TEXT, "reference": _TEXT, "axis": _TEXT, "time": _TEXT,
    "time_unit": _TEXT, "units": (dict,), "rate": _NUMBER, "start": _NUMBER, "stop": _NUMBER,
    "segments": (list,),
    "band": (list,), "band_rad": (list,), "integrators": _COUNT, "lag": _SWITCH, "delay": _SWITCH,
    "poles": _COUNT, "zeros": _COUNT, "estimator": _TEXT, "window": _NUMBER, "cost": _TEXT,
}  # fmt: skip
_CHOICES: Mapping[str, Sequence[str]] = {
    "axis": AXES,
    "time_unit": ("s", "ms", "us", "ns"),
    "estimator": ("local", "composite", "welch"),
    "cost": ("ml", "coherence"),
}
_INSTEAD: Mapping[str, Sequence[str]] = {  # what a key stands for in place of
    "segments": ("start", "stop"),
    "start": ("segments",),
    "stop": ("segments",),
    "band": ("band_rad",),
    "band_rad": ("band",),
}
_EVERY_LOG = ("**/*",)


class Settings(NamedTuple):
    """How the logs of a fleet are identified."""

    logs: tuple[str, ...] = _EVERY_LOG  # globs below the folder; what starts with a dot is left out
    common: Mapping[str, Any] = {}
    overrides: tuple[tuple[tuple[str, ...], Mapping[str, Any]], ...] = ()  # globs, what they change
    timeout: float | int | None = None  # s, of one log; what takes longer has failed

    def of(self, log: str) -> dict[str, Any]:
        """Those of one log, by its path below the folder; of several overrides the last counts.

        What says the same in another way goes: `start` where an override has `segments`.
        """
        found = dict(self.common)
        for globs, changes in self.overrides:
            if any(fnmatchcase(log, glob) for glob in globs):
                for key in (each for given in changes for each in _INSTEAD.get(given, ())):
                    found.pop(key, None)
                found |= changes
        return found


def read_settings(path: str | Path) -> Settings:
    """Read a fleet's TOML file.

    Raises ValueError for a file that is no TOML, a key that is not known (with the nearest that
    is), and a value of the wrong kind.
    """
    path = Path(path)
    try:
        content = tomllib.loads(path.read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path}: not TOML: {error}") from error
    return settings_of(content, str(path))


def settings_of(content: Mapping[str, Any], name: str = "settings") -> Settings:
    """As `read_settings`, of what a TOML file holds; `name` is for the errors."""
    _check_keys(content, (*_KINDS, "logs", "override", "timeout"), name)
    common = {key: value for key, value in content.items() if key in _KINDS}
    _check_values(common, name)
    overrides = content.get("override", [])
    if not isinstance(overrides, list) or not all(isinstance(each, dict) for each in overrides):
        raise ValueError(f"{name}: an override is a table of its own: write [[override]]")
    changes = []
    for k, each in enumerate(overrides, start=1):
        where = f"{name}, override {k}"
        _check_keys(each, (*_KINDS, "logs"), where)
        if "logs" not in each:
            raise ValueError(f'{where}: says of no logs: add logs = "flight_07*"')
        table = {key: value for key, value in each.items() if key != "logs"}
        _check_values(table, where)
        changes.append((_globs(each["logs"], where), table))
    logs = _globs(content["logs"], name) if "logs" in content else _EVERY_LOG
    timeout = content.get("timeout")
    _check_timeout(timeout, name)
    return Settings(logs, common, tuple(changes), timeout)


def _check_timeout(value: Any, where: str) -> None:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if value is not None and not (number and 0 < value < inf):
        raise ValueError(f"{where}: timeout = {value!r} has to be a number of s above 0")


def _check_keys(content: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    for key in content:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.4)
            hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
            raise ValueError(f"{where}: unknown key {key!r}; {hint}")


def _check_values(table: Mapping[str, Any], where: str) -> None:
    for key, value in table.items():
        kinds = _KINDS[key]
        if not isinstance(value, kinds) or (isinstance(value, bool) and bool not in kinds):
            words = " or ".join(kind.__name__ for kind in kinds)
            raise ValueError(f"{where}: {key} = {value!r} has to be of kind {words}")
        if key in _CHOICES and value not in _CHOICES[key]:
            raise ValueError(f"{where}: {key} = {value!r} is none of {', '.join(_CHOICES[key])}")
        if key in ("input", "output", "reference"):
            _check_mix(value, key, where)
        if key in ("band", "band_rad"):
            _check_span(value, key, where, " from above 0")
        if key == "segments":
            _check_segments(value, where)
    if "segments" in table and {"start", "stop"} & set(table):
        raise ValueError(f"{where}: segments say where to start and stop: leave start, stop out")
    if "band" in table and "band_rad" in table:
        raise ValueError(f"{where}: band (Hz) and band_rad (rad/s) are both given: keep one")


def _check_mix(value: Any, key: str, where: str) -> None:
    try:
        parse_mix(value)
    except ValueError as error:
        raise ValueError(f"{where}: {key}: {error}") from error


def _check_segments(spans: Any, where: str) -> None:
    for each in spans:
        _check_span(each, "one of segments", where)


def _check_span(value: Any, key: str, where: str, above: str = "") -> None:
    given = value if isinstance(value, list) else []
    numbers = [isinstance(x, int | float) and not isinstance(x, bool) for x in given]
    least = 0 if above else -inf
    if numbers != [True, True] or not least < value[0] < value[1] < inf:
        raise ValueError(f"{where}: {key} = {value!r} has to be [low, high], rising{above}")


def _globs(value: Any, where: str) -> tuple[str, ...]:
    globs = (value,) if isinstance(value, str) else value
    if not isinstance(globs, list | tuple) or not all(isinstance(g, str) and g for g in globs):
        raise ValueError(f'{where}: logs = {value!r} has to be a glob or a list of them: "*.ulg"')
    if any(glob.startswith("/") for glob in globs):
        raise ValueError(f"{where}: logs = {value!r}: globs are below the folder of the logs")
    return tuple(globs)
