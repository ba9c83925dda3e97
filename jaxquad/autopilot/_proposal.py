"""What `autopilot` found in a log: its report as text, its JSON, and the files that it writes."""

import dataclasses
import shlex
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from jaxquad._core import announce, Message, plain_content, staged_files, write_file
from jaxquad.records import AXES
from jaxquad.records.firmware import firmware_names
from jaxquad.report import Provenance, provenance, write_json

from ._filter_bank import GyroNoise, SharedChange
from ._firmware import firmware_named
from ._flight_channels import FlownAutopilot, IdentifiedPlant
from ._identified_log import ThrottleVerdict
from ._law_check import LoopCheck
from ._page import limits_text, pilot_page, PilotPage, write_pilot_page
from ._parameters import (
    change_table,
    find_parameter,
    parameter_file,
    ParameterChange,
    propose_changes,
    write_parameter_files,
)
from ._rate_loops import DesignSettings, Kind, Limits, OuterStage, Stage, WAYS


@dataclasses.dataclass(frozen=True)
class FilterVerdict:
    """What the search made of the filters."""

    text: str  # which freedom brought what, or why the filters stay
    flown: Mapping[str, float] = dataclasses.field(default_factory=dict)  # of those that change
    reason: str = ""  # why they change
    at_once: tuple[str, ...] = ()  # of a notch that is switched on, which has no third of the way
    gains_alone: Stage | None = None  # the best gains with the filters that flew
    shared: SharedChange | None = None

    def content(self) -> dict[str, object]:
        return {
            "text": self.text,
            "flown": dict(self.flown),
            "gains_alone": None if self.gains_alone is None else self.gains_alone._asdict(),
            "shared": None if self.shared is None else self.shared._asdict(),
        }


_CURVE = "thrust_curve"
_FAR = 0.98  # of the factor by which a gain may change


