"""A delayed loop is the same as a kernel and plain, and compiles as fast for every delay."""

import jax
import numpy as np
import pytest
from random_delays import compare, cost_of, DT

import jaxquad as jq


CASES = {
    "no delay, forward derivative": (0.0, 2, "forward derivative", True, False),
    "whole samples, single precision": (20 * DT, 2, "gradient", False, False),
    "members 0.8 to 1 s": (np.linspace(0.8, 1.0, 20), 20, "value", True, False),
    "traced, in chunks": (np.linspace(0.0, 0.02, 129), 129, "value", True, True),
    "traced, vmap": (0.013, 0, "vmap of gradients", True, True),
}


LONG = ("traced, vmap", "whole samples, single precision", "no delay, forward derivative")


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[pytest.mark.slow] * (x in LONG)) for x in CASES]
)
def test_a_delayed_loop_is_the_same_as_a_kernel_and_plain(name):
    compare(*CASES[name])


@pytest.mark.slow
def test_a_longer_delay_makes_no_larger_program():
    size = lambda delay: len(
        jax.jit(jax.grad(cost_of(delay, 2, False), argnums=0))
        .lower(np.array([2.0, 12.0]), 0.0)
        .as_text()
    )
    short, long = size(0.062), size(0.512)
    assert long < 1.02 * short


def test_what_keeps_a_delay_is_said_in_samples():
    loop = lambda delay: jq.Loop(jq.DecoupledAxes([0.01], [0.05]), jq.LADRC(2, 10, 20), delay=delay)
    assert loop(0.3).queue[:2] == (150, False)
    assert loop(np.array([0.3, 0.301])).queue.fewest == 150
