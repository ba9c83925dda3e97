"""Two flights of one vehicle over each other: which is better, by how much, with errors.

A quantity is better or worse where it differs by more than three standard errors and by more than a
pilot notices; it is the same where its 95 % interval holds no difference that a pilot notices.
"""

import dataclasses
import re
import shlex
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple, Protocol, runtime_checkable

import numpy as np

import jaxquad.plot as plot
import jaxquad.report as report
from jaxquad._core import announce, Message, plain_content, staged_files, write_file
from jaxquad.plot import Spectrum, StepBand
from jaxquad.report import Cell, Headline, Table

from ._firmware import firmware_named
from ._flight_qualities import (
    Estimate,
    FlownAxis,
    HALF_WAY,
    hover_noise,
    HoverNoise,
    identified_loop,
    measured_step,
    MS,
    NoHover,
    NOISE,
    PEAK,
    TORQUE,
)


Verdict = Literal["better", "worse", "same", "trade", "cannot tell"]
_SIGMAS = 3.0  # standard errors from which a difference is clear
_NORMAL = 1.96
_SATURATED, _ELSEWHERE, _LOUDER = 0.02, 0.05, 2.0  # share of samples; of throttle; of excitation
_MOVES = 1.0  # deg/s, of a set-point that does not rest
_AS_FAST = 0.01  # by which the rates of two logs may differ


@runtime_checkable
class ComparisonSettings(Protocol):
    """`jq.workflows.CompareSettings`."""

    def content(self) -> dict[str, Any]: ...
    def words(self) -> list[str]: ...


class Scale(NamedTuple):
    """How a quantity is read; less of each is better."""

    notice: float  # relative difference that a pilot notices
    harmless: float = 0.0  # up to which less is no better
    unit: str = ""
    factor: float = 1.0  # from SI to the unit


SCALES: Mapping[str, Scale] = {
    PEAK: Scale(0.05, harmless=1.1), HALF_WAY: Scale(0.05, unit="ms", factor=1e3),
    MS: Scale(0.05, harmless=1.8), TORQUE: Scale(0.1), NOISE: Scale(0.1),
}  # fmt: skip


@dataclasses.dataclass(frozen=True)
class ComparedQuantity:
    """One quantity in both flights, each with its 95 % interval."""

    name: str
    before: Estimate
    after: Estimate
    source: str  # how both were obtained

    @property
    def scale(self) -> Scale:
        return SCALES[self.name]

    @property
    def error(self) -> float:
        """Standard error of the ratio's logarithm; infinite where an interval has no end."""
        return float(np.hypot(self.before.log_error, self.after.log_error))

    @property
    def ratio(self) -> Estimate:
        """After over before."""
        if not np.isfinite(self.error):
            return Estimate(float("nan"), 0.0, float("inf"))
        value, far = self.after.value / self.before.value, float(np.exp(_NORMAL * self.error))
        low = 0.0 if np.isinf(self.before.high) else value / far
        return Estimate(value, low, float("inf") if np.isinf(self.after.high) else value * far)

    @property
    def verdict(self) -> Verdict:
        """Better, worse, same or cannot tell."""
        scale, error = self.scale, self.error
        if self.is_harmless:
            return "same"
        if not np.isfinite(error):
            return "cannot tell"
        values = [max(x.value, scale.harmless) for x in (self.before, self.after)]
        change, notice = float(np.log(values[1] / values[0])), float(np.log1p(scale.notice))
        if abs(change) > max(_SIGMAS * error, notice):
            return "worse" if change > 0 else "better"
        return "same" if abs(change) + _NORMAL * error <= notice else "cannot tell"

    @property
    def is_harmless(self) -> bool:
        """Whether both are where less is no better."""
        return max(self.before.high, self.after.high) <= self.scale.harmless

    @property
    def text(self) -> str:
        """In words, with the ratio or between what it can be."""
        ratio = self.ratio
        if self.is_harmless:
            return f"{self.name} (both below {self.scale.harmless:g})"
        if self.verdict in ("better", "worse"):
            return f"{self.name} ({ratio.value:.2f} times, {self._interval})"
        return f"{self.name} ({self._interval})"

    @property
    def _interval(self) -> str:
        low, high = self.ratio[1:]
        if high >= 10:
            return f"above {low:.2f}" if low > 0 else "unknown"
        return f"{low:.2f} .. {high:.2f}"

    def content(self) -> dict[str, object]:
        parts = {name: getattr(self, name)._asdict() for name in ("before", "after", "ratio")}
        return {"name": self.name, "verdict": self.verdict, "source": self.source, **parts}

    def cells(self) -> list[str]:
        """Before, after, ratio with its interval, and verdict, as text and page print them."""
        factor = self.scale.factor
        if self.name == TORQUE and 0 < self.before.value < np.inf:  # a torque that no log holds
            factor = 1 / self.before.value
        values = [f"{factor * x.value:#.3g}".rstrip(".") for x in (self.before, self.after)]
        verdict = f"below {self.scale.harmless:g}" if self.is_harmless else self.verdict
        return [*values, f"{self.ratio.value:.2f}", self._interval, verdict]

    @property
    def title(self) -> str:
        return f"{self.name}, {self.scale.unit}" if self.scale.unit else self.name


