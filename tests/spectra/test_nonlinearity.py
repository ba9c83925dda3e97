"""Harmonics of a sweep in the residual: found where an actuator is not linear, and only there."""

import numpy as np
import pytest
from scipy import signal

from jaxquad.records import Record
from jaxquad.spectra import frequency_response, JointInputOutput, Welch
from jaxquad.spectra._linearity import interpolated, phase_of_sweep


DT, SAMPLES = 0.02, 3000
OMEGA = np.geomspace(1.5, 12.0, 30)
TIME = DT * np.arange(SAMPLES)
WELCH = Welch(12.0)


def sweep(low=0.6, high=14.0, rest=150):
    """Logarithmic, faded in and out, with a rest at the end."""
    t = TIME[: SAMPLES - rest]
    rate, end = np.log(high / low), t[-1]
    phase = low * end / rate * (np.exp(rate * t / end) - 1)
    fade = np.clip(t, 0, 1) * np.clip(end - t, 0, 1)
    return np.pad(fade * np.sin(phase), (0, rest))


def linear(u):
    return u


def deadband(u, share=0.15):
    return np.sign(u) * np.maximum(np.abs(u) - share, 0)


def saturation(u, share=0.2):
    return np.clip(u, share - 1, 1 - share)


def open_loop(actuator, seed, noise=0.05):
    """A mode at 5 rad/s behind an actuator, under coloured noise."""
    u, rng = sweep(), np.random.default_rng(seed)
    plant = signal.bilinear([40.0], [1.0, 4.0, 25.0], fs=1 / DT)
    y = np.asarray(signal.lfilter(*plant, actuator(u)))
    gust = np.asarray(signal.lfilter([0.2], [1.0, -0.96], rng.standard_normal(SAMPLES)))
    return Record(TIME, u, y + noise * np.std(y) * gust)


def closed_loop(actuator, seed):
    """A lagged integrator under proportional feedback with gusts; the sweep is the reference."""
    r, rng = sweep(), np.random.default_rng(seed)
    u, y, rate, lagged = np.zeros(SAMPLES), np.zeros(SAMPLES), 0.0, 0.0
    gust = np.asarray(signal.lfilter([0.01], [1.0, -0.98], rng.standard_normal(SAMPLES)))
    error = 0.005 * rng.standard_normal(SAMPLES)
    for k in range(SAMPLES):
        y[k] = rate + error[k]
        u[k] = r[k] - 0.3 * y[k]
        lagged += 0.3 * (actuator(u[k]) - lagged)
        rate += DT * 5 * (lagged + gust[k])
    return Record(TIME, u, y, r)


def remarks(record):
    joint = bool(record.reference_names)
    found = frequency_response(record, OMEGA, estimator=JointInputOutput(WELCH) if joint else WELCH)
    return [remark for remark in found.remarks if "not linear" in remark]


@pytest.mark.parametrize("flight", [open_loop, closed_loop])
def test_a_deadband_and_a_saturation_are_found(flight):
    for seed in range(4):
        (broken,), (clipped,) = (remarks(flight(f, seed)) for f in (deadband, saturation))
        assert "as a deadband or friction causes" in broken and "saturation" in clipped
        assert broken.pair is not None and broken.omega


@pytest.mark.parametrize("flight", [open_loop, closed_loop])
def test_linear_records_are_not_remarked(flight):
    # A chance of 0.5 % each; these seeds are fixed.
    assert not any(remarks(flight(linear, seed)) for seed in range(12))


@pytest.mark.parametrize("share", [0.1, 0.15, 0.2])
def test_the_bias_that_the_remark_names_is_that_of_the_gain(share):
    # Describing function of a deadband: Gelb and Vander Velde (1968), table B.
    truth = 2 / np.pi * (np.arcsin(share) + share * np.sqrt(1 - share**2))
    (remark,) = remarks(open_loop(lambda u: deadband(u, share), 0, noise=0.01))
    named = float(remark.split("biased by about ")[1].split(" %")[0]) / 100
    assert named == pytest.approx(truth, rel=0.35)


@pytest.mark.parametrize("level", [0.8, 0.6, 0.5])
def test_the_bias_that_the_remark_names_is_that_of_a_saturated_gain(level):
    truth = 1 - 2 / np.pi * (np.arcsin(level) + level * np.sqrt(1 - level**2))
    (remark,) = remarks(open_loop(lambda u: np.clip(u, -level, level), 0, noise=0.01))
    named = float(remark.split("biased by about ")[1].split(" %")[0]) / 100
    assert named == pytest.approx(truth, rel=0.15)


def test_a_signal_that_is_no_sweep_has_no_phase():
    rng = np.random.default_rng(0)
    lines = np.zeros(SAMPLES // 2 + 1, complex)
    lines[20:150] = np.exp(2j * np.pi * rng.uniform(size=130))
    steps = np.sign(rng.standard_normal(30)).repeat(100)
    for other in (np.fft.irfft(lines), rng.standard_normal(SAMPLES), steps):
        assert phase_of_sweep(other) is None
    swept = phase_of_sweep(sweep())
    assert swept is not None and np.all(np.diff(swept[0]) >= 0)


def test_a_response_is_interpolated_across_a_wide_gap_near_its_points():
    omega = np.append(np.geomspace(0.21, 0.45, 16), 22.0)
    size = np.append(np.linspace(0.11, 0.09, 14), [0.147, 0.140, 0.172])
    grid = np.geomspace(0.21, 22.0, 500)
    found = np.abs(interpolated(grid, omega, size.astype(complex)[:, None]))
    assert np.all((found > 0.09 / np.e - 1e-9) & (found < 0.172 * np.e + 1e-9))


@pytest.mark.parametrize("steps", [4.7, 5.0, 5.3])
def test_steps_of_an_actuator_are_remarked_with_the_bias_of_the_gain(steps):
    # Describing function of a rounding: Gelb and Vander Velde (1968), table B.
    edges = (2 * np.arange(1, int(steps + 0.5) + 1) - 1) / (2 * steps)
    truth = 4 / (np.pi * steps) * np.sum(np.sqrt(1 - edges**2)) - 1
    record = open_loop(lambda u: np.round(u * steps) / steps, 0, noise=0.01)
    (remark,) = frequency_response(record, OMEGA).remarks
    assert remark.kind == "steps"
    named = float(remark.split("biased by about ")[1].split(" %")[0]) / 100
    assert named == pytest.approx(truth, rel=0.4)
    assert float(remark.split("steps of ")[1].split(",")[0]) == pytest.approx(1 / steps, rel=0.05)
