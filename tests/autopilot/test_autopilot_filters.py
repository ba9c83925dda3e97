"""The filters of the firmwares against scipy.signal, and chains of them."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxquad.autopilot import (
    ardupilot_harmonic_notch,
    ardupilot_notch,
    BandwidthNotch,
    betaflight_quality,
    Butterworth,
    FilterChain,
    HarmonicNotch,
    Notch,
    PT1,
    PT2,
    PT3,
)


RATE = 4000.0
CUTOFF = 93.0
NOISE = np.random.default_rng(1).standard_normal(200)


def prewarped(centre, quality, residual=0.0):
    """scipy's bilinear transform of the analogue notch that is right at its centre."""
    w = 2 * RATE * np.tan(np.pi * centre / RATE)
    below = [1, w / quality, w**2]
    return signal.bilinear([1, residual * w / quality, w**2], below, RATE)


def first_order(cutoff):
    analogue = [1.0], [1 / (2 * np.pi * cutoff), 1.0]
    found: Any = signal.cont2discrete(analogue, 1 / RATE, method="backward_diff")
    numerator, denominator, _ = found
    return np.ravel(numerator), np.ravel(denominator)


def repeated(pair, times):
    return [np.poly1d(x) ** times for x in map(np.poly1d, pair)]


OCTAVES = 2 * np.log2(180 / (180 - 20))
DEPTH = ardupilot_notch(180.0, 40.0, 30.0)
CASES: dict[str, Any] = {
    "pt1": (PT1(CUTOFF), first_order(CUTOFF)),
    "pt2": (PT2(CUTOFF), repeated(first_order(CUTOFF / np.sqrt(np.sqrt(2) - 1)), 2)),
    "pt3": (PT3(CUTOFF), repeated(first_order(CUTOFF / np.sqrt(np.cbrt(2) - 1)), 3)),
    "Butterworth": (Butterworth(CUTOFF), signal.butter(2, CUTOFF, fs=RATE)),
    "notch of Betaflight": (
        Notch(300.0, betaflight_quality(300.0, 200.0)),
        prewarped(300.0, 300 * 200 / (300**2 - 200**2)),
    ),
    "notch of PX4": (BandwidthNotch(180.0, 20.0), signal.iirnotch(180.0, 9.0, fs=RATE)),
    "notch of ArduPilot": (
        DEPTH,
        prewarped(180.0, np.sqrt(2**OCTAVES) / (2**OCTAVES - 1), 10 ** (-30 / 20)),
    ),
}


def run(chain, samples):
    step = lambda memory, sample: chain.step(memory, sample)
    run = jax.jit(lambda: jax.lax.scan(step, chain.init(jnp.zeros(())), samples)[1])
    return np.asarray(run())


@pytest.mark.parametrize("kind", CASES)
def test_every_filter_is_scipys(kind):
    filter, (numerator, denominator) = CASES[kind]
    expected = signal.lfilter(np.asarray(numerator), np.asarray(denominator), NOISE)
    rough = 1e-8 if kind in ("pt2", "pt3") else 1e-12  # their factors have nine digits
    found = run(FilterChain((filter,), RATE), jnp.asarray(NOISE))
    np.testing.assert_allclose(found, expected, rtol=0, atol=rough)


@pytest.mark.parametrize(
    ("kind", "order", "factor"), [(PT2, 2, 1.553773974), (PT3, 3, 1.961459177)]
)
def test_pt2_and_pt3_are_chains_of_equal_first_order_filters(kind, order, factor):
    numerator, denominator = repeated(first_order(CUTOFF * factor), order)
    expected = signal.lfilter(np.asarray(numerator), np.asarray(denominator), NOISE)
    found = run(FilterChain((kind(CUTOFF),), RATE), jnp.asarray(NOISE))
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


CHAIN = FilterChain(tuple(filter for filter, _ in CASES.values()), RATE)
FREQUENCIES: Any = np.array([1.0, 40.0, 250.0, 900.0])


def test_shares_multiply_and_add_up_to_the_chain():
    *parts, whole = CHAIN.shares(FREQUENCIES)
    product = np.prod([x.response for x in parts], axis=0)
    np.testing.assert_allclose(product, whole.response, rtol=1e-12)
    np.testing.assert_allclose(sum(x.delay_ms for x in parts), whole.delay_ms, rtol=1e-12)
    freqz: Any = signal.freqz
    expected = np.prod(
        [
            freqz(np.asarray(above), np.asarray(below), worN=FREQUENCIES, fs=RATE)[1]
            for _, (above, below) in CASES.values()
        ],
        axis=0,
    )
    np.testing.assert_allclose(whole.response, expected, rtol=1e-7)  # digits of pt2 and pt3


def test_the_delay_of_slow_signals_is_the_group_delay():
    slow: Any = np.array([0.01])
    expected = signal.group_delay(CASES["Butterworth"][1], w=slow, fs=RATE)[1] / RATE * 1e3
    found = FilterChain((Butterworth(CUTOFF),), RATE).delay_ms([0.01])
    assert found[0] == pytest.approx(expected[0], rel=1e-6)


