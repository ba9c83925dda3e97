"""Scheduled controllers: what they are told makes them the plain one of that inertia."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import (
    AdaptiveLADRC,
    certainty_equivalence,
    FuzzyMap,
    InertiaMap,
    LADRC,
    PID,
    RecursiveInertia,
    schedule_for_analysis,
    schedule_for_flight,
    ScheduledLADRC,
    ScheduledPID,
)


TORQUE, NOMINAL = np.array([0.047, 0.047, 0.03]), np.array([0.055, 0.055, 0.11])
MAP = certainty_equivalence(jnp.asarray(TORQUE), jnp.asarray(NOMINAL))
LADRC_LAW = ScheduledLADRC(LADRC([3.0, 3.0, 2.0], 20.0, 1.0, limit=10.0), MAP)
PID_LAW = ScheduledPID(PID(12.0, 6.0, 6.0, measurement_filter=60.0, feedforward=1.0), MAP)
INERTIA = NOMINAL[:, None] * np.array([0.4, 1.0, 1.7, 3.0])


def response(linear, z):
    """From the angle to the command, at the points `z`."""
    law = jax.tree.map(np.asarray, linear)
    inner = [np.linalg.solve(point * np.eye(len(law.A)) - law.A, law.measurement_in) for point in z]
    return np.stack(inner) @ law.C + law.measurement_through


def test_certainty_equivalence_makes_one_loop_of_all_inertias():
    z = np.exp(1j * 0.002 * np.geomspace(0.1, 1000.0, 20))
    for law in (LADRC_LAW, PID_LAW):
        found = law.scheduled_at(INERTIA)
        gain = TORQUE[0] / INERTIA[0]
        loops = [b * response(found.linear(0, k), z) for k, b in enumerate(gain)]
        for loop in loops[1:]:
            assert loop == pytest.approx(loops[0], rel=1e-9)


def test_a_member_is_the_controller_that_is_told_its_inertia_alone():
    for law in (LADRC_LAW, PID_LAW):
        many, one = law.scheduled_at(INERTIA), law.scheduled_at(INERTIA[:, 2])
        assert many.ensemble == (4,) and one.ensemble == law.ensemble == ()
        for axis in range(3):
            pair = many.linear(axis, 2), one.linear(axis)
            for a, b in zip(*map(jax.tree.leaves, pair), strict=True):
                assert np.asarray(a) == pytest.approx(np.asarray(b), rel=1e-14)


def test_a_map_with_members_is_told_one_inertia_for_all():
    values = np.log([[4.0], [1.0]])[:, :, None] + np.zeros((2, 3, 5))
    law = ScheduledLADRC(LADRC_LAW.ladrc, InertiaMap(jnp.asarray(NOMINAL), [-1.0, 1.0], values))
    found = law.scheduled_at(NOMINAL)
    assert law.ensemble == found.ensemble == (5,)
    assert np.asarray(found.b0) == pytest.approx(np.full((3, 5), 2.0))  # the mean of the logs


def test_the_pid_has_its_gains_per_b0_and_all_else_as_it_was():
    found, b0 = PID_LAW.scheduled_at(INERTIA), np.asarray(MAP(jnp.asarray(INERTIA)))
    for name in ("kp", "ki", "kd", "feedforward"):
        given = np.asarray(getattr(PID_LAW.pid, name))
        assert np.asarray(getattr(found, name)) * b0 == pytest.approx(0 * b0 + given)
    assert found.measurement_filter == 60.0 and found.filter == PID_LAW.pid.filter
    assert found.anti_windup == PID_LAW.pid.anti_windup


def test_knots_next_to_an_inertia_share_the_slope_of_its_gain():
    def total(law):
        return jnp.sum(jnp.log(law.scheduled_at(jnp.asarray(INERTIA)).b0))

    slopes = np.asarray(jax.jit(jax.grad(total))(LADRC_LAW).map.values)
    assert slopes.sum(axis=0) == pytest.approx(np.full(3, 4.0))  # each of four inertias once
    assert (slopes >= 0).all()


def test_an_adaptive_controller_is_scheduled_for_analysis_only():
    law = AdaptiveLADRC(LADRC_LAW.ladrc, RecursiveInertia(TORQUE, NOMINAL), MAP)
    b0 = LADRC_LAW.scheduled_at(INERTIA).b0
    assert np.array_equal(schedule_for_analysis(law, INERTIA).b0, b0)
    assert schedule_for_flight(law, INERTIA) is law
    assert np.array_equal(schedule_for_flight(LADRC_LAW, INERTIA).b0, b0)
    plain = LADRC_LAW.ladrc
    assert schedule_for_analysis(plain, INERTIA) is plain
    assert schedule_for_flight(plain, INERTIA) is plain
    with pytest.raises(ValueError, match="schedule the one that it was made of"):
        law.prepared().scheduled_at(NOMINAL)


def test_a_fuzzy_map_schedules_as_well():
    fuzzy = FuzzyMap(jnp.asarray(NOMINAL), 3.0, [1.0, 2.0], [0.0, -1.0])
    assert np.asarray(ScheduledLADRC(LADRC_LAW.ladrc, fuzzy).scheduled_at(1.5 * NOMINAL).b0) == (
        pytest.approx(np.full(3, 2.5))
    )


@pytest.mark.parametrize(
    "inertia, message",
    [
        (0.05, "one value per axis"),
        ([0.05, 0.0, 0.1], "must be above 0"),
        ([0.05, np.nan, 0.1], "must be above 0"),
        ([0.05, 0.05], "different numbers of axes"),
    ],
)
def test_what_is_no_inertia_of_these_axes_is_refused(inertia, message):
    for law in (LADRC_LAW, PID_LAW):
        with pytest.raises(ValueError, match=message):
            law.scheduled_at(np.asarray(inertia))
