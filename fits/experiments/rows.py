"""Rows of the suite's table: numbers, verdicts, print."""

import math
from typing import Any, NamedTuple

from .data import Case
from .matching import Matched


NEVER = 1e9  # s, of a settling time that does not exist


class Column(NamedTuple):
    head: str
    quantity: str
    digits: int  # significant
    unit: str = ""


COLUMNS = (
    Column("Ms", "sensitivity_peak", 3),
    Column("activity", "activity", 3, "rad/s^2/rad"),
    Column("ITAE", "itae", 3, "s^2"),
    Column("overshoot", "overshoot", 3, "%"),
    Column("ts 2 %", "settling_time", 3, "s"),
    Column("peak", "peak", 3, "deg"),
    Column("rms", "rms", 3, "deg"),
    Column("d-RMSE", "disturbance_rmse", 3, "mN m"),
    Column("saturated", "saturation", 3, "%"),
    Column("unstable", "unstable", 3, "%"),
    Column("worst", "worst", 3),
)


class Row(NamedTuple):
    """One design in one case: what was found, and whether it passes."""

    case: Case
    label: str  # values of the case's variables
    design: str
    numbers: dict[str, float]
    infeasible: str = ""  # why no controller can do it
    note: str = ""
    shown: bool = True

    @property
    def verdict(self) -> str:
        """ "pass", "FAIL" and by which mark, "infeasible" and why, or nothing without a mark."""
        if self.infeasible:
            return f"infeasible: {self.infeasible}"
        marks = [mark for mark in self.case.data.get("marks", []) if _applies(mark, self)]
        failed = [text for mark in marks if (text := _failure(mark, self.numbers))]
        # A limit, or a short flight, can hold the numbers of such a loop within any mark.
        if marks and math.isinf(self.numbers.get("sensitivity_peak", 0.0)):
            failed.insert(0, "the linear loop is unstable")
        if failed:
            return "FAIL: " + "; ".join(failed)
        return "pass" if marks else ""

    @property
    def place(self) -> str:
        parts = (self.case.scenario, self.case.name, self.label)
        return " | ".join(part for part in parts if part)

    def content(self) -> dict[str, Any]:
        """For JSON."""
        place = {"scenario": self.case.scenario, "case": self.case.name, "row": self.label}
        end = {"verdict": self.verdict, "note": self.note}
        return place | {"design": self.design, "numbers": self.numbers} | end


def with_loop(row: Row, loop: Matched) -> Row:
    """With the numbers of the design's nominal loop in front."""
    nominal = {"sensitivity_peak": loop.sensitivity_peak, "activity": loop.activity}
    return row._replace(numbers=nominal | {"matched": float(loop.matched)} | row.numbers)


def with_variation(rows: list[Row], quantities: list[str]) -> list[Row]:
    """With the largest change of these quantities from the first row of the same design.

    Percentages change by their difference over 100, the others by their ratio.
    """
    first: dict[str, Row] = {}
    done = []
    for row in rows:
        base = first.setdefault(row.design, row).numbers
        changes = [_change(name, row.numbers[name], base[name]) for name in quantities]
        numbers = row.numbers | {"variation": max(changes)}
        done.append(row._replace(numbers=numbers))
    return done


def require_marked_quantities(rows: list[Row]) -> None:
    """Raises ValueError for a mark whose quantity no row of its case has."""
    for row in rows:
        for mark in row.case.data.get("marks", []):
            name = mark["quantity"]
            if not any(name in other.numbers for other in rows if other.case is row.case):
                raise ValueError(
                    f"{row.case.scenario}, {row.case.name}: no row has the quantity {name!r}; "
                    f"there are {', '.join(row.numbers)}"
                )


def _change(name: str, value: float, base: float) -> float:
    if not (math.isfinite(value) and math.isfinite(base)):
        return math.inf
    return abs(value - base) / 100 if name == "overshoot" else abs(value / base - 1)


def _applies(mark: dict[str, Any], row: Row) -> bool:
    """A row that lacks the quantity has no such mark; see `require_marked_quantities`."""
    if mark["quantity"] not in row.numbers:
        return False
    return row.design in mark.get("only", [row.design]) and row.design not in mark.get("except", [])


def _failure(mark: dict[str, Any], numbers: dict[str, float]) -> str:
    name = mark["quantity"]
    value = numbers[name]
    text = shown(value, 3).replace("lost", "unbounded")
    if "at_most" in mark and not value <= mark["at_most"]:
        return f"{name} {text} > {mark['at_most']:g}"
    if "at_least" in mark and not value >= mark["at_least"]:
        return f"{name} {text} < {mark['at_least']:g}"
    return ""


def shown(value: float, digits: int) -> str:
    """A number, or what stands for none."""
    if math.isnan(value):
        return "-"
    if math.isinf(value):
        return "lost"
    if value >= NEVER:
        return "never"
    return "0" if abs(value) < 1e-12 else f"{value:.{digits}g}"


def cells(row: Row) -> list[str]:
    """The row's texts, column by column; a star marks numbers that are not matched."""
    texts = [row.place, row.design]
    for column in COLUMNS:
        text = shown(row.numbers.get(column.quantity, math.nan), column.digits)
        loop = column.quantity in ("sensitivity_peak", "activity")
        starred = loop and row.numbers.get("matched") == 0.0
        texts.append(text.replace("lost", "unstable") + "*" * starred if loop else text)
    return [*texts, row.verdict, row.note]


def heads() -> list[str]:
    columns = [c.head + (f", {c.unit}" if c.unit else "") for c in COLUMNS]
    return ["scenario", "design", *columns, "verdict", "note"]


def printed(rows: list[Row]) -> str:
    """The table in plain text."""
    lines = [heads(), *(cells(row) for row in rows if row.shown)]
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    text = []
    for line in lines:
        left = [line[k].ljust(widths[k]) for k in (0, 1)]
        numbers = [line[k].rjust(widths[k]) for k in range(2, len(line) - 2)]
        text.append("  ".join([*left, *numbers, line[-2].ljust(widths[-2]), line[-1]]).rstrip())
    return "\n".join(text)


def markdown(rows: list[Row]) -> str:
    """The table in Markdown."""
    bar = lambda texts: "| " + " | ".join(text.replace("|", "·") for text in texts) + " |"
    ruler = "|" + "---|" * len(heads())
    return "\n".join([bar(heads()), ruler, *(bar(cells(row)) for row in rows if row.shown)])


def matching_table(loops: list[Matched], markup: bool = False) -> str:
    """What the designs' gains are, and which are matched."""
    lines = [
        [
            "plant",
            "design",
            "gains (rad/s; damping, ratio: 1)",
            "Ms",
            "activity, rad/s^2/rad",
            "matched",
        ]
    ]
    for loop in loops:
        gains = ", ".join(f"{name} {value:.4g}" for name, value in loop.design.gains.items())
        peak, activity = (
            shown(x, 4).replace("lost", "unstable") for x in (loop.sensitivity_peak, loop.activity)
        )
        met = "yes" if loop.matched else f"no: {loop.why}"
        lines.append([loop.plant, loop.design.name, gains, peak, activity, met])
    if markup:
        rows = ["| " + " | ".join(line) + " |" for line in lines]
        return "\n".join([rows[0], "|" + "---|" * len(lines[0]), *rows[1:]])
    widths = [max(len(line[k]) for line in lines) for k in range(len(lines[0]))]
    return "\n".join(
        "  ".join(text.ljust(width) for text, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
