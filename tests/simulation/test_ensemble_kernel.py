"""Ensembles as kernels of a GPU, which are compiled for the processor here: the plain numbers."""

import functools as ft

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from cuda_on_host import for_cuda, run_on_host

from jaxquad._xla import _switch
from jaxquad.control import LADRC
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import evaluate, Pulse, run_ensemble, Saturation, scenario, simulate, Step


pytestmark = pytest.mark.slow


MEMBERS = 70  # one chunk, as all members are on a GPU
QUICK = {"xla_backend_optimization_level": 0}
GAINS = np.array([10.0, 30.0, 0.8478])


def loop(gains, delay):
    plant = DecoupledAxes([0.0468], 0.0552 * np.geomspace(0.5, 2.0, MEMBERS)[None], lag=[0.005])
    controller = LADRC(gains[:1], gains[1:2], gains[2:])
    return Loop(plant, controller, drive=Saturation(20.0), delay=delay)


def happens():
    pulse = Pulse(0.1, width=0.01, at=0.01)
    return scenario(duration=0.022, axes=1, reference={0: Step(0.07)}, disturbance={0: pulse})


def measured(gains, delay):
    found = evaluate(loop(gains, delay), happens())
    return jnp.mean(found.itae) + jnp.mean(found.rms), found


def stored(gains, delay):
    found = simulate(loop(gains, delay), happens())
    return jnp.mean(found.angle[-1]), (found.time, found.angle, found.saturated)


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    monkeypatch.setattr(_switch, "_said", {})
    run_on_host(monkeypatch)


def in_mode(mode, function):
    with _switch.device_kernels(mode):
        run = jax.value_and_grad(function, has_aux=True)
        return jax.jit(run, compiler_options=QUICK)(jnp.asarray(GAINS))


@pytest.mark.parametrize(
    "run, delay", [(stored, 0.004), pytest.param(measured, 0.0075, marks=pytest.mark.slow)]
)
def test_a_flight_and_its_gradient_are_those_of_the_plain_loop(run, delay):
    found, expected = (in_mode(x, ft.partial(run, delay=delay)) for x in ("forced", "auto"))
    assert not _switch.left_plain()
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("delay", [0.0, 0.0075])
def test_a_flight_becomes_one_kernel_of_a_gpu(delay):
    text = for_cuda(lambda gains: measured(gains, delay)[0], jnp.asarray(GAINS))
    assert text.count("gpu.ptx") == 1
    assert "stablehlo.while" not in text


def test_an_ensemble_of_ones_own_becomes_one_kernel_of_a_gpu():
    def run(x, rate):
        step = lambda x, parts, now: (x + 0.1 * (now - parts[0] * x), x[0])
        return run_ensemble(
            step, x, (rate,), jnp.linspace(0.0, 1.0, 9), of_members=((True,), False)
        )

    x = jnp.ones((2, MEMBERS))
    assert for_cuda(run, x, x).count("gpu.ptx") == 1
