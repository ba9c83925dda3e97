"""Poles, margins and noise of every axis of every member, in one compile for any controller."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxquad._core import per_member
from jaxquad.control import LinearController
from jaxquad.loops import analyse, Loop, LoopAnalysis
from jaxquad.models import DecoupledAxes


_STATES = 5  # all controllers are padded to: then they share a compile


class LoopNumbers(NamedTuple):
    """The linear loops of an ensemble: NaN where an unstable loop has no such number."""

    stable: Bool[np.ndarray, "axes members"]
    abscissa: Float[np.ndarray, "axes members"]  # 1/s
    sensitivity_peak: Float[np.ndarray, "axes members"]
    gain_margin: Float[np.ndarray, "axes members"]  # factor
    gain_reduction: Float[np.ndarray, "axes members"]  # factor
    phase_margin: Float[np.ndarray, "axes members"]  # rad
    delay_margin: Float[np.ndarray, "axes members"]  # s
    noise_gain: Float[np.ndarray, "axes members"]  # rms of the command per rad rms


class _Laws(eqx.Module):
    """The linear controllers of many loops, on a leading axis."""

    laws: LinearController
    index: Int[Array, " loops"] = per_member(0)

    @property
    def dt(self) -> float:
        return self.laws.dt

    def linear(self, axis: int, member: tuple[Int[Array, ""]]) -> LinearController:
        return jax.tree.map(lambda x: x[member[0]], self.laws)


def loop_numbers(
    plant: DecoupledAxes, controller: Any, delay: Float[Array, " members"], *, longest: float,
    axes: int,
) -> LoopNumbers:  # fmt: skip
    """`jq.analyse` of each axis and member; stability by the eigenvalues themselves."""
    members = delay.shape[0]
    flat = _Laws(_linear(controller, axes, members), jnp.arange(axes * members))
    late = jnp.asarray(np.tile(np.asarray(delay), axes))
    loop = Loop(_flat(plant, axes, members), flat, delay=late, longest_delay=longest)
    found = analyse(loop, 0)
    slowest = np.real(found.poles[:, 0])
    stable = np.asarray(found.stable) & (slowest < 0)
    numbers = {name: _where(stable, found, name) for name in LoopNumbers._fields[2:]}
    shaped = {name: x.reshape(axes, members) for name, x in numbers.items()}
    return LoopNumbers(stable.reshape(axes, -1), slowest.reshape(axes, -1), **shaped)


def worst_of(loops: Sequence[LoopNumbers]) -> LoopNumbers:
    """Of the same members as different plants: stable where all are, else NaN as one of them."""
    stable = np.all([loop.stable for loop in loops], axis=0)
    worst = {"abscissa": np.max([loop.abscissa for loop in loops], axis=0)}
    for name in LoopNumbers._fields[2:]:
        find = np.min if name.endswith("margin") else np.max
        found = find([getattr(loop, name) for loop in loops], axis=0)
        worst[name] = np.where(stable, found, np.nan)
    return LoopNumbers(stable, **worst)


def _where(stable: np.ndarray, found: LoopAnalysis, name: str) -> np.ndarray:
    return np.where(stable, np.asarray(getattr(found, name)), np.nan)


def _flat(plant: DecoupledAxes, axes: int, members: int) -> DecoupledAxes:
    """All axes of all members as the members of one axis. Dry friction has no linear part."""

    def row(x: Array) -> np.ndarray:
        wide = np.asarray(x) if x.ndim > 1 else np.asarray(x)[:, None]
        return np.broadcast_to(wide, (axes, members)).reshape(1, axes * members)

    given = {name: x for name, x in vars(plant).items() if x is not None and name != "coulomb"}
    return DecoupledAxes(**{name: row(x) for name, x in given.items()})


@eqx.filter_jit
def _linear(controller: Any, axes: int, members: int) -> LinearController:
    """The linear form of each loop, stacked over axes times members, padded to a common size."""
    own = len(getattr(controller, "ensemble", ()))
    one = lambda k, i: _padded(controller.linear(k, (i,) if own else None))
    places = jnp.arange(members)
    stacks = [jax.vmap(lambda i, k=k: one(k, i))(places) for k in range(axes)]
    return jax.tree.map(lambda *parts: jnp.concatenate(parts), *stacks)


def _padded(law: LinearController) -> LinearController:
    """With further states that nothing drives and nothing reads."""
    room = max(0, _STATES - len(law.C))
    longer = lambda x: jnp.pad(x, (0, room))
    return LinearController(
        A=jnp.pad(law.A, ((0, room), (0, room))),
        reference_in=longer(law.reference_in),
        measurement_in=longer(law.measurement_in),
        C=longer(law.C),
        reference_through=law.reference_through,
        measurement_through=law.measurement_through,
        dt=law.dt,
    )
