"""An ensemble split among devices has the numbers of the whole; which arrays are split."""

import functools as ft
import json
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad._core import ensemble_shape, mark_members
from jaxquad.control import AdaptiveLADRC, InertiaMap, LADRC, PD, RecursiveInertia
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes, quanser_hover
from jaxquad.simulation import (
    evaluate,
    in_slices,
    MotorDrive,
    over_devices,
    scenario,
    simulate,
    Step,
    WhiteNoise,
)


ROUNDING = 1e-12  # the same sums, in vectors of another length
PROGRAM = Path(__file__).parents[1] / "device_runs.py"


def run(*command, **environment):
    ran = subprocess.run(
        [sys.executable, *command],
        capture_output=True,
        text=True,
        timeout=300,
        env=os.environ | environment,
    )
    assert ran.returncode == 0, ran.stderr[-3000:]
    return ran.stdout.strip().splitlines()[-1]


@pytest.fixture(scope="module")
def found():
    """The devices of a process are settled when JAX starts, so these runs are another process's."""
    told = {"JAX_NUM_CPU_DEVICES": "2", "JAX_ENABLE_X64": "1"}
    return json.loads(run("-W", "error", str(PROGRAM), **told))


@pytest.mark.slow
@pytest.mark.parametrize(
    "what",
    ["evaluate", "simulate", "gradient", "gradient of a cost of one's own"],
)
def test_two_devices_have_the_numbers_of_one(found, what):
    """Of 67 members, some of which diverge, with delays and noise of their own."""
    assert found[what] < ROUNDING
    assert 0 < found["diverged"] < 67


@pytest.mark.slow
def test_results_lie_where_those_of_one_device_do(found):
    assert found["results lie on"] == [[0], False]


@pytest.mark.slow
def test_data_that_were_put_on_a_device_by_hand_are_computed_there(found):
    assert found["those of data put by hand lie on"] == [[1], True]
    assert found["those of split data lie on"] == [[0], False]


@pytest.mark.slow
def test_what_is_split_already_is_not_split_again(found):
    assert found["alone within"]


@pytest.mark.slow
def test_each_device_has_a_kernel_of_its_own(found):
    assert found["kernels"]


@pytest.mark.slow
def test_few_members_stay_together(found):
    assert (found["devices for 63"], found["devices for 64"]) == (1, 2)


def test_importing_jaxquad_starts_no_backend():
    """Or the number of devices, and other processes, could not be told after it."""
    told = 'import jaxquad, jax; jax.config.update("jax_num_cpu_devices", 2); print("told")'
    assert run("-c", told) == "told"


PLANT = DecoupledAxes([0.0468], [[0.05, 0.06]])
HAPPENS = scenario(duration=0.2, axes=1, reference={0: Step(0.1)})


@pytest.mark.parametrize("count", [0, 2])
def test_devices_that_jax_does_not_have_are_refused(count):
    with pytest.raises(ValueError, match=rf"devices is {count}, .* 1 here \(cpu\).*num_cpu"):
        evaluate(Loop(PLANT, PD([40.0], [8.0])), HAPPENS, devices=count)


def test_no_devices_are_refused():
    with pytest.raises(ValueError, match="give a number, some of jax.devices"):
        simulate(Loop(PLANT, PD([40.0], [8.0])), HAPPENS, devices=[])


@pytest.mark.slow
def test_one_device_is_asked_for_in_any_way():
    numbers = [
        evaluate(Loop(PLANT, PD([40.0], [8.0])), HAPPENS, devices=devices).itae
        for devices in (None, 1, jax.devices())
    ]
    np.testing.assert_array_equal(numbers[0], numbers[1])
    np.testing.assert_array_equal(numbers[0], numbers[2])


def split(plant, controller, happens, **options):
    """The arrays of a loop that are split, by name."""
    run = (Loop(plant, controller, **options), happens)
    paths = jax.tree_util.tree_leaves_with_path(mark_members(run, ensemble_shape(*run)))
    name = ft.partial(jax.tree_util.keystr, simple=True, separator=".")
    room = ("loop", "scenario")
    return {f"{room[path[0].idx]}.{name(path[1:])}" for path, is_own in paths if is_own is True}


def noisy(axes, members):
    return scenario(
        duration=0.2, axes=axes, noise=WhiteNoise(0.1), ensemble=members, key=jax.random.key(0)
    )


def test_what_members_do_not_have_for_themselves_is_not_split():
    gains = LADRC([10.0], [30.0], [[0.8] * 50])
    plant = DecoupledAxes([0.05], [[0.06] * 50], lag=[0.01])
    found = split(plant, gains, noisy(1, 50), delay=np.array([0.002, 0.001] * 25))
    named = {"loop.plant.inertia", "loop.controller.b0", "scenario.noise", "loop.delay"}
    assert found == named


