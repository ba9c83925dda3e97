"""What the log of an autopilot says of the loop around a plant: the gyro's filters, and the law."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad._core import announce, Message
from jaxquad.identify import (
    as_sampled,
    filter_response,
    Fit,
    KnownFilter,
    measured_chain,
    MeasuredChain,
    model_response,
    usable,
    with_values,
)
from jaxquad.records import AXES, Proposal, propose
from jaxquad.report import LawLoop, reason_of
from jaxquad.spectra import BrokenLoop, FrequencyResponse

from ._filters import FilterChain
from ._firmware import firmware_named, HOVER
from ._flight_channels import FlightChannels, read_channels_if_any, settings_of
from ._identified import RecordSettings
from ._law import RateLoop
from ._pilot_page import StepGrid
from ._rate_loops import law_responses


Frequencies = Float[np.ndarray, " frequencies"]
_SHOWN = 10.0  # Hz, of the delay in print
_SAME = 1e-3  # of the response of filters, by which those of several logs may differ
_AT = np.array([3.0, 10.0, 30.0])  # Hz


@dataclasses.dataclass(frozen=True)
class FlownLaw:
    """The filters of the gyro and the rate loop of a log, by its parameters.

    **Attributes:**

    - `filters`: of the gyro, in front of the logged rate; none where all are off or unknown.
    - `chains`: those that the parameters describe.
    - `text`: what is divided out, or why nothing is.
    - `law`: the rate loop from the identified output to the identified input; None where the log
      does not tell it.
    - `axis`: 0, 1 or 2.
    - `unmodelled`: what of the firmware the law leaves out.
    """

    filters: tuple[KnownFilter, ...]
    text: str
    law: RateLoop | None = None
    axis: int = 0
    unmodelled: tuple[Message, ...] = ()
    chains: tuple[FilterChain, ...] = ()

    def content(self) -> dict[str, object]:
        """For `result.json`; `StoredFilters.of` reads the filters."""
        measured = [x for x in self.filters if isinstance(x, MeasuredChain)]
        number = lambda x: 0.0 if x is None else float(np.ravel(np.asarray(x))[0])
        chains = [
            {"rate_hz": chain.rate_hz, "sections": [list(map(number, x)) for x in chain.sections()]}
            for chain in self.chains
        ]
        correction = [{"delay_s": x.delay, "lag_s": x.lag} for x in measured]
        return {"text": self.text, "chains": chains, "correction": (*correction, {})[0]}


@dataclasses.dataclass(frozen=True)
class StoredFilters:
    """Filters of a stored result: difference equations, behind them a delay and a lag in s."""

    chains: tuple[tuple[float, tuple[tuple[float, ...], ...]], ...]
    delay: float = 0.0
    lag: float = 0.0

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> "StoredFilters":
        """From what `FlownLaw.content` has stored. Raises ValueError for anything else."""
        try:
            chains = tuple(
                (
                    float(x["rate_hz"]),
                    tuple(tuple(map(float, section)) for section in x["sections"]),
                )
                for x in content["chains"]
            )
            correction = content["correction"]
            ends = (float(correction.get(key, 0.0)) for key in ("delay_s", "lag_s"))
            return cls(chains, *ends)
        except (AttributeError, KeyError, TypeError) as error:
            raise ValueError(
                f"the result's gyro filters are incomplete ({error}): identify again"
            ) from error

    def response(self, frequency_hz: Frequencies) -> Complex[np.ndarray, " frequencies"]:
        """At frequencies in Hz."""
        hertz = np.asarray(frequency_hz, float)
        turn = 2j * np.pi * hertz
        passed = np.exp(-turn * self.delay) / (1 + turn * self.lag)
        for rate, sections in self.chains:
            back = np.exp(-turn / rate)
            for b0, b1, a1, b2, a2 in sections:
                passed = passed * (b0 + back * (b1 + back * b2)) / (1 + back * (a1 + back * a2))
        return passed


def flown_law(
    paths: Sequence[Path], rate: str, axis: int, command: Mapping[str, float],
    proposal: Proposal | None, settings: RecordSettings,
) -> FlownLaw | None:  # fmt: skip
    """Of a logged `rate` that is identified; None where the logs are of no known autopilot.

    `command` are the channels of the identified input; `proposal` is that of the first log. What a
    log does not tell costs nothing but itself: `text` says why.
    """
    announce("the gyro's filters")
    try:
        laws = [
            _law_of(path, rate, axis, command, proposal if path == paths[0] else None, settings)
            for path in paths
        ]
    except Exception as error:
        return FlownLaw((), f"the gyro's filters are in the model: {reason_of(error)}")
    first, *others = laws
    passed = lambda law: np.prod([x.response(_AT) for x in law.filters], axis=0)
    alike = lambda law: np.max(np.abs(np.asarray(passed(first)) / passed(law) - 1)) <= _SAME
    if first is None or all(law is not None and alike(law) for law in others):
        return first
    return FlownLaw((), "the gyro's filters are in the model: those of the logs differ")


def _law_of(
    path: Path, rate: str, axis: int, command: Mapping[str, float], proposal: Proposal | None,
    settings: RecordSettings,
) -> FlownLaw | None:  # fmt: skip
    if proposal is None:
        try:
            proposal = propose(path, axis=AXES[axis])
        except ValueError:  # a table whose channels have these names
            return None
    firmware, setup = firmware_named(proposal.vehicle), proposal.setup
    if setup.rate != rate or not firmware.log.gyro_cutoffs:
        return None
    logged = settings_of(path, proposal)
    if not any(name in logged.values for name in firmware.log.gyro_cutoffs):
        names = " or ".join(firmware.log.gyro_cutoffs)
        return FlownLaw((), f"the gyro's filters are in the model: the log does not hold {names}")
    flight = read_channels_if_any(path, proposal, settings, logged.values)
    loop = firmware.flown_loop(
        logged.values, logged.version,
        throttle=HOVER if flight is None or flight.middle is None else flight.middle,
        tracked_hz={} if flight is None else flight.tracked_hz,
    )  # fmt: skip
    chains = tuple(chain for chain in loop.law.gyro_chains() if chain.filters)
    filters, text = best_filters(chains, loop.unmodelled, flight, axis)
    flew = not firmware.flies_adrc(logged.values) and dict(command) == dict(setup.command)
    law = loop.law if flew else None
    return FlownLaw(filters, text, law, axis, tuple(loop.unmodelled), chains)


def best_filters(
    chains: tuple[FilterChain, ...],
    unmodelled: Sequence[Message],
    flight: FlightChannels | None,
    axis: int,
) -> tuple[tuple[KnownFilter, ...], str]:
    """As measured where notches follow motors or spectrum, else those of the parameters."""
    hidden = [text for text in unmodelled if text.kind == "notch"]
    missing = "" if not hidden else f" (not {'; '.join(text.partition(':')[0] for text in hidden)})"
    if hidden and flight is not None and len(flight.unfiltered) > axis and not flight.averaged:
        unfiltered, filtered = flight.unfiltered[axis], flight.rates[axis]
        try:
            if len(unfiltered) != len(filtered):
                raise ValueError("both rates have other instants")
            measured = measured_chain(
                unfiltered, filtered, flight.dt, filters=chains,
                names=(flight.names[1], flight.names[0]),
                reference=flight.setpoint if np.ptp(flight.setpoint) > 0 else None,
            )  # fmt: skip
            return (measured,), f"the gyro's filters are divided out, {measured.description}"
        except ValueError as error:
            missing = f"{missing[:-1]}, which could not be measured: {error})"
    if not chains:
        return (), f"the gyro has no filter that is known{missing}"
    words = ", ".join(filter.in_words() for chain in chains for filter in chain.filters)
    late = sum(float(chain.delay_ms([_SHOWN])[0]) for chain in chains)
    text = f"the gyro's filters, {words}{missing}, are divided out: {late:.2g} ms at {_SHOWN:g} Hz"
    return chains, text


Response = Complex[np.ndarray, " frequencies"]
_COHERENT = 0.6  # magnitude-squared coherence from which a frequency counts
_LOWEST, _HIGHEST, _GRID = 0.3, 0.45, 512  # rad/s, of the law's rate, and how many frequencies
_PLANTS, _SEED = 64, 77  # of the step's band


class _Loop(NamedTuple):
    """Responses of the law at some frequencies, and what turns a plant into that of the log.

    **Attributes:**

    - `ahead`, `back`: from set-point and logged rate, in the rate's unit, to the command.
    - `passed`: of the filters that the responses are without.
    """

    omega: Frequencies
    ahead: Response
    back: Response
    passed: Response

    def open(self, plant: Response) -> Response:
        """The broken loop with a plant up to what the filters are given."""
        return -self.back * plant * self.passed

    def closed(self, plant: Response) -> Response:
        """From set-point to rate."""
        return self.ahead * plant * self.passed / (1 + self.open(plant))


def loop_of_law(
    flown: FlownLaw | None, fit: Fit, frf: FrequencyResponse, filters: Sequence[KnownFilter],
    unit: str,
) -> LawLoop | None:  # fmt: skip
    """The flown rate loop as law times plant; None where the log does not tell the law.

    The plant is up to what `filters` were given, with a rate in `unit`.
    """
    units = {"deg/s": np.pi / 180, "rad/s": 1.0}
    if flown is None or flown.law is None or unit not in units:
        return None
    used = np.asarray(usable(frf, None, _COHERENT))[:, 0, 0]
    omega = np.asarray(frf.omega)[used]
    pick = lambda x: np.asarray(x)[used, 0, 0]
    measured = BrokenLoop(
        omega,
        _law_at(flown, filters, omega, units[unit]).open(pick(frf.response)),
        pick(frf.random_error),
        pick(frf.coherence),
    )
    if not fit.identifiable:
        return LawLoop(measured, None, None, flown.unmodelled)
    plant_at = lambda model, omega: model_response(as_sampled(model, frf), omega)[:, 0, 0]
    grid = np.geomspace(_LOWEST, _HIGHEST * 2 * np.pi / flown.law.dt / 2, _GRID)
    response = _law_at(flown, filters, grid, units[unit]).open(plant_at(fit.model, grid))
    model = BrokenLoop(grid, response, np.zeros(grid.size), np.ones(grid.size))
    # The step from set-point to rate, of plants that the fit leaves possible.
    steps = StepGrid.of(flown.law.dt)
    loop = _law_at(flown, filters, steps.omega, units[unit])
    places, random = fit.parameters.places[: len(fit.names)], np.random.default_rng(_SEED)
    values = random.multivariate_normal(fit.values, fit.covariance, _PLANTS, method="eigh")
    sign = np.sign(fit.values)
    values = np.where(sign * values > 0, values, 0.0 * sign)  # a parameter keeps its sign
    plants = [plant_at(with_values(fit.model, places, x), steps.omega) for x in values]
    step = steps.band(np.stack([loop.closed(plant) for plant in plants]))
    return LawLoop(measured, model, step, flown.unmodelled)


def _law_at(
    flown: FlownLaw, filters: Sequence[KnownFilter], omega: Frequencies, radians: float
) -> _Loop:
    assert flown.law is not None
    law = flown.law.without_gyro_filters()  # the logged rate is behind them
    ahead, back = radians * law_responses(law, flown.axis, omega)
    return _Loop(omega, ahead, back, filter_response(filters, omega))
