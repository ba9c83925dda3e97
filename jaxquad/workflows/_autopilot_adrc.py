"""From a Betaflight log to the parameters of its proposed ADRC: identify, reproduce, tune."""

import dataclasses
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jaxquad._core import announce, marked_text, Message
from jaxquad.autopilot import (
    ADRCAutopilot,
    ADRCTargets,
    betaflight_adrc_loop,
    betaflight_loop,
    doubted_throttle,
    FilterChain,
    firmware_named,
    Flown,
    FlownADRC,
    gyro_filters,
    HOVER,
    propose_adrc,
    read_channels_if_any,
    reproduce_flight,
    Reproduction,
    settings_of,
)
from jaxquad.identify import gain_over_throttle, GainOverThrottle, UndeterminedError
from jaxquad.records import Proposal, RecordError, RecordWarning
from jaxquad.spectra import frequency_response, JointInputOutput, LocalPolynomial

from ._log import read_records
from ._options import SettingsError
from ._settings import AutopilotSettings, IdentifySettings


_LINES = 40  # frequencies of a reproduced response


def flew_adrc(path: Path, proposal: Proposal) -> bool:
    """Whether a log is of a flight with Betaflight's proposed ADRC."""
    firmware = firmware_named(proposal.vehicle)
    return firmware.has_adrc and firmware.flies_adrc(settings_of(path, proposal).values)


def tune_adrc(
    path: Path, record: IdentifySettings, proposal: Proposal, settings: AutopilotSettings
) -> ADRCAutopilot:
    """What `autopilot` does for the ADRC, from what the log proposes as channels.

    Raises `SettingsError` for another firmware, and for a hover throttle other than the flown one.
    """
    if not firmware_named(proposal.vehicle).has_adrc:
        raise SettingsError(
            f"`law` is adrc, which is proposed for Betaflight alone (its pull request 15400), and "
            f"{path} is a log of {proposal.vehicle}: leave it out"
        )
    announce("gains and filters that flew")
    logged = settings_of(path, proposal)
    flight = read_channels_if_any(path, proposal, record, logged.values)
    middle = settings.throttle or (None if flight is None else flight.middle) or HOVER
    read = betaflight_adrc_loop if flew_adrc(path, proposal) else betaflight_loop
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
    chains = gyro_filters(flown, middle)
    with warnings.catch_warnings():  # the throttle is slow, or rests
        warnings.simplefilter("ignore", RecordWarning)
        throttle = {"throttle": dict(proposal.setup.throttle)}
        records = list(read_records(path, record, further_inputs=throttle))
    announce("the gain over the throttle")
    low, high = settings.band or (0.0, 0.0)
    band = None if settings.band is None else (2 * np.pi * low, 2 * np.pi * high)
    try:
        plant = gain_over_throttle(records, filters=chains, band=band)
    except ValueError as error:  # says what to fly
        return _unsure(result, error)
    return _tuned(dataclasses.replace(result, plant=plant), plant, record, settings, chains)


def _tuned(
    result: ADRCAutopilot, plant: GainOverThrottle, record: IdentifySettings,
    settings: AutopilotSettings, chains: Sequence[FilterChain],
) -> ADRCAutopilot:  # fmt: skip
    """With the flown loop reproduced, and what is proposed where it is."""
    try:
        plant.b0(0)  # raises where the lag is not determined
        announce("the flown loop again")
        again = {
            float(x): _reproduce(result.path, record, plant, result.flown, level, chains)
            for level, x in enumerate(plant.throttle)
        }
        result = dataclasses.replace(result, reproductions=again)
        if (doubted := doubted_throttle(again)) is not None:
            why = again[doubted].verdict
            if again[doubted].kind == "not flown":
                why = f"this log cannot tell: at {doubted:.2f} throttle {why}"
            return dataclasses.replace(result, verdict=why)
        targets = ADRCTargets(
            sensitivity=settings.sensitivity, resonance=settings.resonance, noise=settings.noise,
            change=settings.change,
        )  # fmt: skip
        design = propose_adrc(
            plant, result.flown, result.axis, hover=settings.hover, members=settings.members,
            fresh=settings.fresh, seed=settings.seed, targets=targets,
        )  # fmt: skip
    except UndeterminedError as error:
        return _unsure(result, error)
    return dataclasses.replace(result, kind=design.kind, verdict=design.verdict, proposal=design)


def _unsure(result: ADRCAutopilot, error: ValueError) -> ADRCAutopilot:
    verdict = Message(f"this log cannot tell: {marked_text(error)}")
    return dataclasses.replace(result, verdict=verdict)


def _reproduce(
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
