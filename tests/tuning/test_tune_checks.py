"""What a tune refuses before it compiles anything: one clear error each."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tuning_case import ensemble, equivalent, EVENTS, flight, ladrc, objective

from jaxquad.control import LADRC
from jaxquad.simulation import Pulse, scenario
from jaxquad.tuning import LBFGS, Limit, Objective, tune
from jaxquad.tuning._checks import require_kinds
from jaxquad.tuning._phases import Rounds


KEY, START = jax.random.key(0), equivalent(3.0, 30.0)


def run(controller=START, members=None, scene=None, **options):
    drawn = ensemble().draw(4, KEY) if members is None else members
    given = {"objective": objective(), "fresh": None, "progress": False, "key": KEY} | options
    return tune(controller, drawn, flight() if scene is None else scene, **given)


def single(x):
    return x.astype(jnp.float32) if eqx.is_inexact_array(x) else x


STILL = scenario(duration=10.0, axes=1, disturbance=Pulse(0.1, width=0.3))
NOT_A_NUMBER = eqx.tree_at(lambda c: c.ladrc.wc, START, jnp.array(jnp.nan))
LATE = Objective(events=(0.0, 12.0))
REFUSED = {
    "float32": ({"controller": jax.tree.map(single, START)}, "is float32"),
    "a gain that is nan": ({"controller": NOT_A_NUMBER}, "wc starts at nan"),
    "one that is held": ({"controller": NOT_A_NUMBER, "free": "map.values"}, "wc is nan"),
    "another dt": ({"controller": LADRC(3.0, 30.0, 1.0, dt=0.004)}, "0.004 s"),
    "other axes": ({"scene": scenario(duration=1.0, axes=3)}, "scenario is for 3 axes"),
    "nothing free": ({"free": []}, "free is empty"),
    "no scatter": ({"starts": 2, "scatter": np.nan}, "scatter of nan"),
    "an event after the end": ({"objective": LATE}, r"events at \[12.0\] s lie beyond"),
    "no step": ({"scene": STILL, "limits": [Limit("overshoot", at_most=5.0)]}, "makes no step"),
    "too many devices": ({"devices": 99}, "devices is 99"),
    "members tuned on": ({"fresh": ensemble().draw(4, KEY)}, "4 of the fresh members are those"),
    "a peer's name": ({"peers": {"tuned": START}}, "a peer has the name 'tuned'"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused_with_what_to_give(case):
    options, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        run(**options)


def test_an_argument_of_another_kind_is_named_with_its_own():
    given: tuple[Any, ...] = (ensemble(), objective(), [], LBFGS())
    require_kinds(*given)
    others = (ensemble().plant, {"itae": 1.0}, Limit("itae", at_most=1.0), "lbfgs")
    messages = ("ensemble is a DecoupledAxes", "objective is a dict", "give a list", "is 'lbfgs'")
    for k, (other, message) in enumerate(zip(others, messages, strict=True)):
        wrong = [*given[:k], other, *given[k + 1 :]]
        with pytest.raises(ValueError, match=message):
            require_kinds(wrong[0], wrong[1], wrong[2], wrong[3])


def test_rounds_that_come_no_nearer_to_a_limit_end_and_the_nearest_of_them_counts():
    rounds, z = Rounds(), np.arange(2.0)[:, None]
    # The first problem's limit cannot be met; the second's is, in ever smaller steps.
    missed = np.array([[0.50, 0.5], [0.40, 0.2], [0.39, 0.05], [0.41, 0.001]])
    for k, row in enumerate(missed):
        rounds.add(z + 10 * k, np.array([3.0 - k, -1.0]), row[:, None])
        assert not rounds.stalled[1]
    assert rounds.stalled[0]
    # Of the rounds within 5 % of the nearest miss, the one of the lowest cost.
    np.testing.assert_array_equal(rounds.best()[:, 0], [20.0, 31.0])


def test_the_parts_between_events_are_judged_for_overshoot_as_the_certificate_does():
    from jaxquad.simulation import evaluate
    from jaxquad.tuning._problem import problem_of

    members = ensemble().draw(8, KEY)
    problem = problem_of(ladrc(10.0, 30.0), members, flight(), events=EVENTS)
    found = eqx.filter_jit(lambda p, c: p.in_time(c, ("overshoot",)))(problem, ladrc(10.0, 30.0))
    parts = [(0.0, 2.5), (2.5, 4.5), (4.5, 6.5), (6.5, None)]
    each = [
        evaluate(
            members.plant, ladrc(10.0, 30.0), members.flight(flight()), drive=members.drive,
            delay=members.delay, start=start, stop=stop,
        ).overshoot
        for start, stop in parts
    ]  # fmt: skip
    np.testing.assert_allclose(found["overshoot"], np.nanmax(each, axis=0), rtol=1e-9, atol=1e-9)
    assert np.ptp(found["overshoot"]) > 1.0
