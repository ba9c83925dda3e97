from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Key

from jaxquad._core import is_concrete
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.simulation import Drive, Encoder, gauss_markov, Scenario

from ._distributions import as_law, Law, law_or_none


class Payload(eqx.Module):
    """Inertia that members pick up in flight `at` a time in s, for `width` s (None: to the end).

    `added` is in units of the plant's own inertia: 1.0 doubles it, a negative number sets down what
    was carried from the start. Each of the three is a number or a law, of which each member has its
    own draw; times are rounded to samples. The controller is not told.
    Raises ValueError for times before the start.
    """

    added: Law = eqx.field(converter=as_law)
    at: Law = eqx.field(converter=as_law, kw_only=True)  # s
    width: Law | None = eqx.field(converter=law_or_none, default=None, kw_only=True)  # s


class Carried(eqx.Module):
    """The payload of each member."""

    inertia: Float[Array, "axes members"]  # kg m^2
    at: Float[Array, " members"]  # s
    until: Float[Array, " members"]  # s
    latest: float = eqx.field(static=True)  # s, that `at` can be

    def signal(self, samples: int, dt: float) -> Float[Array, "samples axes members"]:
        """The added inertia in kg m^2, sample by sample.

        Raises ValueError for a payload that can come after the last sample.
        """
        if self.latest >= samples * dt:
            raise ValueError(
                f"a payload is picked up as late as {self.latest:.6g} s, but the scenario ends at "
                f"{samples * dt:.6g} s: lengthen it, or let Payload(at=...) be earlier"
            )
        index = jnp.arange(samples)[:, None]
        first, last = (jnp.round(t / dt)[None] for t in (self.at, self.until))
        index = index.astype(first.dtype)
        return jnp.where((index >= first) & (index < last), 1.0, 0.0)[:, None] * self.inertia[None]


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