class ChangedSetting(NamedTuple):
    """A gain, filter or other parameter of the law that differs."""

    name: str
    before: str
    after: str


def combine(verdicts: Sequence[Verdict]) -> Verdict:
    """One verdict of several: a trade where some are better and others worse."""
    kinds = set(verdicts)
    if "trade" in kinds or {"better", "worse"} <= kinds:
        return "trade"
    if kinds & {"better", "worse"}:
        return "better" if "better" in kinds else "worse"
    return "same" if kinds == {"same"} else "cannot tell"


@dataclasses.dataclass(frozen=True)
class AxisComparison:
    """One axis in both flights."""

    axis: str
    quantities: tuple[ComparedQuantity, ...]
    changes: tuple[ChangedSetting, ...]  # of the law, before and after
    remarks: tuple[str, ...]  # conditions that differ, and what the logs do not show
    unit: str  # of the law's output
    steps: Mapping[str, StepBand] = dataclasses.field(default_factory=dict)
    gyro: Mapping[str, Spectrum] = dataclasses.field(default_factory=dict)
    command: Mapping[str, Spectrum] = dataclasses.field(default_factory=dict)
    doubt: str = ""  # why the loop is not compared

    @property
    def kind(self) -> Verdict:
        """Of all quantities; without those of the loop noise alone decides nothing."""
        return "cannot tell" if self.doubt else combine([x.verdict for x in self.quantities])

    @property
    def headline(self) -> Headline:
        """The verdict with one sentence: what differs, or why that is open."""
        same, wide = "no difference that a pilot notices", "no difference is clear"
        reasons = {"same": same, "cannot tell": self.doubt or f"{wide}, and none is excluded"}
        reason = reasons.get(self.kind) or "; ".join(self._named(("better", "worse")))
        if not self.changes and self.kind not in reasons:
            reason += "; no gain or filter differs, so it is the vehicle or the air"
        return Headline(*LEVELS[self.kind], Message(reason))

    def _named(self, kinds: Sequence[str]) -> list[str]:
        """The quantities of each verdict, in words."""
        words = {"same": "the same", "cannot tell": "open"}
        named = {k: [x.text for x in self.quantities if x.verdict == k] for k in kinds}
        return [f"{words.get(k, k)}: {', '.join(texts)}" for k, texts in named.items() if texts]

    @property
    def verdict(self) -> str:
        """In words, with numbers."""
        parts: list[str] = [f"the logs do not show the loop: {self.doubt}"] if self.doubt else []
        parts += self._named(("better", "worse", "same", "cannot tell"))
        lead = ["a trade"] if self.kind == "trade" else []
        if not self.changes and self.kind in ("better", "worse", "trade"):
            lead.insert(0, "the vehicle or the air, not the gains")
        if self.changes:
            named = ", ".join(f"{x.name} {x.before} -> {x.after}" for x in self.changes)
            parts.append(f"changed: {named} (feed-forward and a relaxed integral are not compared)")
        return "; ".join([*lead, *parts])

    def content(self) -> dict[str, object]:
        curves = lambda shown: {name: curve._asdict() for name, curve in shown.items()}
        return {
            "kind": self.kind,
            "verdict": self.verdict,
            "quantities": [x.content() for x in self.quantities],
            "changes": [x._asdict() for x in self.changes],
            "remarks": list(self.remarks),
            "unit": self.unit,
            "steps": curves(self.steps),
            "gyro_spectra": curves(self.gyro),
            "command_spectra": curves(self.command),
        }