@pytest.mark.parametrize(("cutoff", "delay"), [(40.0, 5.7), (20.0, 11.9)])
def test_the_default_gyro_filters_of_px4_and_ardupilot_delay_by_6_and_12_ms(cutoff, delay):
    around = np.array([4.99, 5.01])  # Hz: the group delay is the slope of the phase in turns
    turns = around * FilterChain((Butterworth(cutoff),), 1000.0).delay_ms(around)
    assert round(float(turns[1] - turns[0]) / 0.02, 1) == delay


def test_a_cutoff_of_zero_lets_everything_pass():
    np.testing.assert_array_equal(run(FilterChain((PT1(0.0),), RATE), jnp.asarray(NOISE)), NOISE)


@pytest.mark.slow
def test_the_response_is_differentiable_by_cutoff_and_quality():
    def gain(x):
        chain = FilterChain((Butterworth(x[0]), Notch(x[1], x[2]), PT3(x[0]), PT1(x[1])), RATE)
        return jnp.abs(chain.response(np.array([150.0])))[0] + chain.delay_ms([30.0])[0]

    at = np.array([120.0, 200.0, 3.0])
    gain = jax.jit(gain)
    slopes = jax.jacfwd(gain)(jnp.asarray(at))
    steps = 1e-5 * at
    differences = [
        (gain(jnp.asarray(at + h)) - gain(jnp.asarray(at - h))) / (2 * h.sum())
        for h in np.diag(steps)
    ]
    np.testing.assert_allclose(slopes, differences, rtol=1e-6)


def test_a_filter_beyond_half_the_rate_is_refused():
    with pytest.raises(ValueError, match="below 200 Hz"):
        FilterChain((Butterworth(250.0),), 400.0)


def firmware_quality(centre, bandwidth):
    octaves = 2 * np.log2(centre / (centre - bandwidth / 2))
    return np.sqrt(2**octaves) / (2**octaves - 1)


def run_ardupilots_bank(samples, frequency, bandwidth, attenuation, harmonics, count, rate):
    """The bank of INS_HNTCH_* at `frequency`, sample by sample: a second writing of its law."""
    a = 10 ** (-attenuation / 40)
    quality = firmware_quality(frequency, bandwidth / count)
    apart = bandwidth / (32 * frequency)
    places = {1: [0], 2: [-1, 1], 3: [-1, 0, 1], 5: [-2, -1, 0, 1, 2]}[count]
    for harmonic in harmonics:
        if harmonic * frequency >= 0.48 * rate:
            continue
        for place in places:
            w = 2 * np.pi * harmonic * frequency * (1 + place * apart) / rate
            wide = np.sin(w) / (2 * quality)
            u1 = u2 = y1 = y2 = 0.0
            passed = []
            for u in samples:
                y = (1 + wide * a**2) * u - 2 * np.cos(w) * (u1 - y1) + (1 - wide * a**2) * u2
                y = (y - (1 - wide) * y2) / (1 + wide)
                u1, u2, y1, y2 = u, u1, y, y1
                passed.append(y)
            samples = passed
    return np.array(samples)


@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_a_harmonic_notch_is_ardupilots_bank_and_leaves_out_what_is_near_half_the_rate(count):
    harmonics = (1, 2, 5)  # 5 x 397 Hz is beyond 0.48 of the rate
    notch = ardupilot_harmonic_notch(397.0, 160.0, 35.0, harmonics=harmonics, notches=count)
    found = run(FilterChain((notch,), RATE), jnp.asarray(NOISE))
    expected = run_ardupilots_bank(NOISE, 397.0, 160.0, 35.0, harmonics, count, RATE)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    quality, apart = firmware_quality(397.0, 160.0 / count), 160.0 / 32
    residual = 10 ** (-35 / 20)
    places = {1: [0], 2: [-1, 1], 3: [-1, 0, 1], 5: [-2, -1, 0, 1, 2]}[count]
    rows = [
        np.hstack(list(map(np.asarray, prewarped(k * (397.0 + place * apart), quality, residual))))
        for k in (1, 2)
        for place in places
    ]
    expected = signal.sosfilt(np.array(rows), NOISE)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)


def test_a_harmonic_notch_keeps_its_quality_where_its_centre_moves_and_names_its_harmonics():
    notch = ardupilot_harmonic_notch(80.0, 40.0, 40.0)
    moved = HarmonicNotch(100.0, notch.quality, notch.residual)
    names = [x.in_words() for x in (notch, moved)]
    assert names == ["harmonic notch 80, 160 Hz, Q 1.71", "harmonic notch 100, 200 Hz, Q 1.71"]
    deep = np.abs(FilterChain((moved,), RATE).response([100.0, 200.0]))
    alone = np.abs(FilterChain((Notch(200.0, 1.7142857, 0.01),), RATE).response([100.0]))
    assert deep[0] == pytest.approx(0.01 * float(alone[0]), rel=1e-6)
    with pytest.raises(ValueError, match="multiples"):
        HarmonicNotch(100.0, 2.0, harmonics=(0, 1))
