"""What `autopilot` found in a log: its report as text, its JSON, and the files that it writes."""

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxquad._core import announce, Message, plain_content, write_file
from jaxquad.records import AXES
from jaxquad.report import Provenance, provenance, write_json

from ._files import (
    change_table,
    parameter_file,
    ParameterChange,
    propose_changes,
    write_parameter_files,
)
from ._firmware import firmware_named
from ._flight_channels import FlightChannels, FlownAutopilot
from ._gyro_noise import GyroNoise
from ._identified import DesignSettings, IdentifiedPlant
from ._law_check import LoopCheck
from ._over_throttle import ThrottleVerdict
from ._page import write_pilot_page
from ._parameters import find_parameter
from ._pilot_page import pilot_page
from ._rate_design import FilterVerdict, Kind
from ._rate_loops import PlantSource
from ._stages import limits_text, Stage


_THIRD, _ALL = 1 / 3, 1.0
_STEM = "proposal"


@dataclasses.dataclass(frozen=True)
class ProposedParameters:
    """Old and new values by the firmware's names, of one axis or of all.

    **Attributes:**

    - `old`: what flew; `new`: what is proposed, empty where nothing is.
    - `reasons`: for each new one; `at_once`: those that have no third of the way.
    """

    firmware: str
    version: tuple[int, ...]
    old: dict[str, float]
    new: dict[str, float] = dataclasses.field(default_factory=dict)
    reasons: Mapping[str, str] = dataclasses.field(default_factory=dict)
    at_once: tuple[str, ...] = ()

    @classmethod
    def joined(cls, parts: Sequence["ProposedParameters"]) -> "ProposedParameters":
        """Of several axes; what they share is the first one's."""
        first, old, new, reasons = parts[0], {}, {}, {}
        for part in reversed(parts):
            old, new, reasons = old | part.old, new | part.new, reasons | dict(part.reasons)
        at_once = tuple(dict.fromkeys(name for part in parts for name in part.at_once))
        order = {name: None for part in parts for name in part.old}
        in_order = lambda values: {name: values[name] for name in order if name in values}
        return cls(first.firmware, first.version, in_order(old), in_order(new), reasons, at_once)

    @property
    def changes(self) -> tuple[ParameterChange, ...]:
        """From what flew to the proposal."""
        return propose_changes(
            self.firmware, self.old, self.new, reasons=self.reasons, beyond=list(self.new)
        )

    def write(self, folder: Path) -> list[Path]:
        """A third of the way, all of it, what reverts them and a table; or what flew alone."""
        if not self.new:
            same = [
                ParameterChange(find_parameter(self.firmware, name), value, value)
                for name, value in self.old.items()
            ]
            return [self.write_one(f"{_STEM}_revert", same, "what flew", folder, revert=True)]
        files = write_parameter_files(
            folder, self.firmware, self.old, self.new, stem=_STEM, shares=(_THIRD, _ALL),
            reasons=self.reasons, beyond=list(self.new), version=self.version or (2025, 12),
            at_once=self.at_once, profile=None,
        )  # fmt: skip
        return [*files.stages, files.revert, files.table]

    def write_one(
        self, stem: str, changes: Sequence[ParameterChange], title: str, folder: Path, *,
        revert: bool,
    ) -> Path:  # fmt: skip
        """One file with these changes, or with what they were."""
        raised = [axis for axis in AXES if f"d_max_{axis}" in self.old]
        text = parameter_file(
            self.firmware, changes, revert=revert, version=self.version or (2025, 12),
            raised=raised, title=title, profile=None,
        )  # fmt: skip
        return write_file(folder / f"{stem}.{firmware_named(self.firmware).suffix}", text)


_CURVE = "thrust_curve"
_FAR = 0.98  # of the factor by which a gain may change