@dataclasses.dataclass(frozen=True)
class AutopilotProposal:
    """What `autopilot` found in a log, and what it proposes; `str()` is its report as text."""

    # "kept": what flew is as good. "cannot tell": the log does not show the plant or the loop. "not
    # to be flown": no gains keep the limits.
    kind: Kind
    verdict: str  # in words, and what to do
    settings: DesignSettings
    identification: IdentifiedPlant  # in the firmware's units, the gyro's filters divided out
    flown: FlownAutopilot
    reproduction: LoopCheck | None  # that loop and plant compared with the flight
    # On fresh plants: what flew, a third of the way and all of it. Empty where the log cannot tell.
    stages: tuple[Stage, ...] = ()
    new: Mapping[str, float] = dataclasses.field(default_factory=dict)  # what is proposed, if any
    filters: FilterVerdict | None = None  # what freeing them brings; None without a search
    noise: GyroNoise | None = None  # of the gyros, where the log shows it
    throttle: ThrottleVerdict | None = None  # where gains hold, and the thrust curve, apart

    @property
    def title(self) -> str:
        """Firmware, version and axis."""
        name, version = self.flown.firmware, ".".join(map(str, self.flown.version))
        return f"{name} {version}, rate loop of {AXES[self.flown.axis]}".replace(" ,", ",")

    @property
    def old(self) -> dict[str, float]:
        """What flew, of the gains and of filters that change."""
        angle = self.flown.angle
        around = {} if angle is None or angle.name not in self.new else {angle.name: angle.value}
        filters = {} if self.filters is None else dict(self.filters.flown)
        return self.flown.old | filters | around

    @property
    def at_once(self) -> tuple[str, ...]:
        """Those of the new parameters that have no third of the way."""
        if self.stages and self.stages[1].stable < 1:
            return tuple(self.new)
        return () if self.filters is None else self.filters.at_once

    @property
    def shared_filters(self) -> dict[str, float]:
        """New filters that the other axes have, too."""
        if self.filters is None or not self.new:
            return {}
        rows = firmware_named(self.flown.firmware).parameters
        return {name: self.new[name] for name in self.filters.flown if rows[name].axis < 0}

    @property
    def changes(self) -> tuple[ParameterChange, ...]:
        """From what flew to the proposal."""
        new, reasons = self.new, self._reasons
        return propose_changes(
            self.flown.firmware, self.old, new, reasons=reasons, beyond=list(new)
        )

    @property
    def _reasons(self) -> dict[str, str]:
        if not self.stages:
            return {}
        before, *_, after = self.stages
        why = (
            f"effect of a step of torque {after.rejection:.2f}, command noise {after.noise:.2f} of "
            f"what flew; Ms {before.peak:.2f} -> {after.peak:.2f}"
        )
        reasons = dict.fromkeys(self.new, why)
        far = _FAR * self.settings.change
        for name, old in self.flown.old.items():
            factor = self.new[name] / old if name in self.new else 1.0
            if max(factor, 1 / factor) >= far:
                reasons[name] += (
                    f"; at the limit of a factor of {self.settings.change:g} (`change`)"
                )
        if self.filters is not None:
            reasons |= dict.fromkeys(self.filters.flown, self.filters.reason)
        if before.angle is not None and after.angle is not None:
            reasons[after.angle.parameter] = (
                f"Ms of the angle loop {before.angle.peak:.2f} -> {after.angle.peak:.2f}"
            )
        return {name: reason for name, reason in reasons.items() if name in self.new}

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        fit = self.identification.fit
        plant: dict[str, object] = {"verdict": fit.verdict.summary}
        if fit.verdict.fitted:
            numbers = lambda values: dict(zip(fit.names, map(float, values), strict=True))
            plant |= numbers(fit.values) | {
                "standard_errors": numbers(fit.standard_errors),
                "intervals_95": {name: list(map(float, fit.interval(name))) for name in fit.names},
                "units": dict(zip(fit.names, fit.parameter_units, strict=True)),
                "band_rad_s": list(self.identification.band),
                "misfit_over_errors": float(np.sqrt(fit.chi_squared)),
            }
        part = lambda x: None if x is None else x.content()
        content = {
            "kind": self.kind,
            "verdict": self.verdict,
            "firmware": self.flown.firmware,
            "version": self.flown.version,
            "axis": AXES[self.flown.axis],
            "flown": self.flown.loop.parameters(),
            "unmodelled": self.flown.loop.unmodelled,
            "gyro_filters": self.flown.filters_text,
            "old": self.old,
            "new": dict(self.new),
            "stages": [stage.content() for stage in self.stages],
            "filters": part(self.filters),
            "noise": part(self.noise),
            "throttle": part(self.throttle),
            "reproduction": part(self.reproduction),
            "plant": plant,
            "settings": self.settings.content(),
            "identified_with": self.identification.settings.content(),
        }
        return {key: plain_content(value) for key, value in content.items()}

    def write(self, folder: str | Path) -> list[Path]:
        """Write the page, `autopilot.json`, and parameter files: without a proposal what flew.

        **Returns:** their paths.
        """
        return _write_axes(Path(folder), self, [self])

    def __str__(self) -> str:
        flown, lines = self.flown, [self.title]
        lines += [f"  {name} = {value:.6g}" for name, value in self.old.items()]
        lines += [f"  not modelled: {text}" for text in flown.loop.unmodelled]
        lines += [f"  {flown.filters_text}"] if flown.filters_text else []
        plant = "plant up to the gyro's filters, in the firmware's units"
        lines += ["", f"{plant}:\n{self.identification.fit}"]
        again = self.reproduction
        if again is not None and again.kind == "flown":  # else the verdict says it
            lines += ["", f"flown loop: {again.verdict}"]
        if self.stages:
            relaxed, angle = self.stages[0].relaxed is not None, self.stages[0].angle
            heads = "stable   worst Ms   resonance   crossover   delay margin   torque   noise"
            heads += "   Ms held" if relaxed else ""
            heads += "" if angle is None else "   Ms angle"
            lines += ["", f"{'on fresh plants':<20} {heads}"]
            for name, stage in zip(WAYS, self.stages, strict=False):
                row = _STAGE.format(name, *stage.cells())
                row += "" if stage.relaxed is None else f" {stage.relaxed:9.2f}"
                lines.append(row + ("" if stage.angle is None else f" {stage.angle.peak:10.2f}"))
            lines += [_OF_STAGES, *([_OF_HELD] if relaxed else [])]
            if angle is not None:
                flew = "as it flew" if angle.closed else "which was open in this flight"
                which = f"{angle.parameter} {angle.value:.3g}, {flew}"
                lines.append(f"(Ms angle: of the angle loop around it, {which})")
        throttle, curve = self.throttle, None
        if throttle is not None:
            curve = throttle.curve
            lines += ["", f"throttle: {throttle.text}"]
            if throttle.gains is not None:  # without other firmwares' parameters
                names = tuple(firmware_named(x).thrust_curve or "-" for x in firmware_names())
                lines += [x for x in str(throttle.gains).splitlines() if not x.startswith(names)]
        if throttle is not None and throttle.gains is not None and self.stages:
            row = lambda name, numbers: f"{name:<20} " + " ".join(f"{x:6.2f}" for x in numbers)
            lines += ["", row("worst Ms at throttle", throttle.logged)]
            lines += [row(x, stage.peaks) for x, stage in zip(WAYS, self.stages, strict=False)]
        if self.filters is not None:
            lines += ["", f"filters: {self.filters.text}"]
        if self.kind == "proposed":
            lines += ["", change_table(self.changes).rstrip(), "", limits_text(self.settings)]
        if curve is not None:
            lines += ["", f"thrust curve: {curve.text}"]
            if curve.change is not None:
                lines += ["", change_table([curve.change]).rstrip()]
        below = "it does not determine the plant (above)"
        return "\n".join([*lines, "", Message(self.verdict).in_words(lambda summary: below)])


