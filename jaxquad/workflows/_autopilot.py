"""From the log of an autopilot to parameters for it: read, identify, reproduce, tune."""

import dataclasses
import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from jaxquad._core import announce, Message
from jaxquad.autopilot import (
    ADRCAutopilot,
    AutopilotProposal,
    AxesProposal,
    check_loop,
    design_gains,
    firmware_named,
    FlownAutopilot,
    read_flown,
    study_throttle,
)
from jaxquad.records import AXES, Proposal

from ._autopilot_adrc import flew_adrc, tune_adrc
from ._command_line import in_options
from ._identify import identify_plant
from ._log import propose_settings, read_records
from ._options import SettingsError
from ._settings import AutopilotSettings, IdentifySettings


def autopilot(
    path: str | Path, settings: AutopilotSettings | None = None
) -> AutopilotProposal | AxesProposal | ADRCAutopilot:
    """Tune the gains of the autopilot that flew a log, as `jaxquad autopilot` does.

    Gains and filters are read from the log, and the law is replayed on its set-point and gyro to
    tell whether they flew. The plant is identified in the firmware's own units up to what the
    gyro's filters are given, and both are flown again in time. P, I and D of the rate loop are
    searched over the plants that the fit leaves uncertain: least rate after a step of torque, with
    limits on the peak of |S|, on the command's noise and on the crossover, which stays in the
    identified band. Where the log shows the gyro's noise, cutoffs and notches are searched with
    them. The rounded numbers are certified on fresh plants, as is a third of the way: with the
    integral as set and held, and with the angle loop around the rate loop, whose gain is lowered
    where it spoils that. Where the log holds several levels of throttle, plants have the gain that
    it shows at each of them. Source: docs/autopilots.md.

    **Arguments:**

    - `path`: a log of Betaflight, PX4 or ArduPilot.
    - `settings`: the axis, and what is kept.

    **Returns:** an `AxesProposal` of all axes that the log holds, an `AutopilotProposal` where
    `axis` names one, or an `ADRCAutopilot` where the ADRC flew or is asked for by `law`; nothing is
    written before its `.write(folder)`.

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
    record, proposal = _channels_of(path, settings)
    adrc = flew_adrc(path, proposal)
    if adrc and settings.law == "pid":
        raise SettingsError(f"`law` is pid, but the ADRC flew {path} (pid_type): leave it out")
    if adrc or settings.law == "adrc":
        return tune_adrc(path, record, proposal, settings)
    if settings.axis != "all":
        return _tune_axis(_read_axis(path, settings), {})
    number = re.match(r"log(\d+)\.", proposal.setup.rate)
    if (
        number is not None and settings.flight is None
    ):  # all axes are of the flight that is proposed
        settings = dataclasses.replace(settings, flight=int(number[1]))
    return _tune_axes(path, settings)


def _tune_axes(path: Path, settings: AutopilotSettings) -> AxesProposal:
    """One axis after the other; filters that they share are those of the first that changes them.

    Raises the error of the first axis where none can be used.
    """
    read: dict[str, _ReadAxis] = {}
    errors: dict[str, ValueError] = {}
    for axis in AXES:
        try:
            read[axis] = _read_axis(path, dataclasses.replace(settings, axis=axis))
        except ValueError as error:  # the log lacks what this axis needs
            errors[axis] = error
    axes: dict[str, AutopilotProposal] = {}
    filters: Mapping[str, float] = {}
    for axis, axis_read in read.items():
        announce(f"{axis}:")
        try:
            axes[axis] = _tune_axis(axis_read, filters)
        except ValueError as error:  # it costs no other axis
            errors[axis] = error
            continue
        filters = filters or axes[axis].shared_filters
    if not axes:
        raise next(iter(errors.values()))
    return AxesProposal(settings, axes, {axis: in_options(error) for axis, error in errors.items()})


class _ReadAxis(NamedTuple):
    """What a log holds of one axis."""

    path: Path
    settings: AutopilotSettings
    record: IdentifySettings
    proposal: Proposal
    flown: FlownAutopilot


def _read_axis(path: Path, settings: AutopilotSettings) -> _ReadAxis:
    announce("gains and filters that flew")
    record, proposal = _channels_of(path, settings)
    flown = read_flown(path, proposal, record, settings.throttle)
    return _ReadAxis(path, settings, record, proposal, flown)


def _tune_axis(axis: _ReadAxis, filters: Mapping[str, float]) -> AutopilotProposal:
    """The gains of one axis, with `filters` that are changed already."""
    path, settings, record, proposal, flown = axis
    plant = identify_plant(path, record, proposal, flown.filters)
    unsure = lambda why, again: AutopilotProposal("cannot tell", why, settings, plant, flown, again)
    recipe = firmware_named(flown.firmware).what_to_fly(AXES[flown.axis])
    if not plant.fit.identifiable:
        summary = plant.fit.verdict.summary
        return unsure(Message(f"this log cannot tell: «plant|{summary}». {recipe}"), None)
    if flown.flight is None:
        return unsure(_NO_SETPOINT, None)
    announce("the flown loop again")
    again = check_loop(plant, flown)
    if again.kind == "unknown":
        return unsure(f"this log cannot tell: {again.verdict}. {recipe}", again)
    if again.kind != "flown":
        return unsure(f"this log cannot tell: {again.verdict}", again)
    read = lambda inputs: read_records(path, plant.settings, further_inputs=inputs)
    throttle = study_throttle(plant, proposal, flown, read)
    return design_gains(dataclasses.replace(unsure("", again), throttle=throttle), filters)


_NO_SETPOINT = (
    "this log cannot tell: it holds no set-point of the rate beside the gyro, so nothing says "
    "whether these gains flew: log both"
)


def _channels_of(path: Path, settings: AutopilotSettings) -> tuple[IdentifySettings, Proposal]:
    """What the log itself says is command, rate and reference."""
    record = IdentifySettings(
        axis=None if settings.axis == "all" else settings.axis, chirp=settings.chirp,
        flight=settings.flight, start=settings.start, stop=settings.stop, band=settings.band,
    )  # fmt: skip
    complete, proposal = propose_settings(path, record)
    if proposal is None:
        raise SettingsError(f"{path} proposes no channels: give the log of an autopilot")
    return complete, proposal
