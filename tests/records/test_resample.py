import numpy as np
import pytest

from jaxquad.records import Channel, RecordError, RecordWarning, resample


def tone(omega, *, rate, offset=0.0, duration=8.0, name="x"):
    """A cosine logged at `rate`, on stamps that begin `offset` late."""
    time = offset + np.arange(int(duration * rate)) / rate
    return Channel(name, time, np.cos(omega * time))


def without(channel, keep):
    return Channel(channel.name, channel.time[keep], channel.values[keep])


def phasor(time, values, omega):
    """Complex amplitude of a tone by least squares, so that its phase is that of cos(omega t)."""
    basis = np.stack([np.cos(omega * time), -np.sin(omega * time)], axis=1)
    real, imaginary = np.linalg.lstsq(basis, values)[0]
    return complex(real, imaginary)


@pytest.mark.parametrize("native", [250.0, 251.3, 400.0, 1000.0])
@pytest.mark.parametrize("fraction", [0.01, 0.05, 0.125, 0.25])
def test_tones_keep_amplitude_and_phase_on_every_time_base(native, fraction):
    omega = 2 * np.pi * fraction * 250.0
    channels = [tone(omega, rate=native, offset=k * 0.31 / native, name=f"x{k}") for k in range(4)]
    time, values = resample(channels, 250.0, start=0.5, stop=7.5)
    for column in values.T:
        assert abs(phasor(time, column, omega) - 1) < 1e-3
        assert np.abs(column - np.cos(omega * time)).max() < 1e-3


def test_channels_of_different_rates_keep_their_relative_phase():
    omega = 2 * np.pi * 12.0
    channels = [
        tone(omega, rate=1009.8, name="fast"),
        tone(omega, rate=100.3, offset=0.004, name="slow"),
    ]
    time, values = resample(channels, 100.0)
    fast, slow = (phasor(time, column, omega) for column in values.T)
    assert abs(np.angle(fast / slow)) < 1e-4
    assert abs(abs(fast / slow) - 1) < 1e-4


@pytest.mark.parametrize("frequency", [63.0, 70.0, 125.0, 180.0, 240.0, 400.0])
def test_tones_above_half_the_new_rate_are_down_by_60_db(frequency):
    time, values = resample([tone(2 * np.pi * frequency, rate=1000.0)], 125.0, start=0.5, stop=7.5)
    assert np.abs(values).max() < 1e-3


def test_a_straight_line_passes_the_filter_up_to_both_edges():
    time = 3.0 + np.arange(4000) / 1000.0
    grid, values = resample([Channel("x", time, 2 - 0.7 * time)], 100.0)
    assert grid[0] == 3.0 and grid[-1] > 6.98
    np.testing.assert_allclose(values[:, 0], 2 - 0.7 * grid, atol=1e-12)


def test_a_slow_signal_has_no_transient_at_the_edges():
    omega = 2 * np.pi * 0.5
    time, values = resample([tone(omega, rate=1000.0)], 100.0)
    assert np.abs(values[:, 0] - np.cos(omega * time)).max() < 1e-2


def test_samples_that_lie_on_the_grid_come_back():
    channel = tone(3.0, rate=100.0)
    time, values = resample([channel], 100.0)
    np.testing.assert_allclose(time, channel.time, rtol=0, atol=1e-12)
    np.testing.assert_allclose(values[:, 0], channel.values, rtol=0, atol=1e-12)


def test_jitter_of_a_tenth_of_a_sample_costs_little():
    jitter = 0.1 * np.sin(np.arange(2000.0) ** 2)  # of a sample, well spread and fixed
    time = (np.arange(2000) + jitter) / 250.0
    omega = 2 * np.pi * 25.0
    grid, values = resample([Channel("x", time, np.cos(omega * time))], 250.0, start=0.5, stop=7.5)
    assert np.abs(values[:, 0] - np.cos(omega * grid)).max() < 1e-4


def scattered(rate, jitter, seed=0):
    """Stamps of a clock, uniformly off by up to `jitter` s."""
    off = np.random.default_rng(seed).uniform(-jitter, jitter, 5000)
    time = np.arange(5000) / rate + off
    return Channel("x", time, np.cos(2 * np.pi * 3.0 * time))


@pytest.mark.parametrize("jitter", [0.2e-3, 1e-3, 1.9e-3])
def test_stamps_that_scatter_have_the_rate_of_their_clock(jitter):
    channel = scattered(250.0, jitter)
    # The ends of 5000 samples are off by the jitter at most: 2e-4 of the rate.
    assert channel.rate == pytest.approx(250.0, rel=2e-4)
    holed = without(channel, np.r_[0:700, 740:5000])
    assert holed.rate == pytest.approx(250.0, rel=1e-3)


def test_stamps_that_scatter_by_half_a_sample_are_spoken_of_and_are_no_gaps():
    with pytest.warns(RecordWarning, match=r"off a clock of 250 Hz.*0\.004 s \(dt=\)") as caught:
        time, values = resample([scattered(250.0, 1.9e-3)], 250.0)
    assert len(caught) == 1
    np.testing.assert_allclose(values[:, 0], np.cos(2 * np.pi * 3.0 * time), atol=1e-6)


