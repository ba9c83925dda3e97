import numpy as np
import pytest

from jaxquad.records import Record
from jaxquad.spectra import Composite, Welch
from jaxquad.spectra._average import transform_records
from jaxquad.spectra._fourier_sums import (
    _block_functions,
    fourier_sums,
    lattice_windows,
    segment_starts,
    Taper,
    window,
)


# Lengths of whole blocks and odd ones, short and very short; starts on and off blocks.
WINDOWS = ((640, (0, 17, 320, 960)), (601, (0, 999)), (127, (0, 1473)), (9, (0, 1591)))
SAMPLES = 1600
# Out of order, negative, zero, next to zero and Nyquist's.
ANGLE = np.concatenate([np.geomspace(3.0, 1e-3, 21), [0.0, -0.3, 1e-9, np.pi]])
RECORD = np.random.default_rng(0).standard_normal((SAMPLES, 3))


def direct_sums(x, angle, length, starts, shape="hann", detrend="constant", origin=0.0):
    n = np.arange(length)
    trends = {"none": [], "constant": [n**0], "linear": [n**0, n / length]}[detrend]
    sums = []
    for start in starts:
        segment = x[start : start + length]
        if trends:
            fit = np.linalg.lstsq(np.stack(trends, 1), segment, rcond=None)[0]
            segment = segment - np.stack(trends, 1) @ fit
        waves = np.exp(-1j * np.multiply.outer(angle, origin + start + n))
        sums.append(waves @ (window(shape, length)[:, None] * segment))
    return np.stack(sums, axis=1)


def transform_windows(x, angle, windows, *, shape="hann", detrend="constant", origin=0.0):
    taper = (Taper(shape, x.shape[1]),)
    return fourier_sums((x,), angle, windows, taper, detrend=detrend, origin=origin)[0]


def assert_sums(found, expected, relative):
    assert found.shape == expected.shape
    assert np.max(np.abs(found - expected)) <= relative * np.max(np.abs(expected))


@pytest.mark.parametrize(
    ("shape", "detrend"),
    [("hann", "linear"), ("hamming", "constant"), ("rectangular", "none")]
    + [
        pytest.param(shape, detrend, marks=pytest.mark.slow)
        for shape, detrend in (
            ("hann", "none"), ("hann", "constant"), ("hamming", "none"), ("hamming", "linear"),
            ("rectangular", "constant"), ("rectangular", "linear"),
        )
    ],
)  # fmt: skip
def test_sums_equal_those_term_by_term(shape, detrend):
    found = transform_windows(RECORD, ANGLE, WINDOWS, shape=shape, detrend=detrend, origin=12.5)
    for (length, starts), sums in zip(WINDOWS, found, strict=True):
        expected = direct_sums(RECORD, ANGLE, length, starts, shape, detrend, 12.5)
        # The tolerance of the compression, 2e-13, with room for rounding.
        assert_sums(np.asarray(sums), expected, 1e-12)


def test_one_channel_at_one_frequency_far_from_the_origin():
    found = transform_windows(RECORD[:, :1], np.array([0.02]), ((500, (3, 77)),), origin=1e5)
    expected = direct_sums(RECORD[:, :1], np.array([0.02]), 500, (3, 77), origin=1e5)
    # A phase of 2000 rad is known to 2e-13.
    assert_sums(np.asarray(found[0]), expected, 2e-12)


@pytest.mark.parametrize("length", [2, 8, 50, 100])
def test_very_short_records_are_summed(length):
    starts = segment_starts(100, length, 0.5)
    found = transform_windows(RECORD[:100], ANGLE, ((length, starts),), detrend="none")
    expected = direct_sums(RECORD[:100], ANGLE, length, starts, detrend="none")
    assert_sums(np.asarray(found[0]), expected, 1e-12)


@pytest.mark.parametrize("detrend", ["constant", "linear"])
def test_a_large_offset_does_not_drown_the_signal(detrend):
    found = transform_windows(RECORD + 1e6, ANGLE, WINDOWS, detrend=detrend)
    for (length, starts), sums in zip(WINDOWS, found, strict=True):
        expected = direct_sums(RECORD, ANGLE, length, starts, "hann", detrend)
        # The sum 1e6 + x itself is rounded by 1e-10.
        assert_sums(np.asarray(sums), expected, 1e-9)


def test_a_linear_trend_leaves_nothing():
    ramp = np.linspace(-5, 20, SAMPLES)[:, None] * np.ones(3)
    found = transform_windows(ramp, ANGLE, WINDOWS, detrend="linear")
    for (length, _), sums in zip(WINDOWS, found, strict=True):
        assert np.max(np.abs(sums)) <= 1e-12 * 20 * length


def test_a_second_record_of_the_same_layout_reuses_the_tables():
    found = [transform_windows(gain * RECORD, ANGLE, WINDOWS)[1] for gain in (1.0, -2.0)]
    assert_sums(np.asarray(found[1]), -2 * np.asarray(found[0]), 1e-15)


@pytest.mark.parametrize("samples", [60_000, 60_123, 30_001])
@pytest.mark.parametrize("overlap", [0.0, 0.5, 0.8])
def test_lattice_windows_reach_both_ends_and_keep_their_overlap(samples, overlap):
    lengths = (15_000, 9_999, 2500, 100)
    windows = lattice_windows(samples, lengths, overlap, 0.2)
    for asked, (length, starts) in zip(lengths, windows, strict=True):
        assert starts[0] == 0 and starts[-1] + length == samples
        assert length == pytest.approx(asked, rel=0.1)
        # A start moves by half a block, of at most an eighth of a window and a half, at each end.
        assert np.max(np.diff(starts)) <= length * (1 - overlap + 3 / 16) + 1
        assert np.all(np.diff(starts) > 0)