LEVELS: Mapping[Verdict, tuple[str, str]] = {
    "better": ("good", "BETTER"), "same": ("good", "THE SAME"), "trade": ("warn", "A TRADE"),
    "worse": ("bad", "WORSE"), "cannot tell": ("warn", "CANNOT TELL"),
}  # fmt: skip
_ROW = "  {:<23} {:>8} {:>8} {:>6} {:>14}  {}"
_HEADS = ("", "before", "after", "ratio", "95 %", "verdict")
_NOTES = (
    "Ratios are after / before with 95 % intervals; less of each quantity is better. Better and "
    "worse: by more than 3 standard errors and 5 % (10 % of torque and noise); the same: within "
    "that at 95 %. Below Ms 1.8 and a peak of 1.1 less is no better. Effect of a torque step: root "
    "of the integrated square of the rate. Noise: rms of the law's output above 30 Hz in steady "
    "hover."
)


@dataclasses.dataclass(frozen=True)
class FlightComparison:
    """Two flights of one vehicle over each other; `str()` is the report as text."""

    before: Path
    after: Path
    firmware: str
    settings: ComparisonSettings
    axes: Mapping[str, AxisComparison]  # by the axis' name
    unread: Mapping[str, str] = dataclasses.field(default_factory=dict)  # why one is not there

    @property
    def kind(self) -> Verdict:
        """Of all axes whose loop the logs show."""
        return combine([x.kind for x in self.axes.values() if x.kind != "cannot tell"])

    @property
    def headline(self) -> Headline:
        """How the verdict stands on a page."""
        return Headline(*LEVELS[self.kind], self.firmware)

    @property
    def verdict(self) -> str:
        """In words, an axis each line."""
        lines = [f"{name}: {axis.verdict}" for name, axis in self.axes.items()]
        return "\n".join([*lines, *(f"{axis}: {why}" for axis, why in self.unread.items())])

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        content = {
            "kind": self.kind,
            "verdict": self.verdict,
            "before": str(self.before),
            "after": str(self.after),
            "firmware": self.firmware,
            "axes": {name: axis.content() for name, axis in self.axes.items()},
            "unread": dict(self.unread),
            "settings": self.settings.content(),
        }
        return {key: plain_content(value) for key, value in content.items()}

    def write(self, folder: str | Path) -> list[Path]:
        """Write `compare.html` and `compare.json`: both, or none.

        **Returns:** their paths.
        """
        folder, logs = Path(folder), (self.before, self.after)
        announce("the page")
        words = ["jaxquad", "compare", *map(str, logs), *self.settings.words()]
        stated = {k: v for k, v in self.settings.content().items() if v is not None}
        origin = report.provenance(*logs, command=shlex.join(words), settings=stated)
        with staged_files(folder) as draft:
            stored = {**self.content(), "provenance": origin.content()}
            page = report.render_page(
                "compare.html", title=f"{LEVELS[self.kind][1]}: {self.before.name} and "
                f"{self.after.name}", headline=self.headline,
                logs=[self.before.name, self.after.name], notes=_NOTES,
                axes=[_axis_section(axis) for axis in self.axes.values()],
                unread=[f"{axis}: {why}" for axis, why in self.unread.items()],
                text=str(self), origin=report.attempt(report.provenance_section, origin),
            )  # fmt: skip
            written = [
                write_file(draft / "compare.html", page),
                report.write_json(draft / "compare.json", stored),
            ]
        return [folder / path.name for path in written]

    def __str__(self) -> str:
        fill = lambda text, indent="": textwrap.fill(
            text, 79, initial_indent=indent, subsequent_indent=f"{indent}  ",
            break_long_words=False, break_on_hyphens=False,
        )  # fmt: skip
        parts = [fill("{}: {}: {}".format(x, *y.headline[1:])) for x, y in self.axes.items()]
        parts += [fill(f"{axis}: not compared: {why}") for axis, why in self.unread.items()]
        parts += ["", f"before: {self.before}", f"after:  {self.after}", self.firmware]
        for name, axis in self.axes.items():
            parts += ["", name, fill(axis.verdict, "  ")]
            if axis.quantities:
                rows = [_ROW.format(x.title, *x.cells()) for x in axis.quantities]
                parts += ["", _ROW.format(*_HEADS), *rows]
            if axis.changes:
                parts += ["", f"  {'settings of the law':<32} {'before':>20} {'after':>20}"]
            parts += [f"  {x.name:<32} {x.before:>20} {x.after:>20}" for x in axis.changes]
            parts += [fill(f"! {text}", "  ") for text in axis.remarks]
        parts += ["", fill(_NOTES), "", f"Both flights: {LEVELS[self.kind][1].lower()}"]
        return "\n".join(parts)


