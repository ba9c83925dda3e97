"""From the log of an autopilot to parameters for it: read, identify, reproduce, tune."""

import dataclasses
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxquad._core import announce, marked_text, Message, Number
from jaxquad.autopilot import (
    ADRCAutopilot,
    AutopilotProposal,
    AxesProposal,
    betaflight_adrc_loop,
    betaflight_loop,
    check_loop,
    design_gains,
    doubted_throttle,
    FilterChain,
    firmware_named,
    Flown,
    FlownADRC,
    HOVER,
    propose_adrc,
    read_channels_if_any,
    read_flown,
    Recipe,
    reproduce_flight,
    Reproduction,
    settings_of,
    study_throttle,
)
from jaxquad.identify import gain_over_throttle, GainOverThrottle, UndeterminedError
from jaxquad.records import AXES, Proposal, RecordError, RecordWarning
from jaxquad.records.firmware import firmware_names
from jaxquad.spectra import frequency_response, JointInputOutput, LocalPolynomial

from ._autopilot_settings import AutopilotSettings
from ._identify import identify_plant
from ._log import propose_settings, read_records
from ._options import SettingsError
from ._settings import IdentifySettings, in_options


Listener = Callable[[str, AutopilotProposal | str], None]


def autopilot(
    path: str | Path, settings: AutopilotSettings | None = None,
    listener: Listener = lambda axis, one: None,
) -> AutopilotProposal | AxesProposal | ADRCAutopilot:  # fmt: skip
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
    - `listener`: hears the proposal of each axis as soon as it is there, or why there is none.

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
    record, proposal = channels_of(path, settings)
    firmware = firmware_named(proposal.vehicle)
    adrc = firmware.has_adrc and firmware.flies_adrc(settings_of(path, proposal).values)
    if adrc and settings.law == "pid":
        raise SettingsError(f"`law` is pid, but the ADRC flew {path} (pid_type): leave it out")
    if adrc or settings.law == "adrc":
        if not firmware.has_adrc:
            raise SettingsError(
                "`law` is adrc, which is proposed for Betaflight alone (its pull request 15400), "
                f"and {path} is a log of {proposal.vehicle}: leave it out"
            )
        return _tune_adrc(path, record, proposal, settings, adrc)
    if settings.axis != "all":
        one = _tune_axis(path, settings, {})
        listener(settings.axis, one)
        return one
    number = re.match(r"log(\d+)\.", proposal.setup.rate)
    if (
        number is not None and settings.flight is None
    ):  # all axes are of the flight that is proposed
        settings = dataclasses.replace(settings, flight=int(number[1]))
    return _tune_axes(path, settings, listener)


def recipe(
    firmware: str, axis: str = "all", *, amplitude: Number | None = None,
    switch: int | None = None,
) -> Recipe:  # fmt: skip
    """What to set and to fly, so that `autopilot` can tune from the log.

    **Arguments:**

    - `firmware`: "betaflight", "ardupilot" or "px4".
    - `axis`: roll, pitch, yaw or all.
    - `amplitude`: of the chirp in the firmware's unit, by default one to begin with.
    - `switch`: number of the channel or of the position of the switch that starts it.

    **Raises:** `ValueError`: the firmware has no recipe, or a value is not flyable; it names what
    is possible.
    """
    if axis not in (*AXES, "all"):
        raise ValueError(f"axis is {axis!r}: give one of {', '.join(AXES)}, or all.")
    axes, names = AXES if axis == "all" else (axis,), firmware_names()
    if firmware in names:
        answer = firmware_named(firmware).recipe(axes, amplitude=amplitude, switch=switch)
        if answer is not None:
            return answer
    possible = [name for name in names if firmware_named(name).recipe(AXES) is not None]
    raise ValueError(f"there is no recipe for {firmware!r}: give one of {', '.join(possible)}.")


