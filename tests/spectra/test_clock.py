"""A clock of the outputs that drifts, seen by the controller's answer to them."""

import numpy as np
import pytest

from jaxquad.records import Record
from jaxquad.spectra import frequency_response


DT = 0.01


def flown(ppm):
    """An integrator under proportional feedback, with a noisy gyro that is stamped too late."""
    time = np.arange(4000) * DT
    sweep = np.sin(1.5 * 40 / 2.3 * (np.exp(2.3 * time / 40) - 1))
    noise = 0.05 * np.random.default_rng(0).standard_normal((2, time.size))
    rate, u, y = 0.0, np.zeros(time.size), np.zeros(time.size)
    for k in range(time.size):
        y[k] = rate + noise[0, k]
        u[k] = sweep[k] - 0.5 * y[k]
        rate += DT * 8 * (u[k] + noise[1, k])
    return Record(time, u, np.interp(time * (1 - 1e-6 * ppm), time, y), sweep)


@pytest.mark.parametrize("ppm", [100, -100])
def test_a_clock_that_drifts_is_remarked_with_its_rate(ppm):
    found = frequency_response(flown(ppm), np.geomspace(2.0, 12.0, 30))
    texts = [remark for remark in found.remarks if remark.kind == "clock"]
    assert len(texts) == 1
    assert float(texts[0].split("by ")[1].split(" ppm")[0]) == pytest.approx(ppm, rel=0.1)


def test_one_clock_is_not():
    found = frequency_response(flown(0), np.geomspace(2.0, 12.0, 30))
    assert all(remark.kind != "clock" for remark in found.remarks)
