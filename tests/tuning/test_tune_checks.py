"""What a tune refuses before it compiles anything: one clear error each."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tuning_case import ensemble, equivalent, flight, loop, objective

from jaxquad.control import LADRC
from jaxquad.loops import Loop
from jaxquad.simulation import Pulse, scenario
from jaxquad.tuning import Limit, Objective, tune


KEY, START = jax.random.key(0), equivalent(3.0, 30.0)


def run(controller=START, around=None, members=None, scene=None, **options):
    drawn = ensemble().draw(loop(), 4, KEY) if members is None else members
    given = {"objective": objective(), "fresh": None, "progress": False, "key": KEY} | options
    own = loop(controller) if around is None else around
    return tune(own, drawn, flight() if scene is None else scene, **given)


def single(x):
    return x.astype(jnp.float32) if eqx.is_inexact_array(x) else x


STILL = scenario(duration=10.0, axes=1, disturbance=Pulse(0.1, width=0.3))
NOT_A_NUMBER = eqx.tree_at(lambda c: c.ladrc.wc, START, jnp.array(jnp.nan))
LATE = Objective(events=(0.0, 12.0))
REFUSED = {
    "float32": ({"controller": jax.tree.map(single, START)}, "is float32"),
    "a gain that is nan": ({"controller": NOT_A_NUMBER}, "wc starts at nan"),
    "one that is held": ({"controller": NOT_A_NUMBER, "free": "map.values"}, "wc is nan"),
    "another dt": ({"around": Loop(loop().plant, LADRC(3.0, 30.0, 1.0, dt=0.004))}, "0.004 s"),
    "other axes": ({"scene": scenario(duration=1.0, axes=3)}, "scenario is for 3 axes"),
    "nothing free": ({"free": []}, "free is empty"),
    "no scatter": ({"starts": 2, "scatter": np.nan}, "scatter of nan"),
    "an event after the end": ({"objective": LATE}, r"events at \[12.0\] s lie beyond"),
    "no step": ({"scene": STILL, "limits": [Limit("overshoot", at_most=5.0)]}, "makes no step"),
    "too many devices": ({"devices": 99}, "devices is 99"),
    "members tuned on": ({"fresh": ensemble().draw(loop(), 4, KEY)}, "4 of the fresh members"),
    "a peer's name": ({"peers": {"tuned": START}}, "a peer has the name 'tuned'"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused_with_what_to_give(case):
    options, message = REFUSED[case]
    with pytest.raises(ValueError, match=message):
        run(**options)


WRONG: dict[str, tuple[Any, str]] = {
    "around": (LADRC(3.0, 30.0, 1.0), "loop is a LADRC: give jq.Loop"),
    "members": (loop().plant, "ensemble is a DecoupledAxes"),
    "objective": ({"itae": 1.0}, "objective is a dict"),
    "limits": (Limit("itae", at_most=1.0), "give a list"),
    "method": ("lbfgs", "is 'lbfgs'"),
}


@pytest.mark.parametrize("name", WRONG)
def test_an_argument_of_another_kind_is_named_with_its_own(name, without_type_checks):
    given, message = WRONG[name]
    with pytest.raises(ValueError, match=message):
        run(**{name: given})
