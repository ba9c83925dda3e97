"""The rate loop that flew, from the law of a log's parameters and the identified plant."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad.identify import (
    as_sampled,
    filter_response,
    Fit,
    KnownFilter,
    model_response,
    usable,
    with_values,
)
from jaxquad.models import Model
from jaxquad.plot import StepBand
from jaxquad.report import LawLoop
from jaxquad.spectra import BrokenLoop, FrequencyResponse

from ._flown_law import FlownLaw
from ._pilot_page import StepGrid
from ._rate_gains import law_responses


Frequencies = Float[np.ndarray, " frequencies"]
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
    grid = np.geomspace(_LOWEST, _HIGHEST * 2 * np.pi / flown.law.dt / 2, _GRID)
    response = _plant(frf, fit.model, grid)
    none, every = np.zeros(grid.size), np.ones(grid.size)
    model = BrokenLoop(grid, _law_at(flown, filters, grid, units[unit]).open(response), none, every)
    return LawLoop(measured, model, _step(flown, fit, frf, filters, units[unit]), flown.unmodelled)


def _law_at(
    flown: FlownLaw, filters: Sequence[KnownFilter], omega: Frequencies, radians: float
) -> _Loop:
    assert flown.law is not None
    law = flown.law.without_gyro_filters()  # the logged rate is behind them
    ahead, back = radians * law_responses(law, flown.axis, omega)
    return _Loop(omega, ahead, back, filter_response(filters, omega))


def _plant(frf: FrequencyResponse, model: Model, omega: Frequencies) -> Response:
    return model_response(as_sampled(model, frf), omega)[:, 0, 0]


def _step(
    flown: FlownLaw, fit: Fit, frf: FrequencyResponse, filters: Sequence[KnownFilter],
    radians: float,
) -> StepBand:  # fmt: skip
    """From set-point to rate, of plants that the fit leaves possible."""
    assert flown.law is not None
    grid = StepGrid.of(flown.law.dt)
    loop = _law_at(flown, filters, grid.omega, radians)
    places, random = fit.parameters.places[: len(fit.names)], np.random.default_rng(_SEED)
    values = random.multivariate_normal(fit.values, fit.covariance, _PLANTS, method="eigh")
    sign = np.sign(fit.values)
    values = np.where(sign * values > 0, values, 0.0 * sign)  # a parameter keeps its sign
    plants = [_plant(frf, with_values(fit.model, places, each), grid.omega) for each in values]
    return grid.band(np.stack([loop.closed(each) for each in plants]))
