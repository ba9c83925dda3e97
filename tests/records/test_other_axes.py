"""Commands of other axes are named as that of one axis is."""

import pytest

from jaxquad.records import other_axes, parse_mix


@pytest.mark.parametrize(
    ("command", "names", "others"),
    [
        ("roll_cmd", "roll_cmd pitch_cmd yaw_cmd roll pitch p q", ["pitch_cmd", "yaw_cmd"]),
        ("axisSum[1]", "axisSum[0] axisSum[1] axisSum[2] axisP[0]", ["axisSum[0]", "axisSum[2]"]),
        ("log2.axisSum[0]", "log1.axisSum[0] log2.axisSum[0]", []),
        ("RATE.ROut", "RATE.ROut RATE.POut RATE.R RATE.P PIDR.P", ["RATE.POut"]),
        ("cmdPitch", "cmdRoll cmdPitch", ["cmdRoll"]),
        ("elevator", "aileron elevator rudder theta q", ["aileron", "rudder"]),
        ("M", "t M q x0", []),
        ("M", "t L M N", ["L", "N"]),
        ("d=u1-u2", "u1 u2 u3", []),
        ("roll=left.x+right.x", "left.x right.x left.y right.y left.z", ["other1"]),
        ("roll=-m1-m2+m3+m4", "m1 m2 m3 m4", ["other1", "other2"]),
    ],
)
def test_other_axes_are_found_by_their_names(command, names, others):
    mixes = other_axes(parse_mix(command), names.split())
    assert [name for mix in mixes for name in mix] == others


def test_motors_turn_other_axes_in_other_pairs():
    pitch, yaw = other_axes(parse_mix("roll=-m1-m2+m3+m4"), ["m1", "m2", "m3", "m4"])
    assert [list(weights.values()) for weights in pitch.values()] == [[1, -1, 1, -1]]
    assert [list(weights.values()) for weights in yaw.values()] == [[1, -1, -1, 1]]