def compare_axes(axis: str, before: FlownAxis, after: FlownAxis) -> AxisComparison:
    """One axis of two flights. Raises ValueError where they are not of one vehicle."""
    _require_one_vehicle(before, after)
    both = {"before": before, "after": after}
    remarks = _conditions(before, after)
    loops = {name: identified_loop(x) for name, x in both.items()}
    source = "identified plant in the law that flew"
    if any(x is None for x in loops.values()):
        loops = {name: measured_step(x.flown.flight) for name, x in both.items()}
        source = "the log's own response from set-point to rate"
    quantities, steps, doubt = [], {}, ""
    doubts = "; ".join(_by_reason({name: x.doubt for name, x in both.items()}))
    first, second = loops.values()
    if first is None or second is None:
        doubt = doubts or "the plant's gain may be of either sign"
    else:
        shared = [name for name in first.qualities if name in second.qualities]
        quantities = [
            ComparedQuantity(name, first.qualities[name], second.qualities[name], source)
            for name in shared
        ]
        steps = {"before": first.step, "after": second.step}
        remarks += [f"the step is {source} ({doubts})"] if MS not in shared else []
    noises: dict[str, HoverNoise] = {}
    silent: dict[str, str] = {}  # why a log is without it
    for name, one in both.items():
        try:
            noises[name] = hover_noise(one)
        except NoHover as error:
            silent[name] = str(error)
    remarks += [f"noise is not compared: {why}" for why in _by_reason(silent)]
    if len(noises) == 2:
        dts = [x.flight.dt for x in both.values() if x.flight is not None]
        if abs(dts[0] / dts[1] - 1) > _AS_FAST:
            rates = " and ".join(f"{1 / dt:.0f} Hz" for dt in dts)
            remarks.append(f"noise is not compared: the logs are of {rates}; log at one rate")
        else:
            first, second = (x.rms for x in noises.values())
            text = " and ".join(f"{x.seconds:.1f} s" for x in noises.values())
            quantities.append(ComparedQuantity(NOISE, first, second, f"steady hover of {text}"))
    changes = changed_settings(before, after)
    remarks += [] if changes else ["no gain or filter differs: what differs is of vehicle or air"]
    return AxisComparison(
        axis, tuple(quantities), changes, tuple(remarks),
        firmware_named(before.flown.firmware).unit, steps,
        {name: x.gyro for name, x in noises.items()},
        {name: x.command for name, x in noises.items()}, doubt,
    )  # fmt: skip


def _by_reason(reasons: Mapping[str, str]) -> list[str]:
    """Reasons behind the logs that they are of, each once."""
    named = {why: [name for name in reasons if reasons[name] == why] for why in reasons.values()}
    return [f"{' and '.join(names)}: {why}" for why, names in named.items() if why]


def _require_one_vehicle(before: FlownAxis, after: FlownAxis) -> None:
    kinds = [firmware_named(x.flown.firmware).log.title for x in (before, after)]
    advice = "give two logs of one vehicle"
    if kinds[0] != kinds[1]:
        raise ValueError(f"the first log is of {kinds[0]}, the second of {kinds[1]}: {advice}")
    flights = [x.flown.flight for x in (before, after)]
    motors = [0 if x is None or x.motors is None else x.motors.shape[1] for x in flights]
    if all(motors) and motors[0] != motors[1]:
        first, second = motors
        raise ValueError(f"the first log is of {first} motors, the second of {second}: {advice}")


_CAUSES = {"gain": "throttle, battery, propellers or load", "lag": "motors or propellers"}


