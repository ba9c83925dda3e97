"""The axis of the members is declared, field by field, and asked in one place."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad._core import as_float, ensemble_shape, mark_members, per_member


class Rotor(eqx.Module):
    lag: jax.Array = per_member(rank=1, converter=as_float, default=0.02)
    curve: jax.Array = eqx.field(converter=as_float, default=(0.0, 1.0))  # of all members


class Gains(NamedTuple):
    kp: jax.Array | np.ndarray
    kd: jax.Array | np.ndarray | None = None


class Plant(eqx.Module):
    """A plant as a user would write it, outside of the package."""

    inertia: jax.Array = per_member(rank=1, converter=as_float)
    delay: jax.Array = per_member(rank=0, converter=as_float, default=0.0)
    gains: Gains | dict | None = per_member(rank=1, default=None)
    rotor: Rotor | None = None
    name: str = eqx.field(static=True, default="roll")


def marked(tree, ensemble, **options):
    """The names of the marked leaves."""
    marks = mark_members(tree, ensemble, **options)
    assert jax.tree.structure(marks) == jax.tree.structure(tree)
    paths = jax.tree_util.tree_flatten_with_path(marks)[0]
    return {jax.tree_util.keystr(path, simple=True, separator=".") for path, mark in paths if mark}


WHOLE = Plant(
    np.ones((3, 5)), np.zeros(5), Gains(np.ones((3, 1)), np.ones(3)), Rotor(np.ones((3, 5)))
)


@pytest.mark.parametrize(
    ("plant", "ensemble"),
    [
        (Plant(np.ones(3)), ()),
        (Plant(1.0), ()),
        (Plant(np.ones((3, 5))), (5,)),
        (Plant(np.ones((3, 1)), np.zeros(5)), (5,)),
        (Plant(np.ones(3), rotor=Rotor(np.ones((1, 7)))), (7,)),
        (Plant(np.ones(3), rotor=Rotor(curve=np.ones((3, 5)))), ()),
        (Plant(np.ones((3, 4, 1)), np.zeros((4, 5))), (4, 5)),
        (Plant(np.ones((3, 4)), np.zeros((4, 5))), (4, 5)),
        (Plant(np.ones(3), gains={"kp": jnp.ones((3, 6))}), (6,)),
        (WHOLE, (5,)),
    ],
)
def test_the_ensemble_is_the_common_shape_behind_the_declared_axes(plant, ensemble):
    assert ensemble_shape(plant) == ensemble
    assert ensemble_shape({"parts": (None, plant)}) == ensemble
    assert eqx.filter_eval_shape(lambda x: jnp.zeros(ensemble_shape(x)), plant).shape == ensemble


def test_several_parts_are_of_one_ensemble():
    assert ensemble_shape(Plant(np.ones((3, 1))), Rotor(np.ones((3, 5))), None) == (5,)
    assert ensemble_shape() == ()


def test_parts_of_different_ensembles_are_named_with_their_shapes():
    plant = Plant(np.ones((3, 4)), rotor=Rotor(np.ones((3, 5))))
    expected = r"Plant.inertia \(4,\), Plant.rotor.lag \(5,\), Rotor.lag \(6,\)"
    with pytest.raises(ValueError, match=expected):
        ensemble_shape(plant, Rotor(np.ones((1, 6))))


def test_arrays_with_a_value_for_each_member_are_marked():
    assert marked(WHOLE, (5,)) == {"inertia", "delay", "rotor.lag"}
    assert marked((WHOLE, {"other": WHOLE}), (5,)) == {
        f"{place}.{name}"
        for place in ("0", "1.other")
        for name in ("inertia", "delay", "rotor.lag")
    }


def test_what_is_as_long_as_the_ensemble_by_chance_is_not_marked():
    plant = Plant(np.ones(3), np.zeros(3), rotor=Rotor(np.ones(3), curve=np.ones(3)))
    assert marked(plant, (3,)) == {"delay"}


def test_only_the_last_axis_of_an_ensemble_is_marked():
    plant = Plant(np.ones((3, 4)), np.zeros((4, 5)), rotor=Rotor(np.ones((3, 1, 5))))
    assert marked(plant, (4, 5)) == {"delay", "rotor.lag"}
    assert marked(plant, ()) == set()


def test_arrays_without_a_declaration_may_be_given_a_rank():
    gains = {"kp": np.ones((3, 5)), "limit": np.ones(())}
    assert ensemble_shape(gains) == () and marked(gains, (5,)) == set()
    assert ensemble_shape(gains, rank=1) == (5,) and marked(gains, (5,), rank=1) == {"kp"}


def test_only_shapes_are_asked_for():
    shapes = jax.eval_shape(lambda: WHOLE)
    assert ensemble_shape(shapes) == (5,) and marked(shapes, (5,)) == marked(WHOLE, (5,))
    seen = []

    @eqx.filter_jit
    def split(plant):
        ensemble = ensemble_shape(plant)
        theirs, shared = eqx.partition(plant, mark_members(plant, ensemble))
        seen.append([x.shape for x in jax.tree.leaves(theirs)])
        return eqx.combine(theirs, shared)

    assert eqx.tree_equal(split(WHOLE), jax.tree.map(jnp.asarray, WHOLE))
    assert seen == [[(3, 5), (5,), (3, 5)]]


def test_a_declared_field_keeps_its_other_options():
    assert Plant([1, 2, 3]).inertia.dtype == float
    assert Rotor().lag == 0.02
