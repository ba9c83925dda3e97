"""Scenarios read from scenarios.toml: cases with variables, and the members that these make."""

import itertools
import tomllib
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


SOURCE = Path(__file__).parents[1] / "scenarios.toml"
_MARK = {"quantity", "at_most", "at_least", "only", "except"}
_ALWAYS = {"name", "plant", "marks", "designs"}
_VARIED = {"draws", "quick", "grid", "random", "rows", "keep", "names"}
_SIGNALS = {"reference", "injection", "disturbance", "noise", "payload"}
_OPTIONS = {
    "loop": set(),
    "map": {"lags", "delays", "longest_lag", "any_b0", "known_limits"},
    "flight": _VARIED | _SIGNALS | {
        "duration", "overrides", "knows", "metrics", "linear", "theory", "invariant", "estimate",
        "estimator", "second_gain", "knows_limit", "held", "identify",
    },
}  # fmt: skip
Numbers = dict[str, np.ndarray]  # of members, by quantity


class Case(NamedTuple):
    """One case of a scenario: a plant, what happens to it, and which numbers count."""

    scenario: str  # S0 to S11
    title: str
    kind: str
    data: dict[str, Any]

    @property
    def name(self) -> str:
        return self.data["name"]

    def seed(self, seed: int) -> list[int]:
        """Of this case's own random numbers."""
        return [seed, zlib.crc32(f"{self.scenario} {self.name}".encode())]


class Group(NamedTuple):
    """The members that make one row of the table."""

    label: str
    place: np.ndarray  # of the members
    shown: bool


class Members(NamedTuple):
    """The ensemble of a case: the value of each variable for each member."""

    count: int
    values: dict[str, np.ndarray]  # [members] or [members, parts]
    groups: list[Group]

    def of(self, value: Any) -> np.ndarray:
        """A number for every member, or that of the variable with this name."""
        if not isinstance(value, str):
            return np.full(self.count, float(value))
        name, _, part = value.partition(".")
        if name not in self.values:
            raise ValueError(f"no variable {name!r}: there are {sorted(self.values)}")
        found = self.values[name]
        return found[:, int(part)] if part else found


def load(source: Path = SOURCE) -> dict[str, Any]:
    """The whole file, with its cases checked."""
    data = tomllib.loads(source.read_text())
    for case in cases(data):
        _check(case, data)
    return data


def cases(data: dict[str, Any], wanted: tuple[str, ...] = ()) -> list[Case]:
    """The cases of the scenarios in `wanted`, all if there are none."""
    unknown = [name for name in wanted if name not in data["scenarios"]]
    if unknown:
        raise ValueError(f"no scenario {unknown}: there are {', '.join(data['scenarios'])}")
    return [
        Case(name, scenario["title"], scenario["kind"], case)
        for name, scenario in data["scenarios"].items()
        if name in wanted or not wanted
        for case in scenario["cases"]
    ]


def members_of(case: Case, *, quick: bool, seed: int) -> Members:
    """Every combination of the grid with every draw; all combinations share the draws."""
    data = case.data
    draws = data.get("quick" if quick else "draws", data.get("draws", 1))
    grid = data.get("grid", {})
    combinations = list(itertools.product(*grid.values()))
    values = {
        name: np.repeat(np.array([row[k] for row in combinations], float), draws, axis=0)
        for k, name in enumerate(grid)
    }
    generator = np.random.default_rng(case.seed(seed))
    for name, law in data.get("random", {}).items():
        values[name] = np.tile(_drawn(generator, law, draws), len(combinations))
    count = draws * len(combinations)
    return Members(count, values, _groups(data, values, count))


def _drawn(generator: np.random.Generator, law: dict[str, Any], draws: int) -> np.ndarray:
    [(kind, (a, b))] = law.items()
    if kind == "normal":
        return generator.normal(a, b, draws)
    if kind == "log_uniform":
        return np.exp(generator.uniform(np.log(a), np.log(b), draws))
    raise ValueError(f"no distribution {kind!r}: there are normal and log_uniform")


def _groups(data: dict[str, Any], values: dict[str, np.ndarray], count: int) -> list[Group]:
    keep, names = data.get("keep", {}), [*data.get("rows", []), *data.get("keep", {})]
    texts = {name: [_text(data, name, x) for x in values[name]] for name in names}
    keys = list(zip(*texts.values(), strict=True)) if names else [()] * count
    groups = []
    for key in dict.fromkeys(keys):
        named = dict(zip(names, key, strict=True))
        shown = all(named[name] == _text(data, name, value) for name, value in keep.items())
        labelled = {name: text for name, text in named.items() if not (shown and name in keep)}
        label = ", ".join(_labelled(data, name, text) for name, text in labelled.items())
        groups.append(Group(label, np.flatnonzero([k == key for k in keys]), shown))
    return groups


def _text(data: dict[str, Any], name: str, value: Any) -> str:
    titles = data.get("names", {}).get(name)
    if titles:
        found = [np.array_equal(np.atleast_1d(x), np.atleast_1d(value)) for x in data["grid"][name]]
        return titles[found.index(True)]
    return " to ".join(f"{x:g}" for x in np.atleast_1d(value))


def _labelled(data: dict[str, Any], name: str, text: str) -> str:
    return text if name in data.get("names", {}) else f"{name} {text}"


def _check(case: Case, data: dict[str, Any]) -> None:
    where = f"{case.scenario}, {case.data.get('name')}"
    if case.kind not in _OPTIONS:
        raise ValueError(f"{where}: no kind {case.kind!r}, there are {sorted(_OPTIONS)}")
    unknown = set(case.data) - _ALWAYS - _OPTIONS[case.kind]
    unknown |= {key for mark in case.data.get("marks", []) for key in set(mark) - _MARK}
    if unknown:
        raise ValueError(f"{where}: a {case.kind} has no {sorted(unknown)}")
    if case.data["plant"] not in data["plants"]:
        raise ValueError(f"{where}: no plant {case.data['plant']!r}")
    named = list(case.data.get("designs", []))
    for mark in case.data.get("marks", []):
        named += [*mark.get("only", []), *mark.get("except", [])]
    missing = [name for name in named if name not in data["designs"]]
    if missing:
        raise ValueError(f"{where}: no design {missing}, there are {list(data['designs'])}")