def _tune_axes(path: Path, settings: AutopilotSettings, listener: Listener) -> AxesProposal:
    """One axis after the other; filters that they share are those of the first that changes them.

    Raises the error of the first axis where none can be used.
    """
    axes: dict[str, AutopilotProposal] = {}
    errors: dict[str, ValueError] = {}
    filters: Mapping[str, float] = {}
    for axis in AXES:
        announce(f"{axis}:")
        try:
            axes[axis] = _tune_axis(path, dataclasses.replace(settings, axis=axis), filters)
        except ValueError as error:  # it costs no other axis
            errors[axis] = error
            listener(axis, in_options(error))
            continue
        listener(axis, axes[axis])
        filters = filters or axes[axis].shared_filters
    if not axes:
        raise next(iter(errors.values()))
    return AxesProposal(settings, axes, {axis: in_options(error) for axis, error in errors.items()})


def _tune_axis(
    path: Path, settings: AutopilotSettings, filters: Mapping[str, float]
) -> AutopilotProposal:
    """The gains of one axis, with `filters` that are changed already."""
    announce("gains and filters that flew")
    record, proposal = channels_of(path, settings)
    flown = read_flown(path, proposal, record, settings.throttle)
    plant = identify_plant(path, record, proposal, flown.filters)
    unsure = lambda why, again: AutopilotProposal("cannot tell", why, settings, plant, flown, again)
    advice = firmware_named(flown.firmware).what_to_fly(AXES[flown.axis])
    if not plant.fit.identifiable and flown.flight is not None and flown.flight.rests:
        moved = np.degrees(np.std(flown.flight.setpoint))
        return unsure(Message(
            f"this log cannot tell: {flown.flight.rest_text}, which is what is analysed of it "
            f"(its set-point by {moved:.1f} deg/s rms, and nothing is injected). {advice}"
        ), None)  # fmt: skip
    if not plant.fit.identifiable:
        summary = plant.fit.verdict.summary
        return unsure(Message(f"this log cannot tell: «plant|{summary}». {advice}"), None)
    if flown.flight is None:
        return unsure(_NO_SETPOINT, None)
    announce("the flown loop again")
    again = check_loop(plant, flown)
    if again.kind == "unknown":
        return unsure(f"this log cannot tell: {again.verdict}. {advice}", again)
    if again.kind != "flown":
        return unsure(f"this log cannot tell: {again.verdict}", again)
    read = lambda inputs: read_records(path, plant.settings, further_inputs=inputs)
    throttle = study_throttle(plant, proposal, flown, read)
    return design_gains(dataclasses.replace(unsure("", again), throttle=throttle), filters)


_NO_SETPOINT = (
    "this log cannot tell: it holds no set-point of the rate beside the gyro, so nothing says "
    "whether these gains flew: log both"
)


def channels_of(path: Path, settings: AutopilotSettings) -> tuple[IdentifySettings, Proposal]:
    """What the log itself says is command, rate and reference."""
    record = IdentifySettings(
        axis=None if settings.axis == "all" else settings.axis, chirp=settings.chirp,
        flight=settings.flight, start=settings.start, stop=settings.stop, band=settings.band,
    )  # fmt: skip
    complete, proposal = propose_settings(path, record)
    if proposal is None:
        raise SettingsError(f"{path} proposes no channels: give the log of an autopilot")
    return complete, proposal


