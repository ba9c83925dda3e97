"""Angles that jump by a turn go on instead; nothing else that jumps does."""

import re
import warnings

import numpy as np
import pytest

from jaxquad.records import read, RecordWarning


TIME = np.arange(4000) / 200
TURNING = 3 * TIME + 0.4 * np.sin(2 * TIME)  # rad, nine and a half turns
NOISE = 0.002 * np.random.default_rng(3).standard_normal(TIME.size)


def wrapped(angle, period, low):
    return np.mod(angle - low, period) + low


def read_angle(folder, values, unit=""):
    """What a record of it holds, how often it jumped, and by how much."""
    path, head = folder / "log.csv", f"t,u,psi [{unit}]" if unit else "t,u,psi"
    table = np.stack([TIME, np.cos(TIME), values], axis=1)
    np.savetxt(path, table, "%.17g", ",", header=head, comments="")
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        record = read(path, inputs="u", outputs="psi")
    jumps = [re.findall(r"jumps by (360|2 pi) (\d+) times", str(each.message)) for each in said]
    turn, count = next((found[0] for found in jumps if found), ("", 0))
    return record.outputs[:, 0], int(count), turn


@pytest.mark.parametrize(("period", "scale"), [(360.0, 180 / np.pi), (2 * np.pi, 1.0)])
@pytest.mark.parametrize("begin", [-0.5, 0.0])
@pytest.mark.parametrize("direction", [1, -1])
def test_an_angle_that_was_wrapped_is_that_which_was_not(tmp_path, period, scale, begin, direction):
    angle = direction * scale * (TURNING + NOISE)
    values, jumps, turn = read_angle(tmp_path, wrapped(angle, period, begin * period))
    assert turn == ("360" if period == 360 else "2 pi") and jumps >= 9
    np.testing.assert_allclose(np.diff(values), np.diff(angle), atol=1e-9)


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        (180 * np.sign(np.sin(3 * TIME)), ""),  # doublets of 180 deg/s
        (180 * np.sign(np.sin(3 * TIME)) * (TIME > 5), "deg"),
        (wrapped(TURNING, 2 * np.pi, 0), "rad/s"),
        (wrapped(TURNING, 2 * np.pi, 0), "V"),
        (wrapped(TURNING, 2 * np.pi, 0), "deg"),
        (wrapped(90 * TURNING, 360, -180) + 500, "deg"),
        (170 * np.sin(TIME), "deg"),
        (wrapped(2000 * TURNING, 360, -180), "deg"),  # too quick to tell
    ],
)
def test_what_is_no_wrapped_angle_stays_as_it_is(tmp_path, values, unit):
    same, jumps, _ = read_angle(tmp_path, values, unit)
    assert jumps == 0
    np.testing.assert_array_equal(same, values)


def test_a_log_with_a_wrapped_angle_is_read_as_one_that_goes_on(tmp_path):
    psi = 180 / np.pi * TURNING
    np.savez(tmp_path / "log.npz", t=TIME, u=np.cos(TIME), psi=wrapped(psi, 360, -180))
    with pytest.warns(RecordWarning, match="'psi' jumps by 360 10 times, as an angle does"):
        record = read(tmp_path / "log.npz", inputs="u", outputs="psi")
    np.testing.assert_allclose(record.outputs[:, 0] - psi, 0, atol=1e-9)
