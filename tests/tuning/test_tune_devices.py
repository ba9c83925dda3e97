"""A tune on two devices is that on one: in a process of its own, which has two."""

import json
import subprocess
import sys
from pathlib import Path

import pytest


PROGRAM = """
import json, jax
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_num_cpu_devices", 2)
import numpy as np
from tuning_case import DT, ensemble, ladrc, loop
from jaxquad.simulation import scenario, Step
from jaxquad.tuning import LBFGS, Objective, Penalty, tune

calm = Objective({"iae": 1.0}, (Penalty("abscissa", -0.5, 5.0),))
step = scenario(duration=0.2, dt=DT, axes=1, reference=Step(0.1))
# Nine members are no multiple of two.
drawn = ensemble().draw(loop(), 9, jax.random.key(0))
ends = [
    tune(loop(ladrc(5.0, 30.0)), drawn, step, objective=calm, fresh=None, progress=False,
         method=LBFGS(evaluations=2), devices=count)
    for count in (1, 2)
]
print(json.dumps([[[e.phase, *e.cost, *e.gradient_norm, *map(float, e.z[0])] for e in t.history]
                  for t in ends]))
"""


@pytest.mark.slow
def test_the_cost_and_its_gradient_are_the_same_on_two_devices():
    out = subprocess.run(
        [sys.executable, "-c", PROGRAM],
        cwd=Path(__file__).parents[1],
        capture_output=True,
        text=True,
    )
    assert out.returncode == 0, out.stderr
    one, two = json.loads(out.stdout)
    assert len(one) == len(two) >= 2
    for a, b in zip(one, two, strict=True):
        assert a[0] == b[0] and a[1:] == pytest.approx(b[1:], rel=1e-9)