def test_the_grid_is_the_overlap_of_all_channels():
    late, short = tone(1.0, rate=100.0, offset=1.0), tone(1.0, rate=50.0, duration=6.0, name="y")
    time, values = resample([late, short], 50.0)
    assert time[0] == 1.0 and time[-1] == pytest.approx(5.98, abs=1e-9)
    assert values.shape == (250, 2)


def test_a_short_gap_is_bridged_and_told():
    whole = tone(2 * np.pi, rate=200.0)
    holed = without(whole, np.r_[0:400, 404:900, 901:1600])
    with pytest.warns(RecordWarning, match=r"'x' 2, longest 25 ms at t = 1\.995 s"):
        time, values = resample([holed], 200.0)
    np.testing.assert_allclose(values[:, 0], np.cos(2 * np.pi * time), atol=1e-4)


def test_one_warning_lists_all_channels_with_gaps():
    holed = [without(tone(1.0, rate=200.0, name=name), np.r_[0:400, 404:1600]) for name in "xy"]
    with pytest.warns(RecordWarning, match="'x' 1, .*'y' 1, ") as caught:
        resample(holed, 200.0)
    assert len(caught) == 1


def test_a_long_gap_is_refused_where_it_matters_only():
    holed = without(tone(1.0, rate=200.0), np.r_[0:400, 440:1600])
    with pytest.raises(RecordError, match=r"'x' has a gap of 205 ms from t = 1\.995 s to 2\.2 s"):
        resample([holed], 200.0)
    time, values = resample([holed], 200.0, start=2.2)
    np.testing.assert_allclose(values[:, 0], np.cos(time), atol=1e-9)
    with pytest.warns(RecordWarning, match="longest 205 ms"):
        resample([holed], 200.0, max_gap=0.3)


def test_a_bridge_over_noise_stays_within_it():
    noise = np.random.default_rng(0).standard_normal(2000)
    channel = Channel("x", np.arange(2000) / 200.0, noise)
    holed = without(channel, np.r_[0:1000, 1009:2000])
    with pytest.warns(RecordWarning, match="gaps filled"):
        _, values = resample([holed], 200.0)
    assert np.abs(values).max() < 2 * np.abs(noise).max()


def test_nan_is_refused_where_it_matters_only():
    channel = tone(1.0, rate=200.0)
    values = channel.values.copy()
    values[600] = np.nan
    spoilt = Channel("x", channel.time, values)
    with pytest.raises(RecordError, match="'x' is nan at sample 600, t = 3 s"):
        resample([spoilt], 100.0)
    time, values = resample([spoilt], 100.0, start=3.5)
    assert np.abs(values[:, 0] - np.cos(time)).max() < 1e-3


def test_more_samples_than_the_channel_has_are_doubted():
    with pytest.warns(RecordWarning, match="to 300 Hz, faster than 'x' 100 Hz"):
        resample([tone(1.0, rate=100.0)], 300.0)


@pytest.mark.parametrize(
    ("stamp", "said"),
    [
        (0.49, "channel 'x': time repeats at sample 50, from 0.49 s to 0.49 s"),
        (0.1, "channel 'x': time goes back at sample 50, from 0.49 s to 0.1 s"),
        (np.inf, "channel 'x': time stamp 50 is inf"),
    ],
)
def test_stamps_out_of_order_are_refused(stamp, said):
    time = np.arange(200) / 100.0
    time[50] = stamp
    with pytest.raises(RecordError, match=said):
        Channel("x", time, np.zeros(200))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (dict(sample_rate=-5.0), "sample rate is -5.0 Hz"),
        (dict(sample_rate=np.nan), "sample rate is nan Hz"),
        (dict(sample_rate=1.0), "makes 8.99 samples; 16"),
        (dict(sample_rate=1e9), "makes 7.99e.09 samples"),
        (dict(sample_rate=50.0, start=-1.0), "-1 .. 7.99 s is out of range.*from 0 s .'x' begins"),
        (dict(sample_rate=50.0, stop=9.0), "0 .. 9 s is out of range.* to 7.99 s .'x' ends"),
        (dict(sample_rate=50.0, start=5.0, stop=4.0), "start 5 s is not before stop 4 s"),
    ],
)
def test_resample_refuses(options, said):
    with pytest.raises(RecordError, match=said):
        resample([tone(1.0, rate=100.0)], **options)


def test_channels_without_common_time_are_refused():
    early, late = tone(1.0, rate=100.0, duration=2.0), tone(1.0, rate=100.0, offset=5.0, name="y")
    with pytest.raises(RecordError, match="no common time: .*5 s .'y' begins.* 1.99 s .'x' ends"):
        resample([early, late], 50.0)


def test_no_channel_is_refused():
    with pytest.raises(RecordError, match="give at least one"):
        resample([], 50.0)
