"""From the log of an autopilot to parameters for it: read, identify, reproduce, tune, write."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import numpy as np

from jaxquad._core import announce, plain_content, write_file
from jaxquad.control.autopilots import (
    ardupilot_loop,
    betaflight_loop,
    find_parameter,
    Firmware,
    px4_loop,
    without_gyro_filters,
)
from jaxquad.export import (
    change_table,
    parameter_file,
    ParameterChange,
    propose_changes,
    write_parameter_files,
)
from jaxquad.identify import usable
from jaxquad.loops import FlownLoop as Reproduction, reproduce_flight
from jaxquad.records import AXES, Proposal, read_settings
from jaxquad.report import provenance, write_json
from jaxquad.spectra import (
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
)

from ._identify import Identification, identify
from ._kinds import SettingsError
from ._log import propose_settings, read_records
from ._rate_gains import (
    ceiling_in,
    certify_gains,
    gains_in,
    gains_of,
    law_responses,
    make_loops,
    parameters_of,
    RateLaw,
    search_gains,
    Stage,
    Targets,
)
from ._settings import IdentifySettings
from ._tune_settings import AutopilotSettings


Kind = Literal["proposed", "kept", "cannot tell", "not to be flown"]
_THIRD, _ALL = 1 / 3, 1.0
_WORTH = 0.95  # of the flown effect of torque, above which gains are not worth a change
_STEM = "proposal"
_INJECTED = "SIDD.Targ"  # ArduPilot's chirp
_CERTIFICATES = 3  # at most: the worst plants of one that fails are tuned on, too
_WORST = 16


@dataclasses.dataclass(frozen=True)
class FlownAutopilot:
    """The rate loop of a log: firmware, version, law and what of it is not modelled."""

    firmware: Firmware
    version: tuple[int, ...]
    axis: int
    law: RateLaw
    parameters: Mapping[str, float]
    unmodelled: tuple[str, ...]

    @property
    def old(self) -> dict[str, float]:
        """P, I and D of the axis by the firmware's names."""
        return parameters_of(self.law, self.axis, gains_of(self.law, self.axis))


@dataclasses.dataclass(frozen=True)
class AutopilotProposal:
    """What `autopilot` found in a log, and what it proposes; `str()` is its report as text.

    **Attributes:**

    - `kind`: "proposed"; "kept" where what flew is as good; "cannot tell" where the log does not
      show the plant or the loop; "not to be flown" where no gains keep the limits.
    - `verdict`: the same in words, and what to do.
    - `identification`: of the plant, in the firmware's units.
    - `flown`: the loop that flew.
    - `reproduction`: that loop and plant compared with the flight; None without a plant.
    - `stages`: on fresh plants what flew, then a third of the way and all of it; empty where the
      log cannot tell.
    - `old`, `new`: the parameters by name; `new` is empty where nothing is proposed.
    """

    kind: Kind
    verdict: str
    settings: AutopilotSettings
    identification: Identification
    flown: FlownAutopilot
    reproduction: Reproduction | None
    stages: tuple[Stage, ...] = ()
    new: Mapping[str, float] = dataclasses.field(default_factory=dict)

    @property
    def old(self) -> dict[str, float]:
        """What flew."""
        return self.flown.old

    @property
    def changes(self) -> tuple[ParameterChange, ...]:
        """From what flew to the proposal."""
        return propose_changes(
            self.flown.firmware, self.old, self.new, reasons=self._reasons, beyond=list(self.new)
        )

    @property
    def _reasons(self) -> dict[str, str]:
        if not self.stages:
            return {}
        before, *_, after = self.stages
        why = (
            f"effect of torque {after.rejection:.2f} and command noise {after.noise:.2f} of what "
            f"flew; Ms {before.peak:.2f} -> {after.peak:.2f}"
        )
        return dict.fromkeys(self.new, why)

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        found = {
            "kind": self.kind,
            "verdict": self.verdict,
            "firmware": self.flown.firmware,
            "version": self.flown.version,
            "axis": AXES[self.flown.axis],
            "flown": dict(self.flown.parameters),
            "unmodelled": self.flown.unmodelled,
            "old": self.old,
            "new": dict(self.new),
            "stages": [stage._asdict() for stage in self.stages],
            "reproduction": None if self.reproduction is None else self.reproduction.to_dict(),
            "plant": self._plant,
            "settings": self.settings.content(),
            "identified_with": self.identification.settings.content(),
        }
        return {key: plain_content(value) for key, value in found.items()}

    @property
    def _plant(self) -> dict[str, object]:
        fit = self.identification.fit
        if not fit.verdict.fitted:
            return {"verdict": fit.verdict.summary}
        return {
            "verdict": fit.verdict.summary,
            **dict(zip(fit.names, map(float, fit.values), strict=True)),
        }

    def write(self, folder: str | Path) -> list[Path]:
        """Write `autopilot.json` and the parameter files; without a proposal only what flew.

        **Returns:** their paths.
        """
        announce("parameter files")
        folder, flown = Path(folder), self.flown
        known = {k: v for k, v in self.settings.content().items() if v is not None}
        origin = provenance(*self.identification.paths, settings=known)
        stored = write_json(
            folder / "autopilot.json", self.content() | {"provenance": origin.content()}
        )
        if self.kind != "proposed":
            return [stored, self._write_flown(folder)]
        files = write_parameter_files(
            folder, flown.firmware, self.old, self.new, stem=_STEM, shares=(_THIRD, _ALL),
            reasons=self._reasons, beyond=list(self.new), version=flown.version or (2025, 12),
        )  # fmt: skip
        return [stored, *files.stages, files.revert, files.table]

    def _write_flown(self, folder: Path) -> Path:
        flown = self.flown
        same = [
            ParameterChange(find_parameter(flown.firmware, name), value, value)
            for name, value in self.old.items()
        ]
        raised = [AXES[flown.axis]] if f"d_max_{AXES[flown.axis]}" in self.old else []
        text = parameter_file(
            flown.firmware, same, revert=True, version=flown.version or (2025, 12), raised=raised,
            title="what flew",
        )  # fmt: skip
        suffix = {"betaflight": "txt", "px4": "params", "ardupilot": "param"}[flown.firmware]
        return write_file(folder / f"{_STEM}_revert.{suffix}", text)

    def __str__(self) -> str:
        flown = self.flown
        version = ".".join(map(str, flown.version))
        lines = [f"{flown.firmware} {version}, rate loop of {AXES[flown.axis]}".replace(" ,", ",")]
        lines += [f"  {name} = {value:.6g}" for name, value in self.old.items()]
        lines += [f"  not modelled: {each}" for each in flown.unmodelled]
        lines += ["", f"plant, in the firmware's units:\n{self.identification.fit}"]
        if self.reproduction is not None:
            lines += ["", f"flown loop: {self.reproduction.verdict}"]
        if self.stages:
            lines += ["", _stage_table(self.stages)]
        if self.kind == "proposed":
            lines += ["", change_table(self.changes).rstrip()]
        return "\n".join([*lines, "", self.verdict])


