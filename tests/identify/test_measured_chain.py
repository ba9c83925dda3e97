"""A gyro's filters by the ratio of its filtered to its unfiltered rate, which are logged slower."""

import numpy as np
import pytest
from scipy.signal import lfilter

from jaxquad.autopilot import betaflight_loop, FilterChain, Notch, PT1
from jaxquad.identify import KnownFilter, measured_chain
from jaxquad.records import read, read_settings


GYRO_HZ, EVERY = 8000.0, 8
DT = EVERY / GYRO_HZ
LOW_PASS = FilterChain((PT1(250.0), PT1(500.0)), GYRO_HZ)
NOTCHES = FilterChain(tuple(Notch(f, 3.0) for f in (150.0, 180.0, 300.0)), GYRO_HZ)
AT = np.array([2.0, 5.0, 10.0, 20.0, 40.0])


def passed(chain, values):
    for section in chain.sections():
        b0, b1, a1, b2, a2 = (0.0 if x is None else float(x) for x in section)
        values = np.asarray(lfilter([b0, b1, b2], [1.0, a1, a2], values))
    return values


def flown(*chains, noise=1.0, seconds=30.0, seed=0):
    """Motion of a loop in deg/s, white noise of the gyro, rounded, at an eighth of its rate.

    Returns the unfiltered and the filtered rate, and what moved the vehicle.
    """
    random, samples = np.random.default_rng(seed), int(seconds * GYRO_HZ)
    stick = np.repeat(100 * random.standard_normal(samples // 2000), 2000)
    stay = np.exp(-1 / (0.01 * GYRO_HZ))
    stick = np.asarray(lfilter([1 - stay], [1.0, -stay], stick))
    rate = np.asarray(lfilter([1 - stay], [1.0, -stay], stick))
    gyro = rate + noise * random.standard_normal(samples)
    filtered = gyro
    for chain in chains:
        filtered = passed(chain, filtered)
    return np.round(gyro[::EVERY]), np.round(filtered[::EVERY]), stick[::EVERY]


@pytest.mark.parametrize("instrument", [True, False], ids=["reference", "alone"])
@pytest.mark.parametrize("known", [(LOW_PASS,), ()], ids=["known", "unknown"])
def test_notches_that_no_parameter_holds_are_in_the_measured_chain(instrument, known):
    unfiltered, filtered, stick = flown(LOW_PASS, NOTCHES)
    found = measured_chain(
        unfiltered, filtered, DT, filters=known, reference=stick if instrument else None
    )
    assert isinstance(found, KnownFilter) and found.misfit < 1.6
    truth = np.asarray(LOW_PASS.response(AT)) * np.asarray(NOTCHES.response(AT))
    away = np.abs(found.response(AT) / truth - 1)
    assert np.all(away < 3 * found.error(AT) + 0.3 * (AT / 150.0) ** 2)  # to second order
    late = np.asarray(LOW_PASS.delay_ms(AT)) + np.asarray(NOTCHES.delay_ms(AT))
    assert np.allclose(found.delay_ms(AT), late, atol=0.1)
    assert np.all(late > np.asarray(LOW_PASS.delay_ms(AT)) + 0.8)  # what would be missed


def test_where_the_parameters_hold_all_of_it_nothing_is_added():
    unfiltered, filtered, stick = flown(LOW_PASS)
    found = measured_chain(unfiltered, filtered, DT, filters=(LOW_PASS,), reference=stick)
    assert np.all(np.abs(found.delay_ms(AT) - np.asarray(LOW_PASS.delay_ms(AT))) < 0.03)
    assert "by the parameters" in str(found) and "ms at 10 Hz" in str(found)


def test_the_standard_error_is_that_of_many_flights():
    found = []
    for seed in range(12):
        unfiltered, filtered, stick = flown(LOW_PASS, seed=seed, noise=3.0)
        found.append(measured_chain(unfiltered, filtered, DT, filters=(LOW_PASS,), reference=stick))
    away = [np.angle(each.response(AT) / np.asarray(LOW_PASS.response(AT)))[2] for each in found]
    errors = [each.error(AT)[2] for each in found]
    assert 0.5 < np.sqrt(np.mean(np.square(away))) / np.mean(errors) < 1.8


def test_a_chain_without_noise_is_exact_and_goes_on_beyond_the_band():
    random = np.random.default_rng(0)
    unfiltered = lfilter([0.1], [1.0, -0.9], random.standard_normal(20000))
    unfiltered = np.asarray(
        lfilter([0.1], [1.0, -0.9], unfiltered)
    )  # white noise would pass for folded noise
    plain = FilterChain((PT1(40.0),), 1 / DT)
    found = measured_chain(unfiltered, passed(plain, unfiltered), DT, filters=(plain,))
    far = np.array([1.0, 100.0, 450.0])
    away = np.abs(found.response(far) / np.asarray(plain.response(far)) - 1)
    assert np.all(away < 3 * found.error(far)) and found.error(far)[0] < 1e-3


def test_signals_that_show_no_ratio_are_refused(without_type_checks):
    unfiltered, filtered, stick = flown(LOW_PASS, seconds=6.0)
    with pytest.raises(ValueError, match="clear at 0 frequencies"):
        measured_chain(unfiltered, filtered, DT, reference=0 * stick)
    with pytest.raises(ValueError, match="4000 .4 s. or more"):
        measured_chain(unfiltered[:100], filtered[:100], DT)
    with pytest.raises(ValueError, match="as many of each"):
        measured_chain(unfiltered, filtered[:-1], DT)


@pytest.mark.parametrize(
    ("name", "axis"),
    [("A_chirp_roll", 0), ("A_sticks", 1), ("A_throttle", 0), ("B_chirp_three_axes", 0)],
)
def test_betaflights_own_chain_is_that_of_its_header_and_half_a_period(data, name, axis):
    """The loop holds their output for 1/4000 s: .125 ms in the mean."""
    path = data / "betaflight_firmware" / f"{name}.BFL"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    settings = read_settings(path)
    law = betaflight_loop(settings.values, settings.version).law
    known = (law.gyro, FilterChain(law.filters, 1 / law.dt))
    names = (f"gyroUnfilt[{axis}]", f"gyroADC[{axis}]")
    record = read(path, inputs=f"setpoint[{axis}]", outputs=list(names), start=8.5)
    unfiltered, filtered = (record.channel(each) for each in names)
    found = measured_chain(
        unfiltered, filtered, record.dt, filters=known, reference=record.inputs[:, 0], names=names
    )
    by_header = sum(float(each.delay_ms([10.0])[0]) for each in known)
    error = 1e3 * float(found.error(np.array([10.0]))[0]) / (2 * np.pi * 10)
    late = float(found.delay_ms(np.array([10.0]))[0])
    assert found.misfit < 2 and error < 0.06
    assert late == pytest.approx(by_header + 0.125, abs=3 * error + 0.03)
    assert str(found).startswith(f"measured: gyroADC[{axis}] over gyroUnfilt[{axis}], 0.")
