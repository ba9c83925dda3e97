"""The rate loop that flew, from the law of a log's parameters and the identified plant."""

from typing import NamedTuple, TYPE_CHECKING

import numpy as np
from jaxtyping import Complex, Float

from jaxquad.identify import as_sampled, filter_response, model_response, usable, with_values
from jaxquad.models import Model
from jaxquad.plot import StepBand
from jaxquad.report import LawLoop
from jaxquad.spectra import BrokenLoop


if TYPE_CHECKING:
    from ._identify import Identification

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


def loop_of_law(found: "Identification") -> LawLoop | None:
    """The flown rate loop as law times plant; None where the log does not tell the law."""
    units = {"deg/s": np.pi / 180, "rad/s": 1.0}
    [unit], flown = found.records[0].output_units, found.flown
    if flown is None or flown.law is None or unit not in units:
        return None
    frf = found.frf
    used = np.asarray(usable(frf, None, _COHERENT))[:, 0, 0]
    omega = np.asarray(frf.omega)[used]
    pick = lambda x: np.asarray(x)[used, 0, 0]
    measured = BrokenLoop(
        omega,
        _law_at(found, omega, units[unit]).open(pick(frf.response)),
        pick(frf.random_error),
        pick(frf.coherence),
    )
    if not found.fit.identifiable:
        return LawLoop(measured, None, None, flown.unmodelled)
    grid = np.geomspace(_LOWEST, _HIGHEST * 2 * np.pi / flown.law.dt / 2, _GRID)
    response = _plant(found, found.fit.model, grid)
    none, every = np.zeros(grid.size), np.ones(grid.size)
    model = BrokenLoop(grid, _law_at(found, grid, units[unit]).open(response), none, every)
    return LawLoop(measured, model, _step(found, units[unit]), flown.unmodelled)


def _law_at(found: "Identification", omega: Frequencies, radians: float) -> _Loop:
    from jaxquad.control.autopilots import without_gyro_filters

    from ._autopilot._rate_gains import law_responses

    flown = found.flown
    assert flown is not None and flown.law is not None
    law = without_gyro_filters(flown.law)  # the logged rate is behind them
    ahead, back = radians * law_responses(law, flown.axis, omega)
    return _Loop(omega, ahead, back, filter_response(found.filters, omega))


def _plant(found: "Identification", model: Model, omega: Frequencies) -> Response:
    return model_response(as_sampled(model, found.frf), omega)[:, 0, 0]


def _step(found: "Identification", radians: float) -> StepBand:
    """From set-point to rate, of plants that the fit leaves possible."""
    from ._autopilot._pilot_page import StepGrid

    assert found.flown is not None and found.flown.law is not None
    fit, grid = found.fit, StepGrid.of(found.flown.law.dt)
    loop = _law_at(found, grid.omega, radians)
    places, random = fit.parameters.places[: len(fit.names)], np.random.default_rng(_SEED)
    values = random.multivariate_normal(fit.values, fit.covariance, _PLANTS, method="eigh")
    sign = np.sign(fit.values)
    values = np.where(sign * values > 0, values, 0.0 * sign)  # a parameter keeps its sign
    plants = [_plant(found, with_values(fit.model, places, each), grid.omega) for each in values]
    return grid.band(np.stack([loop.closed(each) for each in plants]))
