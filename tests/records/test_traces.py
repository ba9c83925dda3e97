"""Channels as a log has them, and the points of them that a screen shows."""

import numpy as np
import pytest

from jaxquad.records import Channel, envelope, ReadError, traces


def test_an_envelope_keeps_every_extreme_and_the_order_in_time():
    random = np.random.default_rng(0)
    time = np.cumsum(random.uniform(0.5e-3, 1.5e-3, 100_003))
    values = random.standard_normal(time.size)
    values[[7, 51_234, 100_002]] = 40.0, -50.0, 60.0
    t, x = envelope(Channel("q", time, values), time[0], time[-1], 2000)
    assert t.size <= 2000 and (np.diff(t) >= 0).all()
    assert set(zip(t, x, strict=True)) <= set(zip(time, values, strict=True))
    size = -(-time.size // 1000)
    for first in range(0, time.size, size):  # lowest and highest of each part
        part = values[first : first + size]
        inside = (t >= time[first]) & (t <= time[min(first + size, time.size) - 1])
        assert x[inside].min() == part.min() and x[inside].max() == part.max()


def test_a_part_with_few_samples_is_shown_as_it_is_with_one_beyond_each_end():
    time = np.arange(1000) / 100
    channel = Channel("q", time, np.sin(time))
    t, x = envelope(channel, 2.005, 3.004, 500)
    np.testing.assert_array_equal(t, time[200:302])
    np.testing.assert_array_equal(x, np.sin(t))


def test_missing_values_are_gaps_and_hide_no_extreme():
    time = np.arange(10_000) / 100
    values = np.where((time > 20) & (time < 60), np.nan, np.sin(time))
    values[9000] = 9.0
    t, x = envelope(Channel("q", time, values), 0.0, 100.0, 200)
    assert np.nanmax(x) == 9.0
    gap = (t > 21) & (t < 59)
    assert gap.any() and np.isnan(x[gap]).all()


def test_traces_have_their_own_stamps_and_leave_out_what_is_not_there(tmp_path):
    path = tmp_path / "log.npz"
    fast, slow = np.arange(2000) / 1000, np.arange(0, 2, 0.02) + 0.003
    np.savez(path, u=np.sin(fast), t_u=fast, q=np.cos(slow), t_q=slow, lonely=np.arange(50.0))
    u, q = traces(path, ["u", "lonely", "q", "absent"])
    assert (u.name, q.name) == ("u", "q")
    np.testing.assert_array_equal(u.time, fast)
    np.testing.assert_array_equal(q.time, slow)
    with pytest.raises(ReadError, match="absent.csv"):
        traces(tmp_path / "absent.csv", ["u"])
