"""Remarks on responses: about which frequencies and pairs they are."""

import pickle

import numpy as np

from jaxquad.spectra import Remark
from jaxquad.spectra._remarks import Remarks, remarks_on_used


OMEGA = np.array([1.0, 2.0, 3.0, 4.0])
NAMES = ["q", "r"], ["elevator"]


def used(*places):
    """Points in use, as (frequency, output)."""
    mask = np.zeros((4, 2, 1), bool)
    for f, o in places:
        mask[f, o, 0] = True
    return mask


def test_a_remark_is_restricted_to_the_frequencies_in_use():
    remark = Remark("the estimate {where} is wrong. Record longer", OMEGA[1:])
    assert (
        remark
        == "the estimate at 3 frequencies, 2 to 4 rad/s (0.318 to 0.637 Hz) is wrong. Record longer"
    )
    (kept,) = remarks_on_used([remark], OMEGA, used((0, 0), (3, 0)), *NAMES)
    assert kept == "the estimate near 4 rad/s (0.637 Hz) is wrong. Record longer"
    assert remarks_on_used([remark], OMEGA, used((0, 0)), *NAMES) == ()


def test_a_remark_on_a_pair_concerns_its_points_only():
    remark = Remark("{where}", OMEGA, ("r", "elevator"))
    assert remarks_on_used([remark], OMEGA, used((2, 0)), *NAMES) == ()
    assert remarks_on_used([remark, remark], OMEGA, used((2, 1)), *NAMES)[0].omega == (3.0,)


def test_a_remark_on_the_whole_response_is_kept_once_and_survives_a_pickle():
    remark = Remark("too short. Record longer")
    assert remarks_on_used([remark, remark], OMEGA, used((0, 0)), *NAMES) == (remark,)
    part = pickle.loads(pickle.dumps(Remark("{where}", OMEGA)))
    assert part.omega == tuple(OMEGA) and part.within(OMEGA[:1]) == "near 1 rad/s (0.159 Hz)"


def test_remarks_are_found_once_when_they_are_looked_at():
    asked = []
    remarks = Remarks(lambda: tuple(Remark(text) for text in asked.append(0) or ("a", "b")))
    assert not asked
    assert remarks == ("a", "b") and [*remarks, remarks[0]] == ["a", "b", "a"]
    assert len(asked) == 1 and pickle.loads(pickle.dumps(remarks)) == ("a", "b")
