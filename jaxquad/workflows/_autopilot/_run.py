"""From the log of an autopilot to parameters for it: read, identify, reproduce, tune."""

import dataclasses
import functools as ft
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxquad._core import announce, behind
from jaxquad.control.autopilots import without_gyro_filters
from jaxquad.identify import usable
from jaxquad.loops import FlownLoop as Reproduction, reproduce_flight
from jaxquad.records import AXES, Proposal
from jaxquad.spectra import (
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
)

from .._fits import grid_of
from .._identify import Identification, identify_plant
from .._kinds import SettingsError
from .._log import propose_settings, read_records
from .._settings import IdentifySettings
from .._tune_settings import AutopilotSettings
from ._adrc_flight import flew_adrc, tune_adrc
from ._adrc_result import ADRCAutopilot
from ._flight_channels import FlightChannels, read_channels_if_any
from ._flown_autopilot import FlownAutopilot, read_flown, settings_of
from ._over_throttle import study_throttle
from ._proposal import AutopilotProposal
from ._rate_design import design_gains
from ._rate_gains import gyro_chains, law_responses


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
    compared = behind(_flown_responses, path, asked, proposal, flown)
    found = identify_plant(path, asked, proposal, gyro_chains(flown.law))
    known = (settings, found, flown)
    unsure = lambda why, again: AutopilotProposal("cannot tell", why, *known, again, flight=flight)
    if not found.fit.identifiable:
        return unsure(f"this log cannot tell: {found.fit.verdict.summary}; {_FLY}", None)
    announce("the flown loop again")
    again = _reproduce(found, proposal, flown, compared.get())
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
        axis=settings.axis, chirp=settings.chirp, start=settings.start, stop=settings.stop,
        band=settings.band,
    )  # fmt: skip
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


def _flown_responses(
    path: Path, settings: IdentifySettings, proposal: Proposal, flown: FlownAutopilot
) -> tuple[FrequencyResponse, ...]:
    """What the loop is compared with: from the set-point to the rate.

    Where the chirp enters at the mixer, from the chirp to output, rate and set-point.
    """
    of = ft.partial(_response_of, path, settings)
    setup = proposal.setup
    if setup.injected_at == "mixer":
        names = (*setup.command, setup.rate, _setpoint_of(setup.rate, flown))
        return tuple(of(input=setup.reference, output=name, reference=None) for name in names)
    setpoint = _setpoint_of(settings.output or "", flown)
    try:
        reference = None if settings.reference == setpoint else settings.reference
        response = of(input=setpoint, reference=reference)
    except ValueError:  # the stick is the set-point in another unit: that one is external
        response = of(input=setpoint, reference=None)
    later = 1 / _delay(np.asarray(response.omega), setup.late_s.get(setpoint, 0.0))
    return (dataclasses.replace(response, response=response.response * later[:, None, None]),)


def _delay(omega: Float[np.ndarray, " frequencies"], seconds: float) -> np.ndarray:
    return np.exp(-1j * omega * seconds)


def _response_of(
    path: Path, settings: IdentifySettings, **changed: str | None
) -> FrequencyResponse:
    """The response between other channels of the log, joint where there is a reference."""
    settings = dataclasses.replace(settings, **changed)
    estimator = JointInputOutput() if settings.reference else LocalPolynomial()
    records = list(read_records(path, settings))
    return frequency_response(records, grid_of(settings), estimator=estimator)


def _reproduce(
    found: Identification,
    proposal: Proposal,
    flown: FlownAutopilot,
    responses: Sequence[FrequencyResponse],
) -> Reproduction:
    """The flown loop compared with the log."""
    if proposal.setup.injected_at == "mixer":
        late = proposal.setup.late_s.get(proposal.setup.reference, 0.0)
        return _reproduce_law(found, flown, late, *responses)
    [response], [unit] = responses, found.records[0].output_units
    return reproduce_flight(
        found.fit, flown.law, response, unit="deg/s" if unit == "deg/s" else "rad/s",
        filters=gyro_chains(flown.law), axis=flown.axis,
    )  # fmt: skip


def _reproduce_law(
    found: Identification,
    flown: FlownAutopilot,
    late: float,
    output: FrequencyResponse,
    rate: FrequencyResponse,
    setpoint: FrequencyResponse,
) -> Reproduction:
    """The law's output, of set-point and rate, from a chirp at the mixer.

    The logged output contains the chirp, which as the set-point is `late` seconds behind its stamp.
    The noise of the rate is in the output, too, so that the error of the latter counts alone.
    """
    [unit] = found.records[0].output_units
    omega, only = np.asarray(output.omega), lambda x: np.asarray(x)[:, 0, 0]
    ahead, back = law_responses(without_gyro_filters(flown.law), flown.axis, omega)
    factor, later = np.pi / 180 if unit == "deg/s" else 1.0, _delay(omega, late)
    predicted = factor * (later * ahead * only(setpoint.response) + back * only(rate.response))
    measured, error = only(output.response) - later, only(output.random_error)
    used = only(usable(output, None, 0.6))
    # The error of the output is relative to its own size.
    error = error * np.abs(only(output.response) / measured)
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