def test_an_ensemble_of_two_axes_is_split_on_the_last():
    plant = DecoupledAxes([0.05], 0.06 * np.ones((1, 5, 50)), lag=0.01 * np.ones((1, 5)))
    assert split(plant, PD([40.0], [8.0]), noisy(1, ())) == {"loop.plant.inertia"}


def test_one_loop_has_no_members():
    assert split(DecoupledAxes([0.05], [0.06]), PD([40.0], [8.0]), noisy(1, ())) == set()


def test_three_members_are_told_from_three_axes_and_three_knots():
    b0 = InertiaMap([0.0552] * 3, [-1.0, 0.0, 1.0], np.ones((3, 3)))
    estimator = RecursiveInertia([0.0468] * 3, [0.0552] * 3)
    controller = AdaptiveLADRC(LADRC([10.0] * 3, [30.0] * 3, [0.85] * 3), estimator, b0)
    plant = DecoupledAxes([0.0468] * 3, 0.05 * np.ones((3, 3)))
    assert split(plant, controller, noisy(3, 3)) == {"loop.plant.inertia", "scenario.noise"}


def test_a_parameter_in_one_dimension_is_split():
    hover = quanser_hover()
    arms = hover.allocation.arm * jnp.asarray([0.9, 1.0, 1.1, 1.2])
    vehicle = eqx.tree_at(lambda v: v.allocation.arm, hover, arms)
    controller = LADRC([8.0] * 3, [30.0] * 3, [0.4, 0.4, 0.2])
    drive = MotorDrive(hover.allocation)
    assert split(vehicle, controller, noisy(3, ()), drive=drive) == {"loop.plant.allocation.arm"}


def test_over_one_device_it_is_the_function_itself():
    double = lambda own, shared: {"twice": 2 * own["x"] + shared}
    found = over_devices(double, {"x": jnp.arange(5)}, 1, devices=1)
    np.testing.assert_array_equal(found["twice"], [1, 3, 5, 7, 9])


@pytest.mark.parametrize("own", [{}, {"a": jnp.ones(3), "b": jnp.ones(4)}, jnp.ones(())])
def test_arrays_without_an_axis_of_members_are_refused(own):
    with pytest.raises(ValueError, match="needs the members on its last axis"):
        over_devices(lambda own, shared: own, own)


@pytest.mark.parametrize("at_once", [1, 3, 7, 20])
def test_slices_join_to_the_whole(at_once):
    lengths = set()

    def doubled(indices):
        lengths.add(len(indices))
        return 2 * indices, jnp.stack([indices, -indices])

    twice, both = in_slices(doubled, 7, at_once=at_once)
    np.testing.assert_array_equal(twice, 2 * np.arange(7))
    np.testing.assert_array_equal(both, [np.arange(7), -np.arange(7)])
    assert lengths == {min(at_once, 7)}


@pytest.mark.slow
def test_metrics_join_to_those_of_all_members():
    inertia = np.linspace(0.05, 0.08, 4)
    fly = lambda k: evaluate(
        Loop(DecoupledAxes([0.0468], inertia[None, k]), PD([40.0], [8.0])), HAPPENS
    )
    parts = in_slices(fly, 4, at_once=2)
    whole = fly(np.arange(4))
    np.testing.assert_allclose(parts.itae, whole.itae, rtol=ROUNDING)
    assert (parts.stop, parts.summary().members) == (whole.stop, 4)


def test_slices_of_what_members_share_are_refused():
    with pytest.raises(ValueError, match=r"shape \(3,\), but the 2 members"):
        in_slices(lambda k: jnp.ones(3), 4, at_once=2)
    with pytest.raises(ValueError, match="give 1 or more of both"):
        in_slices(lambda k: k, 0, at_once=2)


def test_what_the_memory_does_not_hold_is_refused_before_it_is_tried():
    vast, key = 10**9, jax.random.key(0)
    if not Path("/proc/meminfo").exists():
        pytest.skip("this machine does not tell how much memory is free")
    with pytest.raises(ValueError, match="1000000000 members needs about .* GB are free"):
        scenario(duration=1.0, axes=1, noise=WhiteNoise(0.1), ensemble=vast, key=key)


def test_a_record_that_the_memory_does_not_hold_is_refused():
    """A scenario of many samples, of shapes only: nothing is allocated."""
    plant = eqx.filter_eval_shape(lambda: DecoupledAxes([0.05], jnp.ones((1, 10**9))))
    loop = (Loop(plant, PD([40.0], [8.0])), HAPPENS)
    with pytest.raises(ValueError, match="100 samples of 1 axes of 1000000000 members needs"):
        eqx.filter_eval_shape(simulate, *loop)
