"""What the joint estimate of a closed loop says of its errors, over noise draws."""

import dataclasses
from typing import cast

import numpy as np
import pytest
from scipy import signal

import jaxquad as jq


DT = 0.02
OMEGA = np.geomspace(0.5, 15.0, 40)


def swept(seconds, inputs=1):
    """Sweeps with 2 s of rest, those of several inputs one after the other backwards."""
    found = jq.sweep(0.5, 15.0, duration=seconds - 2.0, sample_rate=1 / DT, amplitude=1.0, trim=0.0)
    up = np.concatenate([found.signal, np.zeros(int(2.0 / DT))])
    return np.stack([up, up[::-1]][:inputs], axis=1)


def coloured(rng, shape, corner, deviation):
    """First-order noise of a corner in rad/s."""
    pole = np.exp(-corner * DT)
    white = rng.standard_normal((shape[0] + 500, shape[1])) * deviation * np.sqrt(1 - pole**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -pole], white, axis=0))[500:]


class Loop:
    """x' = A x + B (u + gust), y = C x + noise, u = r - K y; all but x' sampled and held."""

    def __init__(self, A, B, C, K):
        parts = *(np.asarray(each) for each in (A, B, C)), np.zeros((len(C), len(B[0])))
        self.F, self.H, *_ = cast(tuple[np.ndarray, ...], signal.cont2discrete(parts, DT))
        self.C, self.K = parts[2], np.asarray(K)

    def plant(self, omega):
        z = np.exp(1j * omega * DT)[:, None, None]
        return self.C @ np.linalg.solve(z * np.eye(len(self.F)) - self.F, self.H + 0j)

    def record(self, reference, gust, noise):
        """Through the closed loop at once: the noise enters by the feedback."""
        closed, count = self.F - self.H @ self.K @ self.C, len(reference)
        pushed = (reference + gust) @ self.H.T - noise @ (self.H @ self.K).T
        x = np.zeros((count + 1, len(self.F)))
        for k in range(count):
            x[k + 1] = closed @ x[k] + pushed[k]
        y = x[:-1] @ self.C.T + noise
        return jq.Record(DT * np.arange(count), reference - y @ self.K.T, y, reference, hold=DT)


MODE = ([[0.0, 1.0], [-16.0, -1.2]], [[0.0], [20.0]], [[1.0, 0.0]])  # 4 rad/s, damped by 0.15
VEHICLE = (  # an angle, its rate and the motor's lag; angle and rate are fed back as one
    [[0.0, 1.0, 0.0], [0.0, 0.0, 4.0], [0.0, 0.0, -10.0]],
    [[0.0], [0.0], [10.0]],
    [[1.0, 0.5, 0.0]],
)
PAIR = ([[-1.0, 0.6], [-0.4, -2.5]], [[3.0, 0.5], [0.4, 4.0]], [[1.0, 0.0], [0.2, 1.0]])

CASES = {  # loop, seconds, gust's corner and size, noise
    "mode in a gust": (Loop(*MODE, [[0.6]]), 60.0, 1.0, 0.05, 0.01),
    "vehicle in slow gusts": (Loop(*VEHICLE, [[2.0]]), 90.0, 0.5, 0.03, 0.005),
    "tight loop, white noise": (Loop(*VEHICLE, [[5.0]]), 60.0, 20.0, 0.0, 0.03),
    "short record": (Loop(*MODE, [[0.3]]), 30.0, 5.0, 0.05, 0.01),
    "two inputs": (Loop(*PAIR, [[0.8, 0.0], [0.2, 0.5]]), 120.0, 1.0, 0.1, 0.02),
}


def estimates(name, draws):
    loop, seconds, corner, size, noise = CASES[name]
    reference = swept(seconds, len(loop.K))
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        gust = coloured(rng, reference.shape, corner, size)
        record = loop.record(reference, gust, noise * rng.standard_normal((len(gust), len(loop.C))))
        joint = jq.spectra.JointInputOutput()
        yield loop, jq.frequency_response(record, OMEGA, estimator=joint)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_95_per_cent_intervals_of_the_response_hold_the_plant(name):
    """Where the error is below 10 % in the median; beyond, a ratio is not normal."""
    off, claimed = [], []
    for loop, found in estimates(name, 60):
        off.append(np.asarray(found.response) - loop.plant(OMEGA))
        claimed.append(np.sqrt(np.asarray(found.errors.variance()) / 2))
    off, claimed = np.array(off), np.array(claimed)
    plant = np.abs(CASES[name][0].plant(OMEGA))
    counted = np.isfinite(off) & (np.median(claimed, axis=0) < 0.1 * plant)
    z = np.stack([np.real(off), np.imag(off)])[:, counted] / claimed[counted]
    # 60 draws of some 8 independent points leave 1 % of doubt.
    assert 0.93 <= np.mean(np.abs(z) < 1.96) <= 0.975
    assert 0.9 < np.sqrt(np.mean(z**2)) < 1.1


def cut_off(seed):
    """8 s of rest and of the beginning of a sweep, of a mode in a gust, and rounded otherwise."""
    loop, clock = CASES["mode in a gust"][0], np.clip(DT * np.arange(400) - 3.0, 0.0, None)
    growth = np.log(15.0) / 7.0
    edge = np.minimum(np.minimum(clock, 7.0 - clock) / 2, 1.0)
    wave = (0.5 - 0.5 * np.cos(np.pi * edge)) * np.sin(np.expm1(growth * clock) / growth)
    rng = np.random.default_rng(seed)
    gust = coloured(rng, (400, 1), 1.0, 0.05)
    flown = loop.record(wave[:, None], gust, 0.01 * rng.standard_normal((400, 1)))
    digits = 1 + 1e-14 * rng.uniform(-1, 1, flown.outputs.shape)
    return flown, dataclasses.replace(flown, outputs=flown.outputs * digits)


def test_the_last_digits_of_a_short_record_do_not_choose_its_models():
    """Other minima, which leave hardly more, are up to twenty errors away."""
    omega = np.geomspace(1.5, 14.0, 40)
    one, other = (
        jq.frequency_response(each, omega, estimator=jq.spectra.JointInputOutput())
        for each in cut_off(0)
    )
    known = np.isfinite(one.response)
    assert np.count_nonzero(known) > 10
    apart = np.abs(one.response / other.response - 1)[known] / one.random_error[known]
    assert np.max(apart) < 1e-3


def test_the_share_of_the_denominator_falls_as_the_loop_opens():
    """Below its bandwidth a loop gives all of r to -1/C, and little of it to the input."""
    divided = next(estimates("tight loop, white noise", 1))[1].divided
    assert divided is not None
    assert np.mean(divided[:8]) > 0.9 and np.mean(divided[-8:]) < 0.5
