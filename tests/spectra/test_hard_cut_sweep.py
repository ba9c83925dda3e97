"""A sweep that is cut hard, in a PI rate loop: the joint estimate where its band begins.

Below it the loop takes a hundredth of the reference to the input, and its noise rises with the cube
of frequency: a global model that fits the loud bins leaves many times the response in the quiet
ones.
"""

import functools as ft

import numpy as np
import pytest

from jaxquad.records import Record
from jaxquad.spectra import frequency_response, JointInputOutput, LocalPolynomial


GAIN, LAG, DT, LATE = 100.0, 0.03, 0.004, 2  # s; the delay in samples
SECONDS, REST, LOW, HIGH = 60.0, 3.0, 0.3, 15.0  # s and Hz
FADED = np.exp(-DT / LAG)
ESTIMATOR = JointInputOutput(LocalPolynomial(integrators=1, delay=0.04))


def cut_sweep():
    time = np.arange(round(SECONDS / DT)) * DT
    rate = np.log(HIGH / LOW) / SECONDS
    wave = 0.3 * np.sin(2 * np.pi * LOW / rate * np.expm1(rate * time))
    return time, np.where((time < 2.0) | (time > SECONDS - REST), 0.0, wave)


def exact(omega):
    """GAIN e^(-LATE DT s) / (s (LAG s + 1)) of a held input."""
    z = np.exp(1j * omega * DT)
    held = GAIN * DT / (z - 1) - GAIN * LAG * (1 - FADED) / (z - FADED)
    return held * z**-LATE


@ft.cache
def flown(seed: int, noise: float) -> Record:
    """The loop u = 0.08 e + 0.1 int e dt + reference, e = -q measured."""
    time, reference = cut_sweep()
    u, q = np.zeros_like(time), np.zeros_like(time)
    measured_noise = noise * np.random.default_rng(seed).standard_normal(time.size)
    rate, torque, integral = 0.0, 0.0, 0.0
    for k in range(time.size):
        q[k] = rate + measured_noise[k]
        integral -= 0.1 * DT * q[k]
        u[k] = integral - 0.08 * q[k] + reference[k]
        late = u[k - LATE] if k >= LATE else 0.0
        rate += GAIN * (LAG * (1 - FADED) * torque + (DT - LAG * (1 - FADED)) * late)
        torque = FADED * torque + (1 - FADED) * late
    return Record(time, u, q, references=reference, hold=DT)


def over_errors(found):
    """Errors over the claimed ones of real and imaginary part, each, at known frequencies."""
    omega = np.asarray(found.omega)
    measured, error = (np.asarray(each)[:, 0, 0] for each in (found.response, found.random_error))
    known = np.isfinite(measured) & (error < 0.2)
    return omega[known], (np.abs(measured - exact(omega)) / (error * np.abs(measured)))[known]


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 3])
def test_below_a_cut_sweep_the_errors_of_the_joint_estimate_are_claimed(seed):
    found = frequency_response(flown(seed, 0.02), estimator=ESTIMATOR)
    omega, off = over_errors(found)
    assert np.sum(omega < 2 * np.pi * LOW) >= 10
    assert np.max(off) < 5 and np.sqrt(np.mean(off**2) / 2) < 1.3


@pytest.mark.slow
def test_a_cut_sweep_with_3_s_of_rest_is_no_mode_that_rings():
    omega = 2 * np.pi * np.geomspace(LOW, 12.0, 100)
    for seed in (0, 1):
        found = frequency_response(flown(seed, 0.02), omega, estimator=ESTIMATOR)
        assert not found.remarks
        assert np.max(over_errors(found)[1]) < 5
