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
    flies_adrc,
    FlightChannels,
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
from jaxquad.records import Proposal, Record, RecordError, RecordWarning
from jaxquad.spectra import (
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
)

from ._log import read_records
from ._options import SettingsError
from ._settings import AutopilotSettings, IdentifySettings


_LINES = 40  # frequencies of a reproduced response


def flew_adrc(path: Path, proposal: Proposal) -> bool:
    """Whether a log is of a flight with Betaflight's proposed ADRC."""
    firmware = firmware_named(proposal.vehicle)
    return firmware.has_adrc and firmware.flies_adrc(settings_of(path, proposal).values)


def tune_adrc(
    path: Path, asked: IdentifySettings, proposed: Proposal, settings: AutopilotSettings
) -> ADRCAutopilot:
    """What `autopilot` does for the ADRC, from what the log proposes as channels.

    Raises `SettingsError` for another firmware, and for a hover throttle other than the flown one.
    """
    if not firmware_named(proposed.vehicle).has_adrc:
        raise SettingsError(
            f"`law` is adrc, which is proposed for Betaflight alone (its pull request 15400), and "
            f"{path} is a log of {proposed.vehicle}: leave it out"
        )
    given = settings_of(path, proposed)
    announce("gains and filters that flew")
    flown, flight = _read_flown(path, asked, proposed, settings)
    _check_hover(flown, settings)
    found = ADRCAutopilot(
        "cannot tell", "", settings, path, proposed.setup.axis, tuple(given.version), given.values,
        flown, flight=flight,
    )  # fmt: skip
    records, chains = _read_with_throttle(path, asked, proposed), _chains(found)
    announce("the gain over the throttle")
    try:
        plant = gain_over_throttle(
            records, filters=chains,
            band=None if settings.band is None else _in_radians(settings.band),
        )  # fmt: skip
    except ValueError as error:  # says what to fly
        return _unsure(found, error)
    return _tuned(dataclasses.replace(found, plant=plant), plant, asked)


def _tuned(found: ADRCAutopilot, plant: GainOverThrottle, asked: IdentifySettings) -> ADRCAutopilot:
    """With the flown loop reproduced, and what is proposed where it is."""
    settings, chains = found.settings, _chains(found)
    try:
        plant.b0(0)  # raises where the lag is not determined
        announce("the flown loop again")
        again = {
            float(x): _reproduce(found.path, asked, plant, found.flown, level, chains)
            for level, x in enumerate(plant.throttle)
        }
        found = dataclasses.replace(found, reproductions=again)
        if (doubted := doubted_throttle(again)) is not None:
            why = again[doubted].verdict
            if again[doubted].kind == "not flown":
                why = f"this log cannot tell: at {doubted:.2f} throttle {why}"
            return dataclasses.replace(found, verdict=why)
        made = propose_adrc(
            plant, found.flown, found.axis, hover=settings.hover, members=settings.members,
            fresh=settings.fresh, seed=settings.seed, targets=_targets(settings),
        )  # fmt: skip
    except UndeterminedError as error:
        return _unsure(found, error)
    return dataclasses.replace(found, kind=made.kind, verdict=made.verdict, proposal=made)


def _unsure(found: ADRCAutopilot, error: ValueError) -> ADRCAutopilot:
    return dataclasses.replace(
        found, verdict=Message(f"this log cannot tell: {marked_text(error)}")
    )


def _chains(found: ADRCAutopilot) -> list[FilterChain]:
    """The filters that the rate passed, at the throttle of the log."""
    return gyro_filters(found.flown, _middle(found.flight, found.settings))


def _targets(settings: AutopilotSettings) -> ADRCTargets:
    return ADRCTargets(
        sensitivity=settings.sensitivity, resonance=settings.resonance, noise=settings.noise,
        change=settings.change,
    )  # fmt: skip


def _read_flown(
    path: Path, asked: IdentifySettings, proposed: Proposal, settings: AutopilotSettings
) -> tuple[Flown, FlightChannels | None]:
    """The loop of the header at the throttle of the log, and the channels beside the record's."""
    given = settings_of(path, proposed)
    flight = read_channels_if_any(path, proposed, asked, given.values)
    read = betaflight_adrc_loop if flies_adrc(given.values) else betaflight_loop
    return read(given.values, given.version, throttle=_middle(flight, settings)), flight


def _middle(flight: FlightChannels | None, settings: AutopilotSettings) -> float:
    """The throttle at which dynamic filters are taken for the record."""
    if settings.throttle is not None:
        return settings.throttle
    return (None if flight is None else flight.middle) or HOVER


def _check_hover(flown: Flown, settings: AutopilotSettings) -> None:
    if not isinstance(flown, FlownADRC) or settings.hover is None:
        return
    hover = flown.schedule.hover
    if abs(settings.hover - hover) > 0.005:
        raise SettingsError(
            f"`hover` is {settings.hover:g}, but the ADRC that flew has an adrc_hover_throttle of "
            f"{100 * hover:.0f} %, which stays: leave it out"
        )


def _in_radians(band: tuple[float, float]) -> tuple[float, float]:
    return 2 * np.pi * band[0], 2 * np.pi * band[1]


def _read_with_throttle(path: Path, asked: IdentifySettings, proposed: Proposal) -> list[Record]:
    """Command, rate and reference with the throttle, a record for each excitation."""
    if not proposed.setup.throttle:
        raise RecordError(
            f"{path} holds no throttle (setpoint[3]), which the ADRC needs: log the set-points"
        )
    with warnings.catch_warnings():  # the throttle is slow, or rests
        warnings.simplefilter("ignore", RecordWarning)
        return list(read_records(path, asked, beside={"throttle": dict(proposed.setup.throttle)}))


def _reproduce(
    path: Path,
    asked: IdentifySettings,
    plant: GainOverThrottle,
    flown: Flown,
    level: int,
    chains: Sequence[FilterChain],
) -> Reproduction:
    """The flown loop at a level of throttle compared with the log."""
    rate = asked.output or ""
    setpoint, axis = rate.replace("gyroADC", "setpoint"), int(rate[-2])
    part = {"segments": plant.stretches[level], "start": None, "stop": None, "input": setpoint}
    outside = None if asked.reference == setpoint else asked.reference
    try:
        response = _respond(path, dataclasses.replace(asked, reference=outside, **part), plant)
    except ValueError:  # the stick is the set-point in another unit: that one is external
        response = _respond(path, dataclasses.replace(asked, reference=None, **part), plant)
    return reproduce_flight(
        plant.fit, flown.at(float(plant.throttle[level])), response,
        plant=lambda model: model.at(level), unit="deg/s", filters=chains, axis=axis,
    )  # fmt: skip


def _respond(path: Path, asked: IdentifySettings, plant: GainOverThrottle) -> FrequencyResponse:
    """From the set-point to the rate, in the band of the fit."""
    local = LocalPolynomial(global_order=0)
    band = (2 * np.pi, 90 * np.pi) if plant.fit.origin is None else plant.fit.origin.band
    return frequency_response(
        list(read_records(path, asked)), np.geomspace(*band, _LINES),
        estimator=JointInputOutput(local) if asked.reference else local,
    )  # fmt: skip
