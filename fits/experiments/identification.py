"""The gain b of an axis from records of its closed loop, with the error that the fit claims."""

from typing import Any

import numpy as np

from jaxquad.identify import fit
from jaxquad.models import LaggedIntegrator
from jaxquad.simulation import Simulation
from jaxquad.spectra import frequency_response, JointInputOutput, LocalPolynomial, Periodic

from .data import Case, Members, Numbers
from .rigs import Rig


_POINTS = 24  # frequencies of a sweep's response
_LOST = (np.nan, np.inf, 0.0)


def identified(
    case: Case, chunk: Members, count: int, truth: Rig, done: Simulation, suite: dict[str, Any]
) -> Numbers:
    """Relative error of b, its standard error and the rank, of the first `count` members."""
    asked, level = case.data["identify"], suite["plants"][case.data["plant"]]
    periodic = chunk.of(asked["periodic"]) > 0
    b = (truth.torque_gain / truth.inertia)[0]
    start = LaggedIntegrator(0.7 * b[0], 0.03, level["delay"], integrators=2)
    rows = np.tile(np.array(_LOST), (len(b), 1))
    for k in range(count):
        if not np.asarray(done.diverged)[k]:
            rows[k] = _estimate(done.record("roll", member=k), start, asked, bool(periodic[k]))
    return {"gain_error": rows[:, 0] / b - 1, "gain_deviation": rows[:, 1] / b, "rank": rows[:, 2]}


def identification_numbers(mine: Numbers) -> dict[str, float]:
    """Bias, scatter and coverage over the members of a row."""
    error, deviation = mine["gain_error"], mine["gain_deviation"]
    good = np.isfinite(error)
    return {
        "mean_error": float(np.mean(error[good])) if good.any() else np.nan,
        "bias": float(abs(np.mean(error[good]))) if good.all() else np.inf,
        "scatter": float(np.std(error[good])) if good.any() else np.nan,
        "covered": float(np.mean(np.abs(error) < 1.96 * deviation)),
        "rank": float(np.min(mine["rank"])),
    }


def _estimate(
    record: Any, start: LaggedIntegrator, asked: dict[str, Any], periodic: bool
) -> tuple[float, float, float]:
    if periodic:
        response = frequency_response(record, estimator=JointInputOutput(Periodic(asked["period"])))
    else:
        low, high = asked["band"]
        omega = np.geomspace(low, high, _POINTS)
        spectra = LocalPolynomial(integrators=2, delay=0.02)
        response = frequency_response(record, omega, estimator=JointInputOutput(spectra))
    found = fit(start, response, free=("gain", "lag"))
    if not found.verdict.fitted:
        return _LOST
    gain = found.derived(lambda axis: axis.gain, "b")
    rank = 2.0 - len(found.verdict.undetermined)
    return float(gain.value), float(gain.standard_error), rank