def _stage_table(stages: tuple[Stage, ...]) -> str:
    names = ("what flew", "a third of the way", "all of it")
    rows = [f"{'on fresh plants':<20} stable   worst Ms   resonance   crossover   torque   noise"]
    for name, stage in zip(names, stages, strict=False):
        rows.append(
            f"{name:<20} {100 * stage.stable:5.1f} % {stage.peak:9.2f} {stage.resonance:9.2f} "
            f"  {stage.crossover / (2 * np.pi):8.1f} Hz {stage.rejection:8.2f} {stage.noise:7.2f}"
        )
    return "\n".join(rows)


def autopilot(path: str | Path, settings: AutopilotSettings | None = None) -> AutopilotProposal:
    """Tune the gains of the autopilot that flew a log, as `jaxquad autopilot` does.

    Gains and filters are read from the log, the plant is identified in the firmware's own units up
    to the logged rate, and the loop of both has to reproduce the flight. P, I and D of the rate
    loop are searched over the plants that the fit leaves uncertain: least rate after a step of
    torque, with limits on the peak of |S|, on the command's noise and on the crossover, which stays
    in the identified band. The rounded numbers are certified on fresh plants, as is a third of the
    way. Filters, feed-forward and the angle loop stay as they are. Loops are taken as linear: no
    limit of the motors is simulated. Source: docs/autopilots.md.

    **Arguments:**

    - `path`: a log of Betaflight, PX4 or ArduPilot.
    - `settings`: the axis, and what is kept.

    **Returns:** an `AutopilotProposal`; nothing is written before its `.write(folder)`.

    **Raises:** `RecordError` or `ReadError` (both ValueErrors) for a log that cannot be used, and
    ValueError for one without the parameters of the loop.

    !!! example

        ```python
        settings = jq.workflows.AutopilotSettings(axis="roll")
        found = jq.workflows.autopilot("flight.bbl", settings)
        print(found)
        found.write("results/flight/autopilot")
        ```
    """
    path, settings = Path(path), settings or AutopilotSettings()
    asked, proposal = _channels_of(path, settings)
    announce("gains and filters that flew")
    flown = read_flown(path, proposal, settings)
    found = identify(path, asked)
    known = (settings, found, flown)
    if not found.fit.identifiable:
        why = f"this log cannot tell: {found.fit.verdict.summary}; {_FLY}"
        return AutopilotProposal("cannot tell", why, *known, None)
    announce("the flown loop again")
    again = _reproduce(found, flown)
    if again.kind != "flown":
        why = again.verdict
        text = why if again.kind == "unknown" else f"this log cannot tell: {why}"
        return AutopilotProposal("cannot tell", text, *known, again)
    return _designed(settings, found, flown, again)