_STAGE = "{:<20} {:>5} % {:>9} {:>9}   {:>8} Hz {:>9} ms {:>8} {:>7}"
_OF_STAGES = """(fresh plants: drawn from what the log leaves possible, not tuned on; Ms and
resonance: peaks of |S| and of the response to the set-point; torque: the rate after a step of
torque, noise: that of the command, both over those of what flew)"""
_OF_HELD = "(Ms held: without the integral, which iterm_relax holds while the set-point moves)"


_ORDER: tuple[Kind, ...] = ("proposed", "kept", "not to be flown", "cannot tell")


@dataclasses.dataclass(frozen=True)
class AxesProposal:
    """What `autopilot` found for each axis of a log; `str()` is its report as text."""

    settings: DesignSettings
    axes: Mapping[str, AutopilotProposal]  # by the axis' name
    unread: Mapping[str, str] = dataclasses.field(default_factory=dict)  # why one is not there

    @property
    def kind(self) -> Kind:
        """The best of the axes: "proposed" where one of them has gains."""
        kinds = {one.kind for one in self.axes.values()}
        return next(kind for kind in _ORDER if kind in kinds)

    @property
    def verdict(self) -> str:
        """In words, an axis each line."""
        lines = [f"{axis}: {one.verdict}" for axis, one in self.axes.items()]
        return "\n".join([*lines, *(f"{axis}: {why}" for axis, why in self.unread.items())])

    @property
    def new(self) -> dict[str, float]:
        """The proposed parameters of all axes by name."""
        new = ChainMap(*(dict(one.new) for one in self.axes.values()))
        return {name: new[name] for name in self.old if name in new}

    @property
    def old(self) -> dict[str, float]:
        """What flew of them; without a proposal what flew of all axes."""
        axes = self.axes.values()
        parts = [one.old for one in axes if one.new] or [one.old for one in axes]
        first = ChainMap(*parts)
        return {name: first[name] for part in parts for name in part}

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return {
            "kind": self.kind,
            "verdict": self.verdict,
            "old": self.old,
            "new": self.new,
            "axes": {axis: one.content() for axis, one in self.axes.items()},
            "unread": dict(self.unread),
            "settings": self.settings.content(),
        }

    def write(self, folder: str | Path) -> list[Path]:
        """Write the page, `autopilot.json`, and one parameter file of all axes for each stage.

        **Returns:** their paths.
        """
        return _write_axes(Path(folder), self, [*self.axes.values()])

    def __str__(self) -> str:
        parts = [str(one) for one in self.axes.values()]
        parts += [f"{axis}: {why}" for axis, why in self.unread.items()]
        if len(self.axes) > 1:
            parts.append(f"All axes:\n{self.verdict}")
        return "\n\n".join(parts)


