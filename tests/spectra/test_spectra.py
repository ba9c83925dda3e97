import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxquad.excitation import sweep
from jaxquad.models import simulate_linear, TransferFunction
from jaxquad.records import Record
from jaxquad.spectra import frequency_response, JointInputOutput, spectral_density, Welch


RATE, LENGTH, SEGMENTS = 50.0, 200, 11
SAMPLES = LENGTH + (SEGMENTS - 1) * LENGTH // 5  # windows that overlap by 0.8 or 0.5 tile it
BINS = 2 * np.pi * RATE / LENGTH * np.arange(1, 80)  # rad/s, where scipy's transforms lie
HANN = np.asarray(signal.get_window("hann", LENGTH))
WELCH = Welch(window_length=LENGTH / RATE)

RATE_SWEEP = 100.0
SWEEP = sweep(0.5, 12.0, duration=80.0, sample_rate=RATE_SWEEP, amplitude=1.0).signal
OMEGA = np.geomspace(0.6, 10.0, 30)


def filtered(numerator, denominator, x):
    return np.asarray(signal.lfilter(numerator, denominator, x))


def record(seed=0, *, samples=SAMPLES, rate=RATE, jump=0.0, references=0):
    """Filtered noise in, lagged and noisy out; channels have a mean, which detrending removes."""
    draw = np.random.default_rng(seed).standard_normal((samples, 2))
    u = filtered([1.0, 0.5], [1.0, -0.3], draw[:, 0]) + jump
    y = filtered([0.3, 0.1], [1.0, -0.7], u) + 0.2 * draw[:, 1] - 3.0
    r = np.roll(draw, 1, axis=0)[:, :references]
    return Record(np.arange(samples) / rate, u, y, r if references else None)


