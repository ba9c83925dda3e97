"""Ensembles on several cores of a CPU: what is found is that of one core."""

import functools as ft
import inspect
import threading

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq
from jaxquad._compile import Jit
from jaxquad.simulation import _parallel, _scenario, _simulate


MEMBERS, SAMPLES, PART = 100, 200, 32


@pytest.fixture
def cores(monkeypatch):
    def have(count):
        monkeypatch.setattr(_parallel, "available_cores", lambda: count)

    monkeypatch.setattr(_parallel, "_LEAST", 1)
    monkeypatch.setattr(_parallel, "_USUAL", PART)
    return have


@pytest.fixture
def calls(monkeypatch):
    """The threads and the members of each call of the simulation's program."""
    program, seen = _simulate._run, []

    class Watched(Jit):
        @property
        def brief(self):
            return self

        def of_flat(self, args, leaves, structure):
            found = program.brief.of_flat(args, leaves, structure)
            seen.append((threading.get_ident(), found[0][0][0].shape[-1]))
            return found

    monkeypatch.setattr(_simulate, "_run", Watched(inspect.unwrap(program)))
    return seen


def happens(**more):
    step: dict[str | int, jq.simulation.Step] = {0: jq.simulation.Step(np.radians(4.0))}
    return jq.scenario(duration=SAMPLES * 0.002, axes=1, reference=step, **more)


def noisy(members=MEMBERS):
    noise = jq.simulation.WhiteNoise(np.radians(0.02))
    return happens(noise=noise, ensemble=members, key=jax.random.key(3))


def loop(members=MEMBERS, inertia=None, **more):
    """Some members leave the bound."""
    spread = 0.0552 * np.geomspace(0.5, 2.0, members)[None]
    plant = jq.DecoupledAxes([0.0468], spread if inertia is None else inertia)
    controller = jq.LADRC([10.0], [30.0], [0.0468 / 0.0552])
    drive = jq.simulation.Saturation([20.0])
    return jq.Loop(plant, controller, drive=drive, bound=0.062, **more)


def fly(members=MEMBERS, **more):
    return jq.simulate(loop(members), noisy(members), **more)


def same(one, other):
    found, expected = (jax.tree.leaves_with_path(x) for x in (one, other))
    assert len(found) == len(expected)
    for (path, x), (_, y) in zip(found, expected, strict=True):
        np.testing.assert_array_equal(x, y, err_msg=str(path))


@pytest.mark.slow
def test_members_fly_as_on_one_core(cores, calls):
    found = []
    for count in (1, 2, 16):
        cores(count)
        found.append(fly())
    assert np.any(found[0].diverged) and not np.all(found[0].diverged)
    same(found[1], found[0])
    same(found[2], found[0])
    assert [width for _, width in calls] == [MEMBERS, *8 * [PART]]
    assert len({thread for thread, _ in calls}) > 1


@pytest.mark.slow
def test_sizes_share_a_program(cores, calls):
    cores(2)
    for members in (90, MEMBERS, 170):
        fly(members)
    assert {width for _, width in calls} == {PART}


def test_metrics_are_those_of_one_core(cores):
    found = []
    for count in (1, 3):
        cores(count)
        found.append(jq.evaluate(loop(), noisy(), start=0.01))
    same(*found)


def test_what_all_members_share_is_there_once(cores):
    cores(2)
    found = jq.simulate(loop(inertia=[0.0552]), noisy())
    assert found.angle.shape == (SAMPLES, 1, MEMBERS)
    assert found.authority is not None and found.authority.torque.shape == (1,)


@pytest.mark.slow
def test_an_ensemble_of_two_axes_is_parted_by_its_last(cores):
    spread = 0.0552 * np.geomspace(0.5, 2.0, MEMBERS)
    inertia, found = spread * np.array([[[1.0], [1.1]]]), []
    for count in (1, 2):
        cores(count)
        found.append(jq.simulate(loop(inertia=inertia), happens()))
    assert found[1].angle.shape == (SAMPLES, 1, 2, MEMBERS)
    same(*found)


@pytest.mark.parametrize(
    "count, members, devices", [(2, MEMBERS, 1), (1, MEMBERS, None), (2, PART, None)]
)
def test_what_gains_nothing_is_computed_at_once(cores, calls, count, members, devices):
    cores(count)
    fly(members, devices=devices)
    assert calls == [(threading.get_ident(), members)]


@pytest.mark.parametrize(
    "members, briefly", [(1, False), (8, False), (9, True), (64, True), (65, False)]
)
def test_ensembles_of_some_members_are_compiled_briefly(members, briefly):
    class Asked(Jit):
        @ft.cached_property
        def brief(self):
            return Asked(lambda *args: {"briefly": np.ones(1)})

        def __call__(self, *args):
            return inspect.unwrap(self)(*args)

    program = Asked(lambda *args: {})
    run = loop(members, **({} if members > 1 else {"inertia": [0.0552]})), happens()
    assert ("briefly" in _parallel.over_cores(program, run, (), tuple(jax.devices()))) == briefly


def test_a_short_flight_is_not_worth_a_thread(monkeypatch, calls):
    monkeypatch.setattr(_parallel, "available_cores", lambda: 2)
    fly()
    assert len(calls) == 1


@pytest.mark.slow
def test_within_another_program_nothing_is_parted(cores):
    cores(2)

    def lost(factor):
        spread = factor * jnp.geomspace(0.03, 0.1, MEMBERS)[None]
        return jnp.sum(jq.evaluate(loop(inertia=spread), noisy()).itae)

    slope = jax.grad(lost)(1.0)
    ahead, back = (float(lost(1.0 + h)) for h in (1e-5, -1e-5))
    assert slope == pytest.approx((ahead - back) / 2e-5, rel=1e-4)


def test_a_record_that_does_not_fit_is_refused_by_the_size_of_all(cores, monkeypatch):
    cores(4)
    size = 25 * SAMPLES * MEMBERS  # B, at least
    monkeypatch.setattr(_scenario, "free_memory", lambda device: 0.9 * size)
    with pytest.raises(ValueError, match=f"of {MEMBERS} members needs about"):
        fly()


def test_what_goes_wrong_in_a_part_is_said(cores):
    cores(2)

    class Broken(eqx.Module):
        def init(self, like):
            return None

        def step(self, state, reference, measurement):
            raise ValueError("this law is broken")

    with pytest.raises(ValueError, match="this law is broken"):
        jq.simulate(loop().with_controller(Broken()), happens())
