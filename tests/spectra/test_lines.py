"""Lines of motors in a spectrum, told from resonances and from noise."""

import numpy as np
import pytest

import jaxquad as jq
from jaxquad.spectra import find_line


DT, SAMPLES = 0.002, 20000
TIME = DT * np.arange(SAMPLES)
THROTTLE = 0.5 + 0.2 * np.sin(2 * np.pi * TIME / 20)


def record_with(frequency, *, harmonics=(1.0,), noise=1.0):
    """White noise with a line at `frequency` in Hz, one value for each sample."""
    phase = 2 * np.pi * DT * np.cumsum(np.broadcast_to(frequency, TIME.shape))
    line = sum(size * np.sin((k + 1) * phase) for k, size in enumerate(harmonics))
    values = line + noise * np.random.default_rng(0).standard_normal(SAMPLES)
    return jq.Record(TIME, THROTTLE, values, input_names="throttle", output_names="gyro")


def test_a_motor_is_found_with_its_harmonics_and_follows_the_throttle():
    record = record_with(40 + 80 * THROTTLE, harmonics=(1.0, 0.5))
    line = find_line(record, "gyro", above=2 * np.pi * 20, over="throttle")
    assert line is not None
    assert line.omega == pytest.approx(2 * np.pi * 80, rel=0.05)
    assert line.low == pytest.approx(2 * np.pi * 64, rel=0.05)
    assert line.high == pytest.approx(2 * np.pi * 96, rel=0.05)
    assert line.follows > 0.9 and line.harmonics == (2,) and line.share > 0.9


def test_a_resonance_stays_where_it_is():
    line = find_line(record_with(120.0), "gyro", over="throttle")
    assert line is not None
    assert line.omega == pytest.approx(2 * np.pi * 120, rel=0.02)
    assert abs(line.follows) < 0.3 and line.harmonics == ()


def test_noise_alone_and_what_lies_below_are_no_line():
    assert find_line(record_with(120.0, harmonics=(0.0,)), "gyro") is None
    assert find_line(record_with(60.0), "gyro", above=2 * np.pi * 100) is None