@dataclasses.dataclass(frozen=True)
class AutopilotProposal:
    """What `autopilot` found in a log, and what it proposes; `str()` is its report as text.

    **Attributes:**

    - `kind`: "proposed"; "kept" where what flew is as good; "cannot tell" where the log does not
      show the plant or the loop; "not to be flown" where no gains keep the limits.
    - `verdict`: the same in words, and what to do.
    - `identification`: of the plant, in the firmware's units, with the gyro's filters divided out.
    - `flown`: the loop that flew.
    - `reproduction`: that loop and plant compared with the flight; None without a plant.
    - `stages`: on fresh plants what flew, then a third of the way and all of it; empty where the
      log cannot tell.
    - `old`, `new`: the parameters by name; `new` is empty where nothing is proposed.
    - `filters`: what freeing the filters brings, or why they stay as they flew; None without a
      search.
    - `noise`: of the gyros, where the log shows it; `flight`: the channels that were read.
    - `throttle`: at which throttles the gains hold, and the thrust curve, which is proposed apart
      from them; None where the log cannot tell.
    """

    kind: Kind
    verdict: str
    settings: DesignSettings
    identification: IdentifiedPlant
    flown: FlownAutopilot
    reproduction: LoopCheck | None
    stages: tuple[Stage, ...] = ()
    new: Mapping[str, float] = dataclasses.field(default_factory=dict)
    filters: FilterVerdict | None = None
    noise: GyroNoise | None = None
    flight: FlightChannels | None = None
    throttle: ThrottleVerdict | None = None

    @property
    def plants(self) -> PlantSource:
        """What the log leaves possible."""
        plant, measured = self.identification, self.flown.measured
        if self.throttle is not None:
            return self.throttle.plants(plant, measured)
        return PlantSource(plant.fit, plant.records[0].output_units[0], filters=measured)

    @property
    def old(self) -> dict[str, float]:
        """What flew, of the gains and of filters that change."""
        angle = self.flown.angle
        around = {} if angle is None or angle.name not in self.new else {angle.name: angle.value}
        filters = {} if self.filters is None else dict(self.filters.flown)
        return self.flown.old | filters | around

    @property
    def parameters(self) -> ProposedParameters:
        """Old and new values by the firmware's names."""
        at_once = () if self.filters is None else self.filters.at_once
        if self.stages and self.stages[1].stable < 1:
            at_once = tuple(self.new)
        return ProposedParameters(
            self.flown.firmware, self.flown.version, self.old, dict(self.new), self._reasons,
            at_once,
        )  # fmt: skip

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
        return self.parameters.changes

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
        content = {
            "kind": self.kind,
            "verdict": self.verdict,
            "firmware": self.flown.firmware,
            "version": self.flown.version,
            "axis": AXES[self.flown.axis],
            "flown": dict(self.flown.parameters),
            "unmodelled": self.flown.unmodelled,
            "gyro_filters": self.flown.filters_text,
            "old": self.old,
            "new": dict(self.new),
            "stages": [stage.content() for stage in self.stages],
            "filters": None if self.filters is None else self.filters.content(),
            "noise": None if self.noise is None else self.noise.content(),
            "throttle": None if self.throttle is None else self.throttle.content(),
            "reproduction": None if self.reproduction is None else self.reproduction.content(),
            "plant": self._plant,
            "settings": self.settings.content(),
            "identified_with": self.identification.settings.content(),
        }
        return {key: plain_content(value) for key, value in content.items()}

    @property
    def _plant(self) -> dict[str, object]:
        fit = self.identification.fit
        if not fit.verdict.fitted:
            return {"verdict": fit.verdict.summary}
        errors = zip(fit.names, map(float, fit.standard_errors), strict=True)
        return {
            "verdict": fit.verdict.summary,
            **dict(zip(fit.names, map(float, fit.values), strict=True)),
            "standard_errors": dict(errors),
            "intervals_95": {name: list(map(float, fit.interval(name))) for name in fit.names},
            "units": dict(zip(fit.names, fit.parameter_units, strict=True)),
            "band_rad_s": list(self.identification.band),
            "misfit_over_errors": float(np.sqrt(fit.chi_squared)),
        }

    def write(self, folder: str | Path) -> list[Path]:
        """Write the page, `autopilot.json`, and parameter files: without a proposal what flew.

        **Returns:** their paths.
        """
        announce("parameter files")
        folder, origin = Path(folder), self.provenance(self.settings)
        stored = write_json(
            folder / "autopilot.json", self.content() | {"provenance": origin.content()}
        )
        announce("the page")
        page = write_pilot_page(folder / "autopilot.html", pilot_page(self, origin))
        return [page, stored, *self.write_curve(folder), *self.parameters.write(folder)]

    def provenance(self, settings: DesignSettings) -> Provenance:
        """Of a result with these settings."""
        stated = {k: v for k, v in settings.content().items() if v is not None}
        log = self.identification.path
        words = ["jaxquad", "autopilot", str(log), *settings.words()]
        return provenance(log, command=shlex.join(words), settings=stated)

    def write_curve(self, folder: Path) -> list[Path]:
        """The thrust curve's parameter and what flew of it, never in a file with gains."""
        curve = None if self.throttle is None else self.throttle.curve
        if curve is None or curve.change is None:
            return []
        titles = {
            "": f"{curve.name} alone: all loops and the throttle at hover change with it",
            "_revert": f"the {curve.name} that flew",
        }
        return [
            self.parameters.write_one(
                f"{_CURVE}{end}", [curve.change], title, folder, revert=bool(end)
            )
            for end, title in titles.items()
        ]

    def __str__(self) -> str:
        flown = self.flown
        version = ".".join(map(str, flown.version))
        lines = [f"{flown.firmware} {version}, rate loop of {AXES[flown.axis]}".replace(" ,", ",")]
        lines += [f"  {name} = {value:.6g}" for name, value in self.old.items()]
        lines += [f"  not modelled: {text}" for text in flown.unmodelled]
        lines += [f"  {flown.filters_text}"] if flown.filters_text else []
        plant = "plant up to the gyro's filters, in the firmware's units"
        lines += ["", f"{plant}:\n{self.identification.fit}"]
        again = self.reproduction
        if again is not None and again.kind == "flown":  # else the verdict says it
            lines += ["", f"flown loop: {again.verdict}"]
        if self.stages:
            lines += ["", _stage_table(self.stages)]
        if self.throttle is not None:
            lines += ["", *_throttle_lines(self.throttle, self.stages)]
        if self.filters is not None:
            lines += ["", f"filters: {self.filters.text}"]
        if self.kind == "proposed":
            lines += ["", change_table(self.changes).rstrip(), "", limits_text(self.settings)]
        curve = None if self.throttle is None else self.throttle.curve
        if curve is not None:
            lines += ["", f"thrust curve: {curve.text}"]
            if curve.change is not None:
                lines += ["", change_table([curve.change]).rstrip()]
        below = "it does not determine the plant (above)"
        return "\n".join([*lines, "", Message(self.verdict).in_words(lambda summary: below)])