def _write_axes(
    folder: Path, result: AutopilotProposal | AxesProposal, axes: Sequence[AutopilotProposal]
) -> list[Path]:
    """With the thrust curve, and one parameter file of all axes for each stage."""
    flown, old, new = axes[0].flown, result.old, result.new
    firmware, version = flown.firmware, flown.version or (2025, 12)
    overview = f"{firmware} {'.'.join(map(str, flown.version))}, rate loops".strip()

    def write(stem: Path, changes: Sequence[ParameterChange], title: str, revert: bool) -> Path:
        text = parameter_file(
            firmware, changes, revert=revert, version=version, profile=None, title=title,
            raised=[axis for axis in AXES if f"d_max_{axis}" in old],
        )  # fmt: skip
        return write_file(stem.with_suffix(f".{firmware_named(firmware).suffix}"), text)

    def files(folder: Path) -> list[Path]:
        curves = (one.throttle.curve for one in axes if one.throttle is not None)
        written, curve = [], next((x for x in curves if x is not None and x.change), None)
        if curve is not None and curve.change is not None:  # never in a file with gains
            title = f"{curve.name} alone: all loops and the throttle at hover change with it"
            back = f"the {curve.name} that flew"
            written = [
                write(folder / _CURVE, [curve.change], title, False),
                write(folder / f"{_CURVE}_revert", [curve.change], back, True),
            ]
        if not new:
            rows = [(find_parameter(firmware, name), x) for name, x in old.items()]
            same = [ParameterChange(row, x, x) for row, x in rows]
            return [*written, write(folder / "proposal_revert", same, "what flew", True)]
        parts = [one for one in axes if one.new]
        files = write_parameter_files(
            folder, firmware, old, new, beyond=list(new),
            reasons={name: x for one in reversed(parts) for name, x in one._reasons.items()},
            at_once=[name for one in parts for name in one.at_once],
            version=version, profile=None,
        )  # fmt: skip
        return [*written, *files.stages, files.revert, files.table]

    pages = lambda origin: [pilot_page(one, origin, overview) for one in axes]
    log, settings = axes[0].identification.paths[0], result.settings
    return write_result(folder, log, settings, result.content(), files, pages)


def write_result(
    folder: Path, log: Path, settings: DesignSettings, content: Mapping[str, object],
    files: Callable[[Path], Sequence[Path]], pages: Callable[[Provenance], Sequence[PilotPage]],
) -> list[Path]:  # fmt: skip
    """The page, the JSON with where it is from, and what `files` writes: all, or nothing."""
    announce("parameter files")
    stated = {k: v for k, v in settings.content().items() if v is not None}
    words = ["jaxquad", "autopilot", str(log), *settings.words()]
    origin = provenance(log, command=shlex.join(words), settings=stated)
    with_origin = {**content, "provenance": origin.content()}
    with staged_files(folder) as draft:
        stored, written = write_json(draft / "autopilot.json", with_origin), files(draft)
        announce("the page")
        paths = [write_pilot_page(draft / "autopilot.html", *pages(origin)), stored, *written]
    return [folder / path.name for path in paths]


def beyond_limits(
    flown: Any, third: Any, proposed: Any, limits: Limits, edge: float, *, loud: float = 1.0
) -> list[str]:
    """In words, what of a `Stage` or `ADRCStage` is beyond a limit, or `edge`, in rad/s."""
    share, hertz, limit = 100 * min(third.stable, proposed.stable), 2 * np.pi, limits.sensitivity
    most, loudest = max(limit, flown.peak), loud * limits.noise
    above = lambda text, value, highest: [text] if value > highest else []
    peak, resonance, noise = proposed.peak, proposed.resonance, proposed.noise
    return [
        *above(f"only {share:.1f} % of the loops are stable", 100, share),
        *above(f"the worst Ms is {peak:.2f}, above {limit:g}", peak, limit),
        *above(
            f"the worst peak from set-point to rate is {resonance:.2f}, above "
            f"{limits.resonance:g}",
            resonance, limits.resonance,
        ),
        *above(
            f"a third of the way the worst Ms is {third.peak:.2f}, above {most:.3g}",
            third.peak, most,
        ),
        *above(
            f"the command's noise is {noise:.2f} of what flew, above {limits.noise:g}",
            noise, loudest,
        ),
        *above(
            f"the crossover of {proposed.crossover / hertz:.1f} Hz is beyond the identified "
            f"{edge / hertz:.1f} Hz",
            proposed.crossover, edge,
        ),
    ]  # fmt: skip


