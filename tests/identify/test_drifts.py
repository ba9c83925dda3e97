"""Drifts of the gain and of the clock that a sweep through a known plant shows to a fit."""

import numpy as np
import pytest

from jaxquad import fit
from jaxquad.models import LaggedIntegrator
from jaxquad.records import Record
from jaxquad.spectra import frequency_response


DT = 0.01


def fitted(fall=0.0, ppm=0.0):
    """An integrator of gain 8 behind a lag of .05 s, in noise, after a sweep of 60 s."""
    time = np.arange(6600) * DT
    clock, growth = np.clip(time, 0, 60), np.log(40.0) / 60
    u = np.sin(0.5 * np.expm1(growth * clock) / growth) * (time < 60)
    lagged = rate = 0.0
    y = np.zeros(time.size)
    for k in range(time.size):
        y[k] = rate
        moved = u[k] + (lagged - u[k]) * np.exp(-DT / 0.05)
        rate += 8 * (1 - fall * (time[k] / 66 - 0.5)) * (u[k] * DT + 0.05 * (lagged - moved))
        lagged = moved
    y = np.interp(time * (1 - 1e-6 * ppm), time, y)
    y = y + 0.3 * np.random.default_rng(0).standard_normal(y.size)
    found = frequency_response(Record(time, u, y, hold=DT), np.geomspace(0.6, 18.0, 40))
    done = fit(LaggedIntegrator(6.0, lag=0.1, delay=0.01), found)
    return [remark for remark in done.remarks if remark.kind == "drift"]


@pytest.mark.parametrize("change, text", [({"fall": 0.15}, "gain changes by -1"),
                                          ({"ppm": 400}, "stamps drift by +")])  # fmt: skip
def test_a_drift_during_a_sweep_is_remarked(change, text):
    remarks = fitted(**change)
    assert len(remarks) == 1 and text in remarks[0]


def test_a_steady_plant_is_not():
    assert not fitted()