_FLY = "fly a chirp of the rate set-point, or strong and quick stick on this axis, for 20 s or more"


def _channels_of(path: Path, settings: AutopilotSettings) -> tuple[IdentifySettings, Proposal]:
    """What the log itself says is command, rate and reference."""
    asked = IdentifySettings(
        axis=settings.axis, start=settings.start, stop=settings.stop, band=settings.band
    )
    found, proposal = propose_settings(path, asked)
    if proposal is None:
        raise SettingsError(f"{path} proposes no channels: give the log of an autopilot")
    return found, proposal


def read_flown(path: Path, proposal: Proposal, settings: AutopilotSettings) -> FlownAutopilot:
    """The loop that flew. Raises ValueError where the log does not hold its gains."""
    setup = proposal.setup
    prefix = setup.rate.rpartition("gyroADC")[0].rstrip(".")
    at = None if proposal.vehicle == "betaflight" else setup.start
    given = read_settings(path, log=prefix, at=at)
    axis = AXES.index(setup.axis)
    if proposal.vehicle == "betaflight":
        loop = betaflight_loop(given.values, given.version, throttle=settings.throttle)
        firmware: Firmware = "betaflight"
    elif proposal.vehicle == "px4":
        loop, firmware = px4_loop(given.values), "px4"
    else:
        loop, firmware = ardupilot_loop(given.values), "ardupilot"
    law = loop.law
    if not np.any(gains_of(law, axis) > 0):
        raise ValueError(
            f"{path}: P, I and D of {setup.axis} are all 0, so there is no rate loop to tune"
        )
    return FlownAutopilot(
        firmware, tuple(given.version), axis, law, loop.parameters(), loop.unmodelled
    )


def _reproduce(found: Identification, flown: FlownAutopilot) -> Reproduction:
    """The flown loop compared with the log."""
    settings, [unit] = found.settings, found.records[0].output_units
    if _INJECTED in (settings.input or ""):
        return _reproduce_law(found, flown)
    setpoint = _setpoint_of(found.records[0].output_names[0], flown)
    try:
        reference = None if settings.reference == setpoint else settings.reference
        response = _response_of(found, input=setpoint, reference=reference)
    except ValueError:  # the stick is the set-point in another unit: that one is external
        response = _response_of(found, input=setpoint, reference=None)
    return reproduce_flight(
        found.fit, without_gyro_filters(flown.law), response,
        unit="deg/s" if unit == "deg/s" else "rad/s", axis=flown.axis,
    )  # fmt: skip


def _response_of(found: Identification, **changed: str | None) -> FrequencyResponse:
    """The response between other channels of the log, joint where there is a reference."""
    records = read_records(found.path, dataclasses.replace(found.settings, **changed))
    estimator = JointInputOutput() if changed["reference"] else LocalPolynomial()
    return frequency_response(list(records), found.frf.omega, estimator=estimator)


def _reproduce_law(found: Identification, flown: FlownAutopilot) -> Reproduction:
    """Where ArduPilot's chirp enters at the mixer: the law's output, of set-point and rate.

    From the chirp to all three. The noise of the rate is in the output, too, so that the error of
    the latter counts alone.
    """
    letter, [unit] = AXES[flown.axis][0].upper(), found.records[0].output_units
    of = lambda name: _response_of(found, input=_INJECTED, output=name, reference=None)
    output, rate, setpoint = map(of, (f"RATE.{letter}Out", f"RATE.{letter}", f"RATE.{letter}Des"))
    omega, only = np.asarray(output.omega), lambda x: np.asarray(x)[:, 0, 0]
    ahead, back = law_responses(without_gyro_filters(flown.law), flown.axis, omega)
    factor = np.pi / 180 if unit == "deg/s" else 1.0
    predicted = factor * (ahead * only(setpoint.response) + back * only(rate.response))
    measured, error = only(output.response), only(output.random_error)
    used = only(usable(output, None, 0.6))
    weight, off = 1 / error[used] ** 2, (measured / predicted - 1)[used]
    total = max(float(np.sum(weight)), 1e-12)
    scale = float(np.sum(weight * off.real)) / total
    left = float(np.sum(weight * np.abs(off - scale) ** 2)) / max(2 * off.size, 1)
    doubt = float(np.sqrt(max(left, 1.0) / total))
    return Reproduction(
        omega, measured, error, predicted, np.zeros_like(error), used, 1 + scale, doubt
    )


