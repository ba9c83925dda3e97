"""Remarks on responses: about which frequencies and pairs they are."""

import dataclasses
import pickle

import numpy as np
from synthetic import response_of

import jaxquad as jq
from jaxquad.spectra import Remark


OMEGA = np.array([1.0, 2.0, 3.0, 4.0])
PLANT = jq.StateSpace(F=[[-1.0]], G=[[1.0]], H0=[[1.0], [2.0]])
RESPONSE = dataclasses.replace(
    response_of(PLANT, omega=OMEGA), output_names=("q", "r"), input_names=("elevator",)
)


def used(*places):
    """Points in use, as (frequency, output)."""
    mask = np.zeros((4, 2, 1), bool)
    for f, o in places:
        mask[f, o, 0] = True
    return mask


def remarks_about(remarks, mask):
    return dataclasses.replace(RESPONSE, remarks=tuple(remarks)).remarks_about(mask)


def test_a_remark_is_restricted_to_the_frequencies_in_use():
    remark = Remark("the estimate {where} is wrong. Record longer", OMEGA[1:])
    assert (
        remark
        == "the estimate at 3 frequencies, 2 to 4 rad/s (0.318 to 0.637 Hz) is wrong. Record longer"
    )
    (kept,) = remarks_about([remark], used((0, 0), (3, 0)))
    assert kept.omega == (4.0,) and "4 rad/s" in kept
    assert remarks_about([remark], used((0, 0))) == ()


def test_a_remark_on_a_pair_concerns_its_points_only():
    remark = Remark("{where}", OMEGA, ("r", "elevator"))
    assert remarks_about([remark], used((2, 0))) == ()
    assert remarks_about([remark, remark], used((2, 1)))[0].omega == (3.0,)


def test_a_remark_on_the_whole_response_is_kept_once_and_survives_a_pickle():
    remark = Remark("too short. Record longer")
    assert remarks_about([remark, remark], used((0, 0))) == (remark,)
    part = pickle.loads(pickle.dumps(Remark("{where}", OMEGA)))
    assert part.omega == tuple(OMEGA) and part.within(OMEGA[:1]).omega == (1.0,)
