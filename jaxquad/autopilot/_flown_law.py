"""The law of an identified log: which filters of the gyro are divided out, and its closed loop."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Complex, Float

from jaxquad._core import announce, Message
from jaxquad.identify import (
    as_sampled,
    filter_response,
    Fit,
    KnownFilter,
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
from ._flight_channels import best_filters, read_channels_if_any, RecordSettings, settings_of
from ._law import law_responses, RateLoop
from ._rate_loops import StepGrid


Frequencies = Float[np.ndarray, " frequencies"]
_SAME = 1e-3  # of the response of filters, by which those of several logs may differ
_AT = np.array([3.0, 10.0, 30.0])  # Hz


@dataclasses.dataclass(frozen=True)
class FlownLaw:
    """The filters of the gyro and the rate loop of a log, by its parameters."""

    filters: tuple[KnownFilter, ...]  # in front of the logged rate; none where all are off
    text: str  # what is divided out, or why nothing is
    law: RateLoop | None = None  # from the identified output to the identified input, if that is it
    axis: int = 0
    unmodelled: tuple[Message, ...] = ()  # what of the firmware the law leaves out
    chains: tuple[FilterChain, ...] = ()  # the filters that the parameters describe

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
    """Filters of a stored result: difference equations by their rates, then a delay and a lag."""

    chains: tuple[tuple[float, tuple[tuple[float, ...], ...]], ...]
    delay: float = 0.0  # s
    lag: float = 0.0  # s

    @classmethod
    def of(cls, content: Mapping[str, Any]) -> "StoredFilters":
        """From what `FlownLaw.content` has stored. Raises ValueError for anything else."""
        try:
            numbers = lambda section: tuple(map(float, section))
            chains = tuple(
                (float(x["rate_hz"]), tuple(map(numbers, x["sections"]))) for x in content["chains"]
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
        turn = 2j * np.pi * np.asarray(frequency_hz, float)
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

    def law_of(path: Path, proposal: Proposal | None) -> FlownLaw | None:
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
            return FlownLaw((), f"{in_model}: the log does not hold {names}")
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

    announce("the gyro's filters")
    in_model = "the gyro's filters are in the model"
    try:
        first, *others = [law_of(path, proposal if path == paths[0] else None) for path in paths]
    except Exception as error:
        return FlownLaw((), f"{in_model}: {reason_of(error)}")
    passed = lambda law: np.prod([x.response(_AT) for x in law.filters], axis=0)
    alike = lambda law: np.max(np.abs(np.asarray(passed(first)) / passed(law) - 1)) <= _SAME
    if first is None or all(law is not None and alike(law) for law in others):
        return first
    return FlownLaw((), f"{in_model}: those of the logs differ")


Response = Complex[np.ndarray, " frequencies"]
_COHERENT = 0.6  # magnitude-squared coherence from which a frequency counts
_LOWEST, _HIGHEST, _GRID = 0.3, 0.45, 512  # rad/s, of the law's rate, and how many frequencies
_PLANTS, _SEED = 64, 77  # of the step's band


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
    law, axis = flown.law.without_gyro_filters(), flown.axis  # the logged rate is behind them

    def paths(omega: Frequencies) -> tuple[Response, Response, Response]:
        """The law from set-point and from logged rate to plus and minus the command; filters."""
        ahead, back = units[unit] * law_responses(law, axis, omega)
        return ahead, -back, filter_response(filters, omega)

    used = np.asarray(usable(frf, None, _COHERENT))[:, 0, 0]
    omega = np.asarray(frf.omega)[used]
    response, error, coherence = (
        np.asarray(x)[used, 0, 0] for x in (frf.response, frf.random_error, frf.coherence)
    )
    _, back, passed = paths(omega)
    measured = BrokenLoop(omega, back * response * passed, error, coherence)
    if not fit.identifiable:
        return LawLoop(measured, None, None, flown.unmodelled)
    plant_at = lambda model, omega: model_response(as_sampled(model, frf), omega)[:, 0, 0]
    grid = np.geomspace(_LOWEST, _HIGHEST * 2 * np.pi / law.dt / 2, _GRID)
    _, back, passed = paths(grid)
    broken = back * plant_at(fit.model, grid) * passed
    model = BrokenLoop(grid, broken, np.zeros(grid.size), np.ones(grid.size))
    # The step from set-point to rate, of plants that the fit leaves possible.
    steps = StepGrid.of(law.dt)
    ahead, back, passed = paths(steps.omega)
    places, random = fit.parameters.places[: len(fit.names)], np.random.default_rng(_SEED)
    values = random.multivariate_normal(fit.values, fit.covariance, _PLANTS, method="eigh")
    sign = np.sign(fit.values)
    values = np.where(sign * values > 0, values, 0.0 * sign)  # a parameter keeps its sign
    plants = np.stack([plant_at(with_values(fit.model, places, x), steps.omega) for x in values])
    step = steps.band(ahead * plants * passed / (1 + back * plants * passed))
    return LawLoop(measured, model, step, flown.unmodelled)