@pytest.mark.parametrize("dt", [1 / 500, 1 / 400, 1 / 307])
def test_lattice_windows_share_their_blocks(dt):
    lengths = tuple(round(seconds / dt) for seconds in (30, 20, 12, 8, 5))
    windows = lattice_windows(round(121.3 / dt), lengths, 0.5, 100 * dt)
    lengths = [length for length, _ in windows]
    # All but the first window of each length, which starts at the first sample.
    shifts = [start - starts[-1] for _, starts in windows for start in starts[1:]]
    assert np.gcd.reduce(lengths + shifts) >= 64


def test_sums_on_a_lattice_equal_those_term_by_term():
    x = RECORD[:1573]
    windows = lattice_windows(1573, (1000, 700), 0.5, 0.2)
    found = transform_windows(x, np.array([0.01, 0.2]), windows)
    for (length, starts), sums in zip(windows, found, strict=True):
        expected = direct_sums(x, np.array([0.01, 0.2]), length, starts)
        assert_sums(np.asarray(sums), expected, 1e-12)


@pytest.mark.parametrize("samples", [120, 121])
def test_functions_on_blocks_are_even_or_odd_and_span_the_band(samples):
    even, odd = _block_functions(samples, 0.3)
    assert even.shape[1] + odd.shape[1] < samples / 2
    place = np.arange(samples) - (samples - 1) / 2
    for functions, wave, sign in ((even, np.cos, 1), (odd, np.sin, -1)):
        rows = wave(np.multiply.outer(np.linspace(-0.3, 0.3, 77), place))
        np.testing.assert_allclose(rows @ functions @ functions.T, rows, atol=1e-12)
        np.testing.assert_allclose(rows[:, ::-1], sign * rows)
        np.testing.assert_allclose(functions.T @ functions, np.eye(functions.shape[1]), atol=1e-12)


# Windows of 8, 6 and 5 blocks of 125 samples, whose steps are 4, 3 and 5 of these.
SHARED = (
    (1000, (0, 500, 1000, 1500, 2000)), (750, (0, 375, 750, 1125, 1500, 2250)), (625, (0, 1250)),
)  # fmt: skip


@pytest.mark.parametrize("samples", [3000, 3001, 3119])
@pytest.mark.parametrize("detrend", ["none", "constant", "linear"])
def test_windows_of_shared_blocks_equal_those_term_by_term_behind_each_derivative(samples, detrend):
    x = np.random.default_rng(1).standard_normal((samples, 3)) + 3.0
    angle, tapers = (
        np.geomspace(0.004, 0.3, 9),
        (Taper("hann", 3), Taper("hann'", 3, 1), Taper("hann''", 2)),
    )
    made = fourier_sums((x[:, :1], x[:, 1:]), angle, SHARED, tapers, detrend=detrend, origin=7.0)
    for taper, found in zip(tapers, made, strict=True):
        for (length, starts), sums in zip(SHARED[taper.first :], found, strict=True):
            part = x[:, : taper.channels]
            expected = direct_sums(part, angle, length, starts, taper.shape, detrend, 7.0)
            assert_sums(sums, expected, 1e-12)


ESTIMATORS = [
    Composite(windows=(9.0, 5.0, 3.3), overlap=0.5, detrend="linear"),
    Composite(windows=(9.0, 5.0, 3.3), integrators=2, delay=0.11),
    Welch(4.9, overlap=0.37, shape="hamming"),
]


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_sums_of_several_records_equal_those_term_by_term(estimator):
    rng, rate = np.random.default_rng(2), 100.0
    shapes = [(size, count) for size in (2000, 1763) for count in (1, 2)]
    u, y, v, z = (np.cumsum(rng.standard_normal(shape), axis=0) for shape in shapes)
    records = [Record(np.arange(len(a)) / rate, a, b) for a, b in ((u, y), (v, z))]
    omega = np.geomspace(2.0, 40.0, 11)
    composite = isinstance(estimator, Composite)
    members = estimator.windowed(records, omega) if composite else (estimator,)
    segments = transform_records(records, omega, members, derivatives=2)
    n, late, origin = estimator.integrators, round(estimator.delay * rate), 0
    factor = np.exp(-1j * omega / rate * (late + n // 2)) / (1 - np.exp(-1j * omega / rate)) ** n
    done = [0] * len(segments.groups)
    for record in records:
        inputs = record.inputs[n - n // 2 : record.samples - n // 2]
        outputs = np.diff(record.outputs, n, axis=0)
        outputs = np.vstack([outputs[late:], np.repeat(outputs[-1:], late, axis=0)])
        columns = np.hstack([inputs, outputs])
        longest = segments.groups[0][0]
        for k, (length, starts) in enumerate(segments.groups):
            local = [s - origin for s in starts if 0 <= s - origin <= len(columns) - length]
            mine = slice(done[k], done[k] + len(local))
            done[k] += len(local)
            for order, sums in enumerate((segments.transforms[k], *segments.slopes[k])):
                shape = estimator.shape + "'" * order
                part = columns[:, : (3, 3, 1)[order]]
                given = (part, omega / rate, length, local, shape, estimator.detrend, origin)
                expected = direct_sums(*given)
                if order == 0:
                    expected[:, :, 1:] *= factor[:, None, None]
                if sums.size:
                    for channel in range(part.shape[1]):
                        # Phases of 1500 rad, and a random walk far from 0.
                        assert_sums(sums[:, mine, channel], expected[:, :, channel], 1e-11)
        origin += record.samples + longest
    assert done == [len(starts) for _, starts in segments.groups]