def _setpoint_of(rate: str, flown: FlownAutopilot) -> str:
    """The channel of the rate's set-point."""
    name = AXES[flown.axis]
    if flown.firmware == "px4":
        return f"vehicle_rates_setpoint.{name}"
    if flown.firmware == "ardupilot":
        return f"RATE.{name[0].upper()}Des"
    return rate.replace("gyroADC", "setpoint")


def _designed(
    settings: AutopilotSettings,
    found: Identification,
    flown: FlownAutopilot,
    again: Reproduction,
) -> AutopilotProposal:
    """The search, and its rounded numbers on fresh plants."""
    law, axis, unit = flown.law, flown.axis, found.records[0].output_units[0]
    draw = lambda count, seed: make_loops(law, axis, found.fit, unit, count, settings.seed + seed)
    loops, before = draw(settings.members, 0), gains_of(law, axis)
    targets = Targets(
        settings.sensitivity, settings.resonance, settings.noise, settings.change, found.band[1]
    )
    new, stages = flown.old, ()
    for attempt in range(1, _CERTIFICATES + 1):
        announce(f"searching gains on {len(loops.plants)} plants")
        new = parameters_of(law, axis, search_gains(loops, before, targets, flown.firmware, axis))
        announce(f"certifying the rounded gains on {settings.fresh} new plants")
        fresh, ways = draw(settings.fresh, attempt), (_third_of(flown, new), new)
        fresh = dataclasses.replace(fresh, ceiling=ceiling_in(law, axis, ways))
        designs = [before, *(gains_in(law, axis, each) for each in ways)]
        stages = tuple(certify_gains(fresh, designs))
        if _judge(stages, settings, found.band[1])[0] != "not to be flown":
            break
        loops = loops.joined(fresh, designs[-1][None], _WORST)
    kind, verdict = _judge(stages, settings, found.band[1])
    return AutopilotProposal(
        kind, verdict, settings, found, flown, again, stages, new if kind == "proposed" else {}
    )


def _third_of(flown: FlownAutopilot, new: Mapping[str, float]) -> dict[str, float]:
    """A third of the way, as the firmware stores it."""
    changes = propose_changes(flown.firmware, flown.old, new, share=_THIRD, beyond=list(new))
    return flown.old | {change.parameter.name: change.new for change in changes}


def _judge(stages: tuple[Stage, ...], settings: AutopilotSettings, edge: float) -> tuple[Kind, str]:
    flown, third, whole = stages
    limit, count = settings.sensitivity, settings.fresh
    beyond = []
    if min(third.stable, whole.stable) < 1:
        beyond.append(f"only {100 * min(third.stable, whole.stable):.1f} % of the loops are stable")
    if whole.peak > limit:
        beyond.append(f"the worst Ms is {whole.peak:.2f}, above {limit:g}")
    if whole.resonance > settings.resonance:
        beyond.append(
            f"the worst peak from set-point to rate is {whole.resonance:.2f}, above "
            f"{settings.resonance:g}"
        )
    if third.peak > max(limit, flown.peak):
        beyond.append(f"a third of the way the worst Ms is {third.peak:.2f}, above {limit:g}")
    if whole.crossover > edge:
        beyond.append(
            f"the crossover of {whole.crossover / (2 * np.pi):.1f} Hz is beyond the identified "
            f"{edge / (2 * np.pi):.1f} Hz"
        )
    if beyond:
        return "not to be flown", (
            f"no gains are proposed: {'; '.join(beyond)}. Allow more (`sensitivity`, `resonance`, "
            "`noise`, `change`), or fly more excitation"
        )
    better = f"{whole.rejection:.2f} of the flown effect of torque"
    within = flown.peak <= limit and flown.resonance <= settings.resonance
    if flown.stable == 1 and within and whole.rejection > _WORTH:
        return "kept", (
            f"what flew is kept: within the limits the best gains leave {better}. Its worst Ms on "
            f"{count} fresh plants is {flown.peak:.2f}"
        )
    return "proposed", (
        f"proposed: stable on all {count} fresh plants, worst Ms {whole.peak:.2f} of at most "
        f"{limit:g}, {better}. Load the file for a third of the way first"
    )
