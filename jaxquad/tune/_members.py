from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Key

from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.models._parameters import is_concrete
from jaxquad.simulate import Encoder, gauss_markov, Scenario
from jaxquad.simulate._protocols import Drive

from ._payload import Carried


class Members(eqx.Module):
    """Drawn members of an ensemble: arrays only, the members last.

    `plant` holds `[axes, members]` where they differ and `[axes]` where they do not. To fly them,
    `jq.evaluate(members.plant, controller.told(members.inertia_told), members.flight(scenario),
    delay=members.delay, drive=members.drive, encoder=members.encoder, dt=members.dt)`, under jit
    with `longest_delay=members.longest_delay`.
    """

    plant: DecoupledAxes | Multirotor
    delay: Float[Array, " members"]  # s, of the command
    inertia_told: Float[Array, "axes members"]  # kg m^2, what a scheduled controller is told
    keys: Key[Array, " members"]  # of what happens to each in flight
    noise: Float[Array, "axes members"] | None = None  # rad, standard deviation
    gust: Float[Array, "axes members"] | None = None  # N m, standard deviation
    payload: Carried | None = None
    drive: Drive | None = None
    encoder: Encoder | None = None
    longest_delay: float = eqx.field(static=True, default=0.0)  # s, that any draw can have
    gust_corner: float = eqx.field(static=True, default=2.0)  # rad/s
    dt: float = eqx.field(static=True, default=0.002)  # s

    @property
    def size(self) -> int:
        """How many there are."""
        return self.inertia_told.shape[-1]

    @property
    def axes(self) -> int:
        """Of the plant."""
        return self.inertia_told.shape[0]

    def take(self, indices: ArrayLike | Sequence[Any]) -> "Members":
        """Some of the members, with the noise that is theirs. Raises ValueError for others."""
        return _picked(self, _places(indices, self.size))

    def flight(self, scenario: Scenario) -> Scenario:
        """The scenario with each member's own noise, gusts and payload on top of what it holds.

        The same member draws the same numbers in every flight of the same length, whatever others
        fly with it. Raises ValueError for a scenario of other axes, or of another ensemble.
        """
        count = self._checked(scenario)
        added = self._drawn(count)
        parts = {name: _total(getattr(scenario, name), x) for name, x in added.items()}
        where = lambda s: [getattr(s, name) for name in parts]
        return eqx.tree_at(where, scenario, list(parts.values()), is_leaf=lambda x: x is None)

    def _checked(self, scenario: Scenario) -> int:
        samples, axes = scenario.reference.shape[:2]
        if axes != self.axes:
            raise ValueError(
                f"the scenario is for {axes} axes, but the members have {self.axes}: give a "
                f"scenario with axes={self.axes}"
            )
        if scenario.ensemble not in ((), (1,), (self.size,)):
            raise ValueError(
                f"the scenario is for an ensemble of {scenario.ensemble}, but there are "
                f"{self.size} members: give a scenario for one loop, or for as many"
            )
        return samples

    def _drawn(self, samples: int) -> dict[str, Float[Array, "samples axes members"]]:
        shape, drawn = (samples, self.axes), {}
        if self.noise is not None:
            drawn["noise"] = _white(self.keys, shape).astype(self.noise.dtype) * self.noise[None]
        if self.gust is not None:
            unit = _gusts(self.keys, shape, self.gust_corner, self.dt)
            drawn["disturbance"] = unit.astype(self.gust.dtype) * self.gust[None]
        if self.payload is not None:
            drawn["payload"] = self.payload.signal(samples, self.dt)
        return drawn


_VECTORS = {"inertia", "torque_gain", "lag", "damping", "stiffness", "coulomb", "limit"}
_SHARED = 99  # an array that no member has for itself


def _own_rank(path: Any) -> int:
    """Dimensions that the array at a path has without an axis of members."""
    room, *_, name = [getattr(entry, "name", "") for entry in (*path, *path)]
    if room == "encoder" or (room == "drive" and name != "limit"):
        return _SHARED
    return 1 if room in ("plant", "drive") and name in _VECTORS else 0


@eqx.filter_jit
def _picked(members: Members, places: Int[Array, " some"]) -> Members:
    held, rest = eqx.partition(members, eqx.is_array)

    def chosen(path: Any, x: Array) -> Array:
        return x[..., places] if x.ndim > _own_rank(path) else x

    return eqx.combine(jax.tree_util.tree_map_with_path(chosen, held), rest)


def _places(indices: ArrayLike | Sequence[Any], size: int) -> Array:
    places = jnp.asarray(indices)
    if places.ndim != 1 or not jnp.issubdtype(places.dtype, jnp.integer) or not places.size:
        raise ValueError(f"indices are {indices}: give a row of whole numbers, one or more")
    if is_concrete(places) and not np.all((np.asarray(places) >= 0) & (np.asarray(places) < size)):
        raise ValueError(f"indices are {indices}, but the {size} members are 0 to {size - 1}")
    return places


@eqx.filter_jit
def _white(keys: Key[Array, " members"], shape: tuple[int, int]) -> Array:
    # In single precision, so that float32 and float64 fly through the same noise.
    draw = lambda key: jax.random.normal(jax.random.fold_in(key, 0), shape, jnp.float32)
    return jax.vmap(draw, out_axes=-1)(keys)


@eqx.filter_jit
def _gusts(keys: Key[Array, " members"], shape: tuple[int, int], corner: float, dt: float) -> Array:
    def draw(key: Key[Array, ""]) -> Array:
        return gauss_markov(jax.random.fold_in(key, 1), shape, deviation=1.0, corner=corner, dt=dt)

    return jax.vmap(draw, out_axes=-1)(keys)


def _total(given: Array | None, own: Float[Array, "samples axes members"]) -> Array:
    if given is None:
        return own
    return given.reshape(given.shape[:2] + (given.shape[2:] or (1,))) + own.astype(given.dtype)
