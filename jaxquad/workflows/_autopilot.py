"""From the log of an autopilot to parameters for it: read, identify, reproduce, tune, write."""

import dataclasses
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxquad._core import announce, plain_content, write_file
from jaxquad.control.autopilots import (
    find_parameter,
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
from jaxquad.records import (
    AXES,
    Proposal,
)
from jaxquad.report import provenance, write_json, write_pilot_page
from jaxquad.spectra import (
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
)

from ._adrc_flight import flew_adrc, tune_adrc
from ._adrc_result import ADRCAutopilot
from ._flight_channels import FlightChannels, read_channels_if_any
from ._flown_autopilot import FlownAutopilot, read_flown, settings_of
from ._gyro_noise import GyroNoise
from ._identify import Identification, identify_plant
from ._kinds import SettingsError
from ._log import propose_settings, read_records
from ._over_throttle import study_throttle, ThrottleVerdict
from ._pilot_page import pilot_page
from ._plants import PlantSource
from ._rate_design import design_gains, FilterVerdict, Kind
from ._rate_gains import gyro_chains, law_responses, Stage
from ._settings import IdentifySettings
from ._tune_settings import AutopilotSettings


_THIRD, _ALL = 1 / 3, 1.0
_STEM, _CURVE = "proposal", "thrust_curve"
_INJECTED = "SIDD.Targ"  # ArduPilot's chirp


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
    settings: AutopilotSettings
    identification: Identification
    flown: FlownAutopilot
    reproduction: Reproduction | None
    stages: tuple[Stage, ...] = ()
    new: Mapping[str, float] = dataclasses.field(default_factory=dict)
    filters: FilterVerdict | None = None
    noise: GyroNoise | None = None
    flight: FlightChannels | None = None
    throttle: ThrottleVerdict | None = None

    @property
    def plants(self) -> PlantSource:
        """What the log leaves possible."""
        found = self.identification
        if self.throttle is not None:
            return self.throttle.plants(found)
        return PlantSource(found.fit, found.records[0].output_units[0])

    @property
    def old(self) -> dict[str, float]:
        """What flew, of the gains and of filters that change."""
        return self.flown.old | ({} if self.filters is None else dict(self.filters.flown))

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
        reasons = dict.fromkeys(self.new, why)
        if self.filters is not None:
            reasons |= dict.fromkeys(self.filters.flown, self.filters.reason)
        return {name: reason for name, reason in reasons.items() if name in self.new}

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
            "filters": None if self.filters is None else self.filters.content(),
            "noise": None if self.noise is None else self.noise.content(),
            "throttle": None if self.throttle is None else self.throttle.content(),
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
        """Write the page, `autopilot.json`, and parameter files: without a proposal what flew.

        **Returns:** their paths.
        """
        announce("parameter files")
        folder, flown = Path(folder), self.flown
        known = {k: v for k, v in self.settings.content().items() if v is not None}
        log = self.identification.path
        words = ["jaxquad", "autopilot", str(log), *self.settings.words()]
        origin = provenance(log, command=shlex.join(words), settings=known)
        stored = write_json(
            folder / "autopilot.json", self.content() | {"provenance": origin.content()}
        )
        announce("the page")
        page = write_pilot_page(folder / "autopilot.html", pilot_page(self, origin))
        beside = [page, stored, *self._write_curve(folder)]
        if self.kind != "proposed":
            return [*beside, self._write_flown(folder)]
        files = write_parameter_files(
            folder, flown.firmware, self.old, self.new, stem=_STEM, shares=(_THIRD, _ALL),
            reasons=self._reasons, beyond=list(self.new), version=flown.version or (2025, 12),
            at_once=() if self.filters is None else self.filters.at_once, profile=None,
        )  # fmt: skip
        return [*beside, *files.stages, files.revert, files.table]

    def _write_curve(self, folder: Path) -> list[Path]:
        """The thrust curve's parameter and what flew of it, never in a file with gains."""
        curve = None if self.throttle is None else self.throttle.curve
        if curve is None or curve.change is None:
            return []
        titles = {
            "": f"{curve.name} alone: all loops and the throttle at hover change with it",
            "_revert": f"the {curve.name} that flew",
        }
        return [
            self._write_text(f"{_CURVE}{end}", [curve.change], title, folder, revert=bool(end))
            for end, title in titles.items()
        ]

    def _write_flown(self, folder: Path) -> Path:
        flown = self.flown
        same = [
            ParameterChange(find_parameter(flown.firmware, name), value, value)
            for name, value in self.old.items()
        ]
        return self._write_text(f"{_STEM}_revert", same, "what flew", folder, revert=True)

    def _write_text(
        self, stem: str, changes: Sequence[ParameterChange], title: str, folder: Path, *,
        revert: bool,
    ) -> Path:  # fmt: skip
        flown = self.flown
        raised = [AXES[flown.axis]] if f"d_max_{AXES[flown.axis]}" in self.old else []
        text = parameter_file(
            flown.firmware, changes, revert=revert, version=flown.version or (2025, 12),
            raised=raised, title=title, profile=None,
        )  # fmt: skip
        suffix = {"betaflight": "txt", "px4": "params", "ardupilot": "param"}[flown.firmware]
        return write_file(folder / f"{stem}.{suffix}", text)

    def __str__(self) -> str:
        flown = self.flown
        version = ".".join(map(str, flown.version))
        lines = [f"{flown.firmware} {version}, rate loop of {AXES[flown.axis]}".replace(" ,", ",")]
        lines += [f"  {name} = {value:.6g}" for name, value in self.old.items()]
        lines += [f"  not modelled: {each}" for each in flown.unmodelled]
        plant = "plant up to the gyro's filters, in the firmware's units"
        lines += ["", f"{plant}:\n{self.identification.fit}"]
        if self.reproduction is not None:
            lines += ["", f"flown loop: {self.reproduction.verdict}"]
        if self.stages:
            lines += ["", _stage_table(self.stages)]
        if self.throttle is not None:
            lines += ["", *_throttle_lines(self.throttle, self.stages)]
        if self.filters is not None:
            lines += ["", f"filters: {self.filters.text}"]
        if self.kind == "proposed":
            lines += ["", change_table(self.changes).rstrip()]
        curve = None if self.throttle is None else self.throttle.curve
        if curve is not None:
            lines += ["", f"thrust curve: {curve.text}"]
            if curve.change is not None:
                lines += ["", change_table([curve.change]).rstrip()]
        return "\n".join([*lines, "", self.verdict])


_WAYS = ("what flew", "a third of the way", "all of it")


def _throttle_lines(throttle: ThrottleVerdict, stages: tuple[Stage, ...]) -> list[str]:
    lines = [f"throttle: {throttle.text}"]
    if throttle.gains is None:
        return lines
    lines.append(throttle.table)
    if stages:
        heads = " ".join(f"{each:6.2f}" for each in throttle.logged)
        lines += ["", f"{'worst Ms at throttle':<20} {heads}"]
        for name, stage in zip(_WAYS, stages, strict=False):
            lines.append(f"{name:<20} " + " ".join(f"{peak:6.2f}" for peak in stage.peaks))
    return lines


def _stage_table(stages: tuple[Stage, ...]) -> str:
    rows = [f"{'on fresh plants':<20} stable   worst Ms   resonance   crossover   torque   noise"]
    for name, stage in zip(_WAYS, stages, strict=False):
        rows.append(
            f"{name:<20} {100 * stage.stable:5.1f} % {stage.peak:9.2f} {stage.resonance:9.2f} "
            f"  {stage.crossover / (2 * np.pi):8.1f} Hz {stage.rejection:8.2f} {stage.noise:7.2f}"
        )
    return "\n".join(rows)


def autopilot(
    path: str | Path, settings: AutopilotSettings | None = None
) -> AutopilotProposal | ADRCAutopilot:
    """Tune the gains of the autopilot that flew a log, as `jaxquad autopilot` does.

    Gains and filters are read from the log, the plant is identified in the firmware's own units up
    to what the gyro's filters are given, and the loop of both has to reproduce the flight. P, I and
    D of the rate loop are searched over the plants that the fit leaves uncertain: least rate after
    a step of torque, with limits on the peak of |S|, on the command's noise and on the crossover,
    which stays in the identified band. Where the log shows the gyro's noise, cutoffs and notches
    are searched with them. The rounded numbers are certified on fresh plants, as is a third of the
    way. Where the log holds several levels of throttle, plants have the gain that it shows at each
    of them. Feed-forward and the angle loop stay as they are. Loops are taken as linear: no limit
    of the motors is simulated. Source: docs/autopilots.md.

    **Arguments:**

    - `path`: a log of Betaflight, PX4 or ArduPilot.
    - `settings`: the axis, and what is kept.

    **Returns:** an `AutopilotProposal`, or an `ADRCAutopilot` where the ADRC flew or is asked for
    by `law`; nothing is written before its `.write(folder)`.

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
    adrc = flew_adrc(path, proposal)
    if adrc and settings.law == "pid":
        raise SettingsError(f"`law` is pid, but the ADRC flew {path} (pid_type): leave it out")
    if adrc or settings.law == "adrc":
        return tune_adrc(path, asked, proposal, settings)
    announce("gains and filters that flew")
    flown, flight = _read_flight(path, asked, proposal, settings)
    found = identify_plant(path, asked, proposal, gyro_chains(flown.law))
    known = (settings, found, flown)
    unsure = lambda why, again: AutopilotProposal("cannot tell", why, *known, again, flight=flight)
    if not found.fit.identifiable:
        return unsure(f"this log cannot tell: {found.fit.verdict.summary}; {_FLY}", None)
    announce("the flown loop again")
    again = _reproduce(found, flown)
    if again.kind != "flown":
        why = again.verdict
        return unsure(why if again.kind == "unknown" else f"this log cannot tell: {why}", again)
    throttle = study_throttle(found, proposal, flown)
    made = design_gains(settings, found, flown, flight, throttle)
    return AutopilotProposal(
        made.kind, made.verdict, *known, again, made.stages,
        made.new if made.kind == "proposed" else {}, made.filters, made.noise, flight, throttle,
    )  # fmt: skip


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


def _read_flight(
    path: Path, asked: IdentifySettings, proposal: Proposal, settings: AutopilotSettings
) -> tuple[FlownAutopilot, FlightChannels | None]:
    """The loop that flew, at the throttle of the log, and the channels beside the record's."""
    values = settings_of(path, proposal).values
    flight = read_channels_if_any(path, proposal, asked, values)
    if settings.throttle is None and flight is not None:
        settings = dataclasses.replace(settings, throttle=flight.middle)
    tracked = {} if flight is None else flight.tracked_hz
    return read_flown(path, proposal, settings, tracked), flight


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
        found.fit, flown.law, response, unit="deg/s" if unit == "deg/s" else "rad/s",
        filters=gyro_chains(flown.law), axis=flown.axis,
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