def _tune_adrc(
    path: Path, record: IdentifySettings, proposal: Proposal, settings: AutopilotSettings,
    flew_adrc: bool,
) -> ADRCAutopilot:  # fmt: skip
    """What `autopilot` does for the ADRC, from what the log proposes as channels."""
    announce("gains and filters that flew")
    logged = settings_of(path, proposal)
    flight = read_channels_if_any(path, proposal, record, logged.values)
    middle = settings.throttle or (None if flight is None else flight.middle) or HOVER
    read = betaflight_adrc_loop if flew_adrc else betaflight_loop
    flown = read(logged.values, logged.version, throttle=middle)
    if isinstance(flown, FlownADRC) and settings.hover is not None:
        hover = flown.schedule.hover
        if abs(settings.hover - hover) > 0.005:
            raise SettingsError(
                f"`hover` is {settings.hover:g}, but the ADRC that flew has an adrc_hover_throttle "
                f"of {100 * hover:.0f} %, which stays: leave it out"
            )
    result = ADRCAutopilot(
        "cannot tell", "", settings, path, proposal.setup.axis, tuple(logged.version),
        logged.values, flown, flight=flight,
    )  # fmt: skip
    if not proposal.setup.throttle:
        raise RecordError(
            f"{path} holds no throttle (setpoint[3]), which the ADRC needs: log the set-points"
        )
    chains = [x for x in flown.at(middle).gyro_chains() if x.filters]
    with warnings.catch_warnings():  # the throttle is slow, or rests
        warnings.simplefilter("ignore", RecordWarning)
        throttle = {"throttle": dict(proposal.setup.throttle)}
        records = list(read_records(path, record, further_inputs=throttle))
    announce("the gain over the throttle")
    low, high = settings.band or (0.0, 0.0)
    band = None if settings.band is None else (2 * np.pi * low, 2 * np.pi * high)
    unsure = lambda error: dataclasses.replace(
        result, verdict=Message(f"this log cannot tell: {marked_text(error)}")
    )
    try:
        plant = gain_over_throttle(records, filters=chains, band=band)
    except ValueError as error:  # says what to fly
        return unsure(error)
    result = dataclasses.replace(result, plant=plant)
    try:
        plant.b0(0)  # raises where the lag is not determined
        announce("the flown loop again")
        again = {
            float(x): _reproduced(path, record, plant, flown, level, chains)
            for level, x in enumerate(plant.throttle)
        }
        result = dataclasses.replace(result, reproductions=again)
        if (doubted := doubted_throttle(again)) is not None:
            why = again[doubted].verdict
            if again[doubted].kind == "not flown":
                why = f"this log cannot tell: at {doubted:.2f} throttle {why}"
            return dataclasses.replace(result, verdict=why)
        design = propose_adrc(
            plant, flown, result.axis, hover=settings.hover, members=settings.members,
            fresh=settings.fresh, seed=settings.seed, targets=settings,
        )  # fmt: skip
    except UndeterminedError as error:
        return unsure(error)
    return dataclasses.replace(result, kind=design.kind, verdict=design.verdict, proposal=design)


_LINES = 40  # frequencies of a reproduced response


def _reproduced(
    path: Path, record: IdentifySettings, plant: GainOverThrottle, flown: Flown, level: int,
    chains: Sequence[FilterChain],
) -> Reproduction:  # fmt: skip
    """The flown loop at a level of throttle compared with the log."""
    rate = record.output or ""
    setpoint, axis = rate.replace("gyroADC", "setpoint"), int(rate[-2])
    band = (2 * np.pi, 90 * np.pi) if plant.fit.origin is None else plant.fit.origin.band
    local = LocalPolynomial(global_order=0)

    def respond(reference: str | None):
        part = dataclasses.replace(
            record, segments=plant.stretches[level], start=None, stop=None, input=setpoint,
            reference=reference,
        )  # fmt: skip
        return frequency_response(
            list(read_records(path, part)), np.geomspace(*band, _LINES),
            estimator=JointInputOutput(local) if reference else local,
        )  # fmt: skip

    try:
        response = respond(None if record.reference == setpoint else record.reference)
    except ValueError:  # the stick is the set-point in another unit: that one is external
        response = respond(None)
    return reproduce_flight(
        plant.fit, flown.at(float(plant.throttle[level])), response,
        plant=lambda model: model.at(level), unit="deg/s", filters=chains, axis=axis,
    )  # fmt: skip
