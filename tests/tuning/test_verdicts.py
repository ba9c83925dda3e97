"""Stability, performance and convergence: what is not to be flown is never green."""

import dataclasses

import jax
import numpy as np
import pytest
from certificates_by_hand import certificate, IDLE_ITAE, judged, MEMBERS

import jaxquad as jq
from jaxquad.ensembles import Ensemble, LogUniform
from jaxquad.tuning import certify, Limit, upper_bound


pytestmark = pytest.mark.usefixtures("compiled_quickly")
RIG = jq.DecoupledAxes([0.0468], [0.0552])
OPEN = Ensemble(inertia=LogUniform(0.5, 3.0), noise=np.radians(0.02))
FRESH, EVENTS = 24, (0.0, 1.0)


def flown(controller, *, limit, step=4.0, torque=0.0, **options):
    """A certificate of a flight of 2 s: a step in deg, and from 1 s on a torque in N m."""
    flight = jq.scenario(
        duration=2.0,
        axes=1,
        reference={0: jq.Step(np.radians(step))},
        disturbance={0: jq.Pulse(torque, width=1.0, at=1.0)},
    )
    loop = jq.Loop(RIG, controller, drive=jq.simulation.Saturation(limit))
    return certify(loop, OPEN, flight, members=FRESH, linear_members=0, events=EVENTS,
                   key=jax.random.key(3), **options)  # fmt: skip


@pytest.mark.slow
def test_a_drive_that_cannot_hold_the_disturbance_is_no_performance():
    """1 V gives 0.0468 N m of the 0.2 that push."""
    found = flown(jq.LADRC(4.0, 20.0, 1.0), limit=1.0, torque=0.2)
    assert found.stability.holds and found.performance.holds is False and not found.holds
    assert str(found).splitlines()[0].endswith("not to be flown: PERFORMANCE")
    assert found.design.lost.any()
    assert f"{found.design.lost.sum()} of 24 members are lost" in found.performance.text
    assert "raise the limit" in found.performance.remedy
    for text in (str(found), str(found.content()["remarks"])):
        assert "exceed the 0.0468 N m that the drive has: no controller holds" in text


@pytest.mark.slow
def test_a_controller_that_is_saturated_all_the_time_is_no_performance():
    """It moves at most 0.9 of 5 deg."""
    found = flown(jq.PID(400.0, 80.0, 40.0), limit=0.004, step=5.0)
    assert np.all(found.design.of("saturation_share") > 0.9) and not found.holds
    text = found.performance.text
    assert "24 of 24 members make more than half the error of doing nothing" in text
    assert "24 of 24 members have the command at its limit for more than a quarter" in text


@pytest.mark.slow
def test_doing_nothing_is_the_flight_of_the_plant_alone():
    """A step of 4 deg for 1 s, then the clock of ITAE starts again: 2 deg s^2 each, undisturbed."""
    found = flown(jq.LADRC(4.0, 20.0, 1.0), limit=10.0)
    np.testing.assert_allclose(np.degrees(found.idle.of("itae")), 4.0, rtol=5e-3)
    assert found.start is None and found.error == "itae"
    still = flown(jq.LADRC(4.0, 20.0, 1.0), limit=10.0, step=0.0, torque=0.02)
    push = 0.02 / 0.0552 / (still.facts["inertia"][0] / 0.0552)
    assert still.error == "rms"
    np.testing.assert_allclose(still.idle.of("rms"), push / np.sqrt(2 * 20), rtol=1e-2)


@pytest.mark.parametrize(
    "change, holds",
    [
        ({"itae": 0.499 * IDLE_ITAE}, True),
        ({"itae": 0.501 * IDLE_ITAE}, False),
        ({"saturation_share": 0.249}, True),
        ({"saturation_share": 0.251}, False),
    ],
)
def test_half_of_doing_nothing_and_a_quarter_of_the_time_are_the_bounds(change, holds):
    [(name, value)] = change.items()
    design = judged()
    numbers = design.by_axis[name].copy()
    numbers[0, 3] = np.radians(value) if name == "itae" else value
    design = dataclasses.replace(design, by_axis=design.by_axis | {name: numbers})
    found = certificate({"tuned": design})
    assert found.performance.holds is holds and found.holds is holds
    assert holds or "1 of 12 members" in found.performance.text


def test_one_lost_member_is_one_too_many():
    lost = np.arange(MEMBERS) == 5
    found = certificate({"tuned": dataclasses.replace(judged(), lost=lost)})
    assert not found.holds and "1 of 12 members are lost" in found.performance.text


@pytest.mark.slow
def test_every_limit_says_what_its_own_count_proves():
    limits = [Limit("sensitivity_peak", at_most=2.2), Limit("activity_rate", at_most=1e6)]
    found = flown(jq.LADRC(4.0, 20.0, 1.0), limit=10.0, limits=limits)
    beyond = int(np.sum(found.design.of("sensitivity_peak") > 2.2))
    assert 0 < beyond < FRESH
    for distance, count in zip(found.distances, (beyond, 0), strict=True):
        bound = upper_bound(count, FRESH)
        assert distance.beyond == count and distance.beyond_at_most == bound
        proven = f"{count} of 24 members beyond (proven: at most {100 * bound:.2g} % of all"
        assert proven in str(distance)
    assert f"{FRESH - beyond} of 24 members are stable and within" in found.stability.text