def by_scipy(function, *channels, **changes):
    options = dict(fs=RATE, nperseg=LENGTH, noverlap=LENGTH * 4 // 5, window="hann") | changes
    return function(*channels, **options)[1][1:80]


def by_hand(x, starts, omega):
    """Fourier sums of Hann windows with numpy, one term after the other."""
    cut = np.stack([x[start : start + LENGTH] for start in starts])
    kernel = np.exp(-1j * np.outer(np.arange(LENGTH) / RATE, omega))
    return ((cut - cut.mean(axis=1, keepdims=True)) * HANN) @ kernel


def response(y, u, rate, estimator, omega):
    found = frequency_response(Record(np.arange(len(u)) / rate, u, y), omega, estimator=estimator)
    return np.asarray(found.response)[:, 0, 0]


def test_power_and_cross_spectra_are_those_of_scipy():
    data = record()
    u, y = data.inputs[:, 0], data.outputs[:, 0]
    found = spectral_density(data, BINS, welch=WELCH)
    np.testing.assert_allclose(found.power("u"), by_scipy(signal.welch, u), rtol=1e-10)
    np.testing.assert_allclose(found.power("y"), by_scipy(signal.welch, y), rtol=1e-10)
    np.testing.assert_allclose(found.cross("u", "y"), by_scipy(signal.csd, u, y), rtol=1e-10)
    coherence = by_scipy(signal.coherence, u, y)
    np.testing.assert_allclose(found.coherence("u", "y"), coherence, rtol=1e-10)


@pytest.mark.parametrize(
    "ours, scipys",
    [
        (dict(shape="hamming"), dict(window="hamming")),
        (dict(shape="rectangular"), dict(window="boxcar")),
        (dict(detrend="linear"), dict(detrend="linear")),
        (dict(detrend="none"), dict(detrend=False)),
        (dict(overlap=0.5), dict(noverlap=LENGTH // 2)),
    ],
)
def test_windows_trends_and_overlaps_are_those_of_scipy(ours, scipys):
    data = record()
    found = spectral_density(data, BINS, welch=Welch(LENGTH / RATE, **ours)).power("y")
    # Where a mean is left in, the far bins of its 1e4 times larger leakage hold 1e-9 of rounding.
    expected = by_scipy(signal.welch, data.outputs[:, 0], **scipys)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_the_density_matrix_is_hermitian():
    found = np.asarray(spectral_density(record(references=1), BINS, welch=WELCH).density)
    assert found.shape == (79, 3, 3)
    np.testing.assert_allclose(found, np.conj(np.swapaxes(found, 1, 2)), rtol=1e-12)


def test_an_unknown_channel_is_named_with_the_known_ones():
    with pytest.raises(ValueError, match="there is no channel 'q': the channels are u, y"):
        spectral_density(record(), BINS, welch=WELCH).power("q")


def test_the_direct_response_is_the_ratio_of_scipys_spectra():
    data = record()
    u, y = data.inputs[:, 0], data.outputs[:, 0]
    found = frequency_response(data, BINS, estimator=WELCH)
    expected = by_scipy(signal.csd, u, y) / by_scipy(signal.welch, u)
    np.testing.assert_allclose(found.response[:, 0, 0], expected, rtol=1e-10)
    np.testing.assert_allclose(
        found.coherence[:, 0, 0], by_scipy(signal.coherence, u, y), rtol=1e-10
    )


def test_the_joint_response_is_the_ratio_of_scipys_cross_spectra():
    data = record(references=1)
    u, y, r = (data.channel(name) for name in "uyr")
    found = frequency_response(data, BINS, estimator=JointInputOutput(WELCH))
    expected = by_scipy(signal.csd, r, y) / by_scipy(signal.csd, r, u)
    np.testing.assert_allclose(found.response[:, 0, 0], expected, rtol=1e-9)


def test_between_the_bins_spectra_equal_fourier_sums_taken_term_by_term():
    data, omega = record(), np.geomspace(2.0, 150.0, 79)
    starts = range(0, SAMPLES - LENGTH + 1, LENGTH // 5)
    u, y = (by_hand(data.channel(name), starts, omega) for name in "uy")
    scale = 2 / RATE / np.sum(HANN**2) / SEGMENTS
    expected = scale * np.sum(np.conj(u) * y, axis=0)
    found = spectral_density(data, omega, welch=WELCH).cross("u", "y")
    # Relative to the largest: rounding errors are, and some values are nearly zero.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-11 * np.abs(expected).max())


@pytest.mark.parametrize("place", [slice(0, 60), slice(-60, None)])
def test_windows_reach_both_ends_of_a_record(place):
    """A burst in the last second counts, though no whole number of steps ends there."""
    u = np.zeros(SAMPLES + 17)
    u[place] = np.random.default_rng(0).standard_normal(60)
    burst = Record(np.arange(u.size) / RATE, u, np.roll(u, 1))
    assert np.all(spectral_density(burst, BINS, welch=WELCH).power("u") > 1e-7)


def test_several_records_are_averaged_as_sums_of_their_own_windows():
    a, b = record(1), record(2, jump=20.0)
    found = spectral_density([a, b], BINS, welch=WELCH).density
    each = [np.asarray(spectral_density(x, BINS, welch=WELCH).density) for x in (a, b)]
    np.testing.assert_allclose(found, np.mean(each, axis=0), rtol=1e-12)


def test_no_window_spans_the_seam_of_two_records():
    a, b = record(1), record(2, jump=20.0)
    both = [np.concatenate([a.channel(name), b.channel(name)]) for name in "uy"]
    welded = Record(np.arange(2 * SAMPLES) / RATE, both[0], both[1])
    apart = spectral_density([a, b], BINS, welch=WELCH).power("u")
    across = spectral_density(welded, BINS, welch=WELCH).power("u")
    assert np.all(np.asarray(across)[:2] > 3 * np.asarray(apart)[:2])


def test_records_of_different_lengths_are_averaged():
    found = frequency_response([record(1), record(2, samples=SAMPLES + 31)], BINS, estimator=WELCH)
    assert np.all(np.isfinite(found.random_error))


def test_a_known_filter_is_recovered_without_noise():
    taps, u = np.array([0.5, 0.3, -0.2]), record(samples=SWEEP.size).inputs[:, 0]
    found = response(filtered(taps, 1.0, u), u, RATE_SWEEP, Welch(20.0), OMEGA)
    expected = np.exp(-1j * np.outer(OMEGA / RATE_SWEEP, np.arange(3))) @ taps
    # The filter's memory of 2 in 2000 samples leaks past the window's edges, weighed by its slope.
    np.testing.assert_allclose(found, expected, rtol=2e-3)


def worst(found, exact):
    return np.abs(found / exact - 1).max()


def test_differencing_removes_the_leakage_of_a_double_integrator():
    model = TransferFunction([1.0], [1.0, 0.0, 0.0])
    output = simulate_linear(model, jnp.asarray(SWEEP), 1 / RATE_SWEEP, hold="first")
    output, cosine = np.asarray(output), np.cos(OMEGA / RATE_SWEEP)
    # Of the sampled model, (z + 4 + 1/z) / (z - 2 + 1/z) dt^2 / 6: 0.3 % from 1/s^2 at 10 rad/s.
    exact = (2 * cosine + 4) / (2 * cosine - 2) / (6 * RATE_SWEEP**2)
    plain, whitened = (
        response(output, SWEEP, RATE_SWEEP, Welch(20.0, integrators=n), OMEGA) for n in (0, 2)
    )
    assert worst(plain, exact) > 0.05
    assert worst(whitened, exact) < 1e-3


def test_taking_out_the_delay_removes_the_bias_of_the_window():
    late = np.concatenate([np.zeros(60), SWEEP[:-60]])
    exact = np.exp(-1j * OMEGA * 60 / RATE_SWEEP)
    plain, shifted = (
        response(late, SWEEP, RATE_SWEEP, Welch(20.0, delay=delay), OMEGA) for delay in (0.0, 0.6)
    )
    assert worst(plain, exact) > 0.01
    assert worst(shifted, exact) < 1e-10