_WAYS = ("what flew", "a third of the way", "all of it")


_OF_STAGES = """(fresh plants: drawn from what the log leaves possible, not tuned on; Ms and
resonance: peaks of |S| and of the response to the set-point; torque: the rate after a step of
torque, noise: that of the command, both over those of what flew)"""
_OF_HELD = "(Ms held: without the integral, which iterm_relax holds while the set-point moves)"


def _throttle_lines(throttle: ThrottleVerdict, stages: tuple[Stage, ...]) -> list[str]:
    lines = [f"throttle: {throttle.text}"]
    if throttle.gains is None:
        return lines
    lines.append(throttle.table)
    if stages:
        heads = " ".join(f"{level:6.2f}" for level in throttle.logged)
        lines += ["", f"{'worst Ms at throttle':<20} {heads}"]
        for name, stage in zip(_WAYS, stages, strict=False):
            lines.append(f"{name:<20} " + " ".join(f"{peak:6.2f}" for peak in stage.peaks))
    return lines


def _stage_table(stages: tuple[Stage, ...]) -> str:
    first = stages[0]
    relaxed = "   Ms held" if first.relaxed is not None else ""
    around = "   Ms angle" if first.angle is not None else ""
    heads = "stable   worst Ms   resonance   crossover   delay margin   torque   noise"
    rows = [f"{'on fresh plants':<20} {heads}{relaxed}{around}"]
    for name, stage in zip(_WAYS, stages, strict=False):
        row = (
            f"{name:<20} {100 * stage.stable:5.1f} % {stage.peak:9.2f} {stage.resonance:9.2f} "
            f"  {stage.crossover / (2 * np.pi):8.1f} Hz {stage.margin_text:>9} ms "
            f"{stage.rejection:8.2f} {stage.noise:7.2f}"
        )
        row += "" if stage.relaxed is None else f" {stage.relaxed:9.2f}"
        rows.append(row + ("" if stage.angle is None else f" {stage.angle.peak:10.2f}"))
    rows += [_OF_STAGES, *([_OF_HELD] if relaxed else [])]
    if (angle := first.angle) is not None:
        flew = "as it flew" if angle.closed else "which was open in this flight"
        which = f"{angle.parameter} {angle.value:.3g}, {flew}"
        rows.append(f"(Ms angle: of the angle loop around it, {which})")
    return "\n".join(rows)


_ORDER: tuple[Kind, ...] = ("proposed", "kept", "not to be flown", "cannot tell")


@dataclasses.dataclass(frozen=True)
class AxesProposal:
    """What `autopilot` found for each axis of a log; `str()` is its report as text.

    **Attributes:**

    - `axes`: an `AutopilotProposal` by the axis' name.
    - `unread`: why an axis is not among them.
    """

    settings: DesignSettings
    axes: Mapping[str, AutopilotProposal]
    unread: Mapping[str, str] = dataclasses.field(default_factory=dict)

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
        return self._parameters.new

    @property
    def old(self) -> dict[str, float]:
        """What flew of them; without a proposal what flew of all axes."""
        return self._parameters.old

    @property
    def _parameters(self) -> ProposedParameters:
        parts = [one.parameters for one in self.axes.values()]
        proposed = [part for part in parts if part.new]
        return ProposedParameters.joined(proposed or parts)

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
        announce("parameter files")
        folder, first = Path(folder), next(iter(self.axes.values()))
        origin = first.provenance(self.settings)
        stored = write_json(
            folder / "autopilot.json", self.content() | {"provenance": origin.content()}
        )
        curves = (one.write_curve(folder) for one in self.axes.values())
        curve = next((paths for paths in curves if paths), [])
        files = self._parameters.write(folder)
        announce("the page")
        flown = first.flown
        overview = f"{flown.firmware} {'.'.join(map(str, flown.version))}, rate loops".strip()
        pages = [pilot_page(one, origin, overview) for one in self.axes.values()]
        page = write_pilot_page(folder / "autopilot.html", *pages)
        return [page, stored, *curve, *files]

    def __str__(self) -> str:
        parts = [str(one) for one in self.axes.values()]
        parts += [f"{axis}: {why}" for axis, why in self.unread.items()]
        if len(self.axes) > 1:
            parts.append(f"All axes:\n{self.verdict}")
        return "\n\n".join(parts)
