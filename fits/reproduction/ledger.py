"""Claims of the paper, each tried under every reading that its text leaves open."""

from collections.abc import Mapping
from typing import NamedTuple


class Reading(NamedTuple):
    """One way to understand a claim, the numbers that come out, and whether it holds then."""

    assumption: str
    numbers: Mapping[str, float | tuple[float, float]]  # by "name, unit"; a pair is before, after
    holds: bool

    def __str__(self) -> str:
        return ", ".join(_number(name, value) for name, value in self.numbers.items())


class Claim(NamedTuple):
    """What the paper says in section `where`, and what stands of it."""

    where: str
    text: str
    rule: str  # holds if this is so
    readings: tuple[Reading, ...]

    @property
    def verdict(self) -> str:
        """Reproduces under every reading, under some (conditional), or under none (does not)."""
        held = [reading.holds for reading in self.readings]
        if all(held):
            return "reproduces"
        return "conditional" if any(held) else "does not"

    def content(self) -> dict:
        """For JSON."""
        readings = [reading._asdict() for reading in self.readings]
        content = {"where": self.where, "paper": self.text, "holds_if": self.rule}
        return content | {"verdict": self.verdict, "readings": readings}


def printed(claims: list[Claim]) -> str:
    """The ledger for a terminal: a verdict and a claim, then a line per reading."""
    lines = []
    for claim in claims:
        lines.append(f"{claim.verdict.upper():<12}{claim.where:<5}{claim.text}")
        lines.append(f"{'':<12}holds if {claim.rule}")
        for reading in claim.readings:
            mark = "yes" if reading.holds else "no"
            lines.append(f"{'':<12}{mark:<4}{reading.assumption}: {reading}")
    return "\n".join([*lines, "", tally(claims)])


def markdown(claims: list[Claim]) -> str:
    """The ledger as a table: claim, reading, numbers, whether it holds, verdict."""
    lines = [
        "A claim reproduces if its rule holds under every reading that the paper leaves open, and",
        "is conditional if it holds under some. Unless a reading says otherwise: the axis is",
        "b / s^2, sampled at 2 ms under a held command, without noise, lag or limit; the observer",
        "is the current one with its gains placed in discrete time.",
        "",
        "| section | the paper | read as | here | holds | verdict |",
        "|---|---|---|---|---|---|",
    ]
    for claim in claims:
        head = f"| {claim.where} | {claim.text}; *holds if* {claim.rule} |"
        verdict = f"**{claim.verdict}**"
        for reading in claim.readings:
            holds = "yes" if reading.holds else "no"
            lines.append(f"{head} {reading.assumption} | {reading} | {holds} | {verdict} |")
            head, verdict = "| | |", ""
    return "\n".join([*lines, "", tally(claims)])


def tally(claims: list[Claim]) -> str:
    """How many claims have each verdict."""
    counts = {name: 0 for name in ("reproduces", "conditional", "does not")}
    for claim in claims:
        counts[claim.verdict] += 1
    return ", ".join(f"{name} {count}" for name, count in counts.items())


def _number(name: str, value: float | tuple[float, float]) -> str:
    text, _, unit = name.partition(", ")
    pair = value if isinstance(value, tuple) else (value,)
    shown = " -> ".join(map(_shown, pair))
    return f"{text} {shown}" + (f" {unit}" if unit else "")


def _shown(value: float) -> str:
    size = abs(value)
    if not size < float("inf"):
        return "unbounded" if size == float("inf") else "none"
    if size < 1e-6:
        return "0"
    return f"{value:.1e}" if size >= 1e4 or size < 1e-4 else f"{value:.3g}"