def beyond_angle(angle: OuterStage, limits: Limits) -> list[str]:
    """In words, which limits an angle loop does not keep."""
    around = f"of the angle loop ({angle.parameter} {angle.value:.3g})"
    above = lambda what, value, most: (
        [f"the worst {what} {around} is {value:.2f}, above {most:g}"] if value > most else []
    )
    unstable = [f"only {100 * angle.stable:.1f} % {around} are stable"] if angle.stable < 1 else []
    peaks = above("Ms", angle.peak, limits.sensitivity)
    return unstable + peaks + above("peak", angle.resonance, limits.resonance)


_WORTH = 0.95  # of the flown effect of torque, above which gains are not worth a change
_ALLOWED = 1.03  # of a limit that the search kept on the ratio of filters, for the law itself
_NEARLY = 1.05  # of the limit of the resonance, which a third of the way may reach without a word
SWINGING = 0.1  # of a flight with a motor at its limit, from which the motors bound a swing
BELIEVED = 0.5  # share of plants on which the loop that flew has to be stable


def judge(
    stages: Sequence[Stage], settings: DesignSettings, edge: float, shared: SharedChange | None,
    throttles: Sequence[float], swings: float = 0.0,
) -> tuple[Kind, str]:  # fmt: skip
    """The verdict; `swings` is the share of the flight with a motor at its limit."""
    flown, third, new = stages
    bounded = flown.stable < BELIEVED and swings > SWINGING  # by the motors alone
    third = new if bounded else third
    beyond = beyond_limits(flown, third, new, settings, edge, loud=_ALLOWED)
    if shared is not None and shared.noise > _ALLOWED * settings.noise:
        beyond.append(
            f"the command's noise on another axis is {shared.noise:.2f} of what flew, above "
            f"{settings.noise:g}"
        )
    if new.angle is not None and new.angle.closed:
        beyond += beyond_angle(new.angle, settings)
    if beyond and flown.stable < BELIEVED and not bounded:
        return "cannot tell", (
            "this log cannot tell: the loop flew, but with the gains that flew it is stable on "
            f"{100 * flown.stable:.1f} % only of the plants within the error bars, so most of "
            "these are not the vehicle. Fly more excitation on this axis (a chirp of the rate "
            "set-point, or strong and quick stick)"
        )
    if beyond:
        return "not to be flown", (
            f"no gains are proposed: {'; '.join(beyond)}. Allow more (`sensitivity`, `resonance`, "
            "`noise`, `change`), or fly more excitation"
        )
    limit, plants = settings.sensitivity, f"{settings.fresh} fresh plants"
    if throttles:
        at = ", ".join(f"{level:.2f}" for level in throttles)
        plants += f" at each of the throttles {at}"
    better = f"{new.rejection:.2f} of the flown effect of a step of torque"
    within = flown.peak <= limit and flown.resonance <= settings.resonance
    if flown.angle is not None and flown.angle.closed:
        within = within and not beyond_angle(flown.angle, settings)
    if flown.stable == 1 and within and new.rejection > _WORTH:
        return "kept", (
            f"what flew is kept: within the limits the best gains leave {better}. Its worst Ms on "
            f"{plants} is {flown.peak:.2f}"
        )
    around, before, after = "", flown.angle, new.angle
    if before is not None and after is not None and after.closed:
        moved = f"{after.parameter} {before.value:.3g}"
        moved += f" -> {after.value:.3g}" if after.value != before.value else " as it flew"
        around = f"; with the angle loop around it ({moved}) worst Ms {after.peak:.2f}"
    proposed = f"proposed: stable on all {plants}, worst Ms {new.peak:.2f} of at most {limit:g}"
    if bounded:
        return "proposed", (
            f"{proposed}{around}. What flew is stable on {100 * flown.stable:.0f} % of them: "
            f"it swung between the motors' limits ({100 * swings:.0f} % of the flight). A third of "
            "the way would swing, too, so both files hold all of it, and gains may be further from "
            f"what flew than {settings.change:g} times (`change`): hover low with it first"
        )
    # A third of the way from a bad loop may be beyond the limits, too.
    first = "Load the file for a third of the way first"
    if not (third.peak <= limit and third.resonance <= _NEARLY * settings.resonance):
        first = (
            f"The file for a third of the way is beyond the limits (worst Ms {third.peak:.2f}, "
            f"peak from set-point to rate {third.resonance:.2f}), but better than what flew "
            f"({flown.peak:.2f}, {flown.resonance:.2f}): hover with it alone, then load all of it"
        )
    return "proposed", f"{proposed}, {better}{around}. {first}"