def _conditions(before: FlownAxis, after: FlownAxis) -> list[str]:
    """What differs or spoils the comparison beside gains and filters, in words."""
    remarks, both = [], {"before": before, "after": after}
    versions = [".".join(map(str, x.flown.version)) for x in both.values()]
    if versions[0] != versions[1]:
        remarks.append(f"the firmware's version differs: {versions[0]} and {versions[1]}")
    flights = [x.flown.flight for x in both.values()]
    first, second = (None if x is None else x.middle for x in flights)
    if first is not None and second is not None and abs(second - first) > _ELSEWHERE:
        remarks.append(
            f"the throttle differs: {first:.2f} and {second:.2f} at the median. It changes gain "
            "and noise: fly both at the same"
        )
    moves = [0.0 if x is None else float(np.degrees(np.std(x.setpoint))) for x in flights]
    if min(moves) > _MOVES and max(moves) > _LOUDER * min(moves):
        remarks.append(
            f"the set-point moves by {moves[0]:.0f} and {moves[1]:.0f} deg/s (rms): limits and "
            "relaxed integrals count more in the larger"
        )
    for name, flight in zip(both, flights, strict=True):
        share = 0.0 if flight is None else float(np.mean(flight.limited))
        if share > _SATURATED:
            remarks.append(
                f"{name}: motors are at their limits in {100 * share:.0f} % of it; law and plant "
                "hold between the limits"
            )
    for name, causes in _CAUSES.items():
        first, second = before.parameter(name), after.parameter(name)
        if first is None or second is None:
            continue
        ratio, error = second.value / first.value, np.hypot(first.log_error, second.log_error)
        if ratio > 0 and abs(np.log(ratio)) > max(_SIGMAS * error, np.log1p(_ELSEWHERE)):
            remarks.append(
                f"the plant's {name} is {ratio:.2f} times as large after, which no gain of the law "
                f"explains: {causes}, or another vehicle. It is part of the ratios"
            )
    return remarks


# Parameters of a log that shape the law, beside those of `PARAMETERS`.
_OF_THE_LAW = re.compile(
    r"lpf|low_?pass|notch|(?<!t)filter|tpa|relax|d_m(ax|in)|feedforward|ff_|anti_gravity|^INS_HN",
    re.I,
)


def changed_settings(before: FlownAxis, after: FlownAxis) -> tuple[ChangedSetting, ...]:
    """Gains, filters and other parameters of the axis' law that differ."""
    flown = [x.flown for x in (before, after)]
    rows, index = firmware_named(flown[0].firmware).parameters, flown[0].axis
    tables: list[dict[str, str]] = []
    for one in flown:
        stated = {k: f"{v:.6g}" for k, v in one.loop.parameters().items()}
        stated |= {k: f"{v:.6g}" for k, v in one.old.items()}
        stated = {k: v for k, v in stated.items() if k not in rows or rows[k].axis in (-1, index)}
        stems = tuple(stated)
        listed = lambda key, of=stems: any(x.startswith(key.removesuffix("_hz")) for x in of)
        more = {k: v for k, v in one.values.items() if _OF_THE_LAW.search(k) and not listed(k)}
        others = {k for k in more if k in rows and rows[k].axis not in (-1, index)}
        tables.append(stated | {k: v for k, v in more.items() if k not in others})
    names = dict.fromkeys([*tables[0], *tables[1]])
    return tuple(
        ChangedSetting(name, *(table.get(name, "-") for table in tables))
        for name in names if tables[0].get(name) != tables[1].get(name)
    )  # fmt: skip


def _axis_section(axis: AxisComparison) -> dict[str, object]:
    """What the page shows of an axis."""
    steps = noise = None
    if axis.steps:
        steps = report.embed_figure(
            lambda: plot.steps_figure(axis.steps, bands="95 %"),
            alt="Rate after a step of the set-point, before and after, with 95 % bands.",
            caption="The rate after a step of 1 of the set-point, without feed-forward and relaxed "
            "integral, or as each log shows it; with bands of 95 %.",
        )
    if axis.command:
        noise = report.embed_figure(
            lambda: plot.spectra_figure(axis.gyro, axis.command, unit=axis.unit, below="command"),
            alt="Spectra of gyro and command in steady hover, before and after.",
            caption="Steady hover: the gyro behind its filters, and the law's output; noise is "
            "compared above 30 Hz.",
        )
    heads = ("quantity", *_HEADS[1:])
    rows = [[Cell(x.title), *x.cells()] for x in axis.quantities]
    changes = [[Cell(x.name), Cell(x.before), Cell(x.after)] for x in axis.changes]
    return {
        "axis": axis.axis, "headline": axis.headline,
        "remarks": axis.remarks, "steps": steps, "noise": noise,
        "quantities": Table("Before and after", heads, rows) if rows else None,
        "changes": Table("Settings that differ", ("parameter", "before", "after"), changes)
        if changes else None,
    }  # fmt: skip
