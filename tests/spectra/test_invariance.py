"""A static nonlinearity and a plant that changes, found in the residual of any excitation."""

import numpy as np
import pytest
from scipy import signal

from jaxquad.records import Record
from jaxquad.spectra import frequency_response, JointInputOutput, LocalPolynomial, Welch


DT, SAMPLES = 0.02, 2000
OMEGA = np.geomspace(2.0, 20.0, 40)
PLAIN = LocalPolynomial(global_order=0)


def levels(rng):
    """Steps at random times, of three sizes."""
    sizes = rng.choice([0.5, 1.0, 1.5], SAMPLES // 40).repeat(40)
    return sizes * rng.choice([-1.0, 1.0], SAMPLES // 5).repeat(5)


def tones(rng, samples=SAMPLES):
    """A multisine of unit size."""
    lines = np.zeros(samples // 2 + 1, complex)
    lines[1 : samples // 6] = np.exp(2j * np.pi * rng.uniform(size=samples // 6 - 1))
    wave = np.fft.irfft(lines, samples)
    return wave / np.std(wave)


def mode(u, frequency=8.0, damping=0.3):
    """A mode in rad/s, sampled."""
    numerator, denominator = [1.5 * frequency**2], [1.0, 2 * damping * frequency, frequency**2]
    return np.asarray(signal.lfilter(*signal.bilinear(numerator, denominator, fs=1 / DT), u))


def flown(u, y, rng, noise=0.1):
    coloured = np.asarray(signal.lfilter([0.8], [1.0, -0.6], rng.standard_normal(u.size)))
    return Record(DT * np.arange(u.size), u, y + noise * coloured, hold=DT)


def drifting(u):
    """From one mode to another whose frequency is 15 % lower."""
    share = np.linspace(0.0, 1.0, u.size)
    return (1 - share) * mode(u, 8.6) + share * mode(u, 7.4)


def remarks(records, estimator: LocalPolynomial | Welch | JointInputOutput = PLAIN):
    found = frequency_response(records, OMEGA, estimator=estimator).remarks
    return [x for x in found if "not linear" in x or "changes during" in x]


STATIC = {
    "saturation": (lambda u: np.clip(u, -1, 1), levels, "a saturation"),
    "cubic": (lambda u: u - 0.1 * u**3, tones, "a saturation"),
    "deadband": (lambda u: np.sign(u) * np.maximum(np.abs(u) - 0.3, 0), tones, "a deadband"),
    "square": (lambda u: u + 0.1 * u**2, tones, "larger for positive commands"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", STATIC)
def test_a_static_nonlinearity_is_found_and_named(name):
    bend, excite, words = STATIC[name]
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = excite(rng)
        (remark,) = remarks(flown(u, mode(bend(u)), rng))
        assert words in remark and remark.pair is not None and remark.omega


def test_the_change_of_the_gain_is_that_between_small_and_large_commands():
    rng = np.random.default_rng(0)
    u = tones(rng)
    small, large = np.percentile(np.abs(u), [20, 95])
    (remark,) = remarks(flown(u, mode(u - 0.1 * u**3), rng, noise=0.03))
    named = float(remark.split("falls by about ")[1].split(" %")[0]) / 100
    assert named == pytest.approx(1 - (1 - 0.1 * large**2) / (1 - 0.1 * small**2), rel=0.2)


@pytest.mark.parametrize("estimator", [PLAIN, Welch(8.0)])
def test_a_plant_that_changes_is_found(estimator):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = tones(rng)
        (remark,) = remarks(flown(u, drifting(u), rng), estimator)
        assert "response changes during the record" in remark


def test_the_change_is_that_between_the_halves():
    rng = np.random.default_rng(1)
    u = tones(rng)
    (remark,) = remarks(flown(u, mode(u * np.linspace(0.8, 1.2, SAMPLES)), rng))
    # The mean gain is 0.9 in the first half, and 1.1 in the second.
    assert float(remark.split("by about ")[1].split(" %")[0]) == pytest.approx(20, abs=4)


@pytest.mark.slow
@pytest.mark.parametrize("excite", [levels, tones])
def test_linear_records_are_not_remarked(excite):
    # White, coloured and growing noise, and a trim; a chance below 1e-4 each, with fixed seeds.
    for seed in range(8):
        rng = np.random.default_rng(seed)
        u = excite(rng) + 0.3
        y = mode(u)
        y[SAMPLES * 2 // 3 :] += 0.3 * rng.standard_normal(SAMPLES - SAMPLES * 2 // 3)
        assert not remarks(flown(u, y, rng))


def test_a_record_without_noise_is_not_remarked():
    u = tones(np.random.default_rng(3))
    assert not remarks(Record(DT * np.arange(SAMPLES), u, mode(u), hold=DT))


def closed_loop(bend, seed):
    """A lagged integrator under proportional feedback with gusts; r is added to the command."""
    rng = np.random.default_rng(seed)
    r, gust = tones(rng), 0.3 * rng.standard_normal(SAMPLES)
    u, y, rate, lagged = np.zeros(SAMPLES), np.zeros(SAMPLES), 0.0, 0.0
    for k in range(SAMPLES):
        y[k] = rate
        u[k] = r[k] - 0.3 * y[k]
        lagged += 0.3 * (bend(u[k]) - lagged)
        rate += DT * 5 * (lagged + gust[k])
    return Record(DT * np.arange(SAMPLES), u, y, r, hold=DT)


def test_joint_estimates_are_tested_by_the_part_that_the_reference_moves():
    estimator = JointInputOutput(PLAIN)
    for seed in range(3):
        (remark,) = remarks(closed_loop(lambda u: min(max(u, -1.0), 1.0), seed), estimator)
        assert "a saturation" in remark
        assert not remarks(closed_loop(lambda u: u, seed), estimator)


def test_an_excitation_that_repeats_is_told_its_period():
    rng = np.random.default_rng(0)
    waves = [np.tile(tones(rng, 500), 4) for _ in range(3)]
    bent = [flown(u, mode(u - 0.1 * u**3), rng) for u in waves]
    (remark,) = remarks(bent)
    assert "jq.spectra.Periodic(10) " in remark
    halves = [Record(r.time[:1000], r.inputs[:1000], r.outputs[:1000], hold=DT) for r in bent]
    (remark,) = remarks(halves)
    assert "jq.spectra.Periodic(10, discard=0)" in remark
    assert not remarks([flown(u, mode(u), rng) for u in waves])
    other = tones(rng)
    (remark,) = remarks([*bent, flown(other, mode(other - 0.1 * other**3), rng)])
    assert "Periodic" not in remark
