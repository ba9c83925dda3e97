"""Controllers whose gains follow from an inertia that they are given."""

import dataclasses
import functools as ft
from collections.abc import Callable, Collection

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from jaxquad._compile import hasty_options, Jit
from jaxquad._core import as_float, ensemble_shape, multiply_gains, require_positive, signal_shape

from ._ladrc import LADRC
from ._pid import PID
from ._protocols import Transform, Tunable


InertiaToGain = Callable[[Array], Array]  # kg m^2 to b0 in rad/s^2 per unit of command


class ScheduledLADRC(eqx.Module):
    """A `LADRC` whose b0 is `map(inertia)` of an inertia in kg m^2 that it is given.

    The `ladrc`'s own b0 has no effect. A loop flies and analyses `scheduled_at(inertia)`; exported
    to C, the controller is given its inertia in flight. Source: Eq. (25) of docs/equations.md, with
    the map of docs/control.md.

    **Arguments:**

    - `ladrc`: the `LADRC` at any b0.
    - `map`: from the inertia in kg m^2 to b0, such as a `jq.control.InertiaMap`.
    """

    ladrc: LADRC
    map: InertiaToGain

    @property
    def dt(self) -> float:
        return self.ladrc.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all gains, () for one controller."""
        return ensemble_shape(self)

    def scheduled_at(self, inertia: Float[ArrayLike, "..."]) -> LADRC:
        """The LADRC at this `inertia`, with b0 fixed.

        **Arguments:**

        - `inertia`: in kg m^2, one value per axis, or `[axes, *ensemble]`.

        **Raises:**

        - `ValueError`: the inertia is not above 0, or does not fit the axes of the map.
        """
        return dataclasses.replace(self.ladrc, b0=gain_at(self.map, inertia))

    def tunable(self) -> dict[str, Transform | None]:
        """The bandwidths of the `ladrc` and what its map says."""
        return tunable_bandwidths("ladrc", self.ladrc) | tunable_of("map", self.map)

    def observer_instability(self) -> str:
        """As `LADRC.observer_instability`."""
        return self.ladrc.observer_instability()

    def observer_slowness(self) -> str:
        """As `LADRC.observer_slowness`."""
        return self.ladrc.observer_slowness()

    def observer_barrier(self, free: Collection[str]) -> Float[Array, ""]:
        """As `LADRC.observer_barrier`."""
        return self.ladrc.observer_barrier(names_within("ladrc", free))


class ScheduledPID(eqx.Module):
    """A `PID` of the acceleration: its gains are divided by `map(inertia)`, as a LADRC's by b0.

    kp, ki and kd of `pid` are those of b u, in rad/s^2 per rad, per rad s and per rad/s; its
    feedforward is the share of the reference's acceleration, 1 for all of it. Filters, weights,
    limit and anti-windup do not change. A loop flies and analyses `scheduled_at(inertia)`.

    **Arguments:**

    - `pid`: the `PID` of the acceleration.
    - `map`: from the inertia in kg m^2 to b0, such as a `jq.control.InertiaMap`.
    """

    pid: PID
    map: InertiaToGain

    @property
    def dt(self) -> float:
        return self.pid.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all gains, () for one controller."""
        return ensemble_shape(self)

    def scheduled_at(self, inertia: Float[ArrayLike, "..."]) -> PID:
        """The PID at this `inertia`, with its gains fixed.

        **Arguments:**

        - `inertia`: in kg m^2, one value per axis, or `[axes, *ensemble]`.

        **Raises:**

        - `ValueError`: the inertia is not above 0, or does not fit the axes of the map.
        """
        per_gain, pid = 1 / gain_at(self.map, inertia), self.pid
        return dataclasses.replace(
            pid, kp=multiply_gains(pid.kp, per_gain), ki=multiply_gains(pid.ki, per_gain),
            kd=multiply_gains(pid.kd, per_gain),
            feedforward=multiply_gains(pid.feedforward, per_gain),
        )  # fmt: skip

    def tunable(self) -> dict[str, Transform | None]:
        """What the `pid` and its map say, but not kd where the map is tuned.

        The size of the map and that of all gains are one number; kd fixes it.
        """
        gains, of_map = tunable_of("pid", self.pid), tunable_of("map", self.map)
        return {name: x for name, x in gains.items() if name != "pid.kd" or not of_map} | of_map


def gain_at(map: InertiaToGain, inertia: Float[ArrayLike, "..."]) -> Array:
    """b0 at an inertia in kg m^2, for all the members of `map` and `inertia`."""
    inertia = as_float(inertia)
    require_positive("inertia", inertia, "give kg m^2")
    if inertia.ndim == 0:
        raise ValueError(f"inertia is {inertia}: give one value per axis, in kg m^2.")
    shape = signal_shape(inertia, ensemble_shape(map))
    wide = inertia.reshape(inertia.shape + (1,) * (len(shape) - inertia.ndim))
    return as_float(_evaluate_map(map, wide, shape))


@ft.partial(Jit, options=hasty_options)  # a tune evaluates it for each ensemble that it draws
def _evaluate_map(
    map: InertiaToGain, inertia: Float[Array, "..."], shape: tuple[int, ...]
) -> Array:
    return map(jnp.broadcast_to(inertia, shape))


def tunable_of(owner: str, part: object) -> dict[str, Transform | None]:
    """What `part` says, named as seen from the controller whose field `owner` it is."""
    found = part.tunable() if isinstance(part, Tunable) else {}
    return {f"{owner}.{name}": transform for name, transform in found.items()}


def tunable_bandwidths(owner: str, ladrc: object) -> dict[str, Transform | None]:
    """What a LADRC says, without its b0, which a map gives."""
    return {k: x for k, x in tunable_of(owner, ladrc).items() if k != f"{owner}.b0"}


def names_within(owner: str, names: Collection[str]) -> list[str]:
    """The names of what is in the field `owner`, as seen from there."""
    return [name.removeprefix(f"{owner}.") for name in names if name.startswith(f"{owner}.")]
