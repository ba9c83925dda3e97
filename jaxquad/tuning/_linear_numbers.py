"""What the linear loops of all members tell, only as far as it is wanted."""

import math
from collections.abc import Collection
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.control import LinearController
from jaxquad.loops import (
    abscissa,
    AxisParameters,
    close,
    join,
    loop_qualities,
    noise_gain,
    OpenLoop,
    powers,
    sampled,
    sharpest,
    without_idle_states,
)
from jaxquad.models import DecoupledAxes


_LOWEST, _POINTS = 1e-4, 160  # of pi / dt, of the grid on which the peak of |S| is looked for
_STABLE = 1.0  # 1/s, what an unstable loop is made to decay at where only its gradient must exist
_MARGINS = {"gain_margin", "gain_reduction", "phase_margin", "delay_margin"}


def linear_numbers(
    plant: DecoupledAxes,
    controller: Any,
    delay: Float[Array, " members"],
    *,
    longest: float,
    wanted: Collection[str],
    smoothing: float,
) -> dict[str, Float[Array, "axes members"]]:
    """The `wanted` numbers of every axis of every member, differentiable also where unstable.

    The peak of |S| is where a parabola through three neighbouring values of |1 + L|^2 is least.
    """
    axes, members = _shape(plant, controller, delay)
    laws = [_laws(controller, k, members) for k in range(axes)]
    laws = jax.tree.map(lambda *x: jnp.concatenate(x), *laws)
    one = lambda axis, delay, law: _numbers(axis, delay, law, longest, wanted, smoothing)
    found = jax.vmap(one)(_flat(plant, axes, members), jnp.tile(delay, axes), laws)
    return {name: x.reshape(axes, members) for name, x in found.items()}


def _shape(plant: DecoupledAxes, controller: Any, delay: Array) -> tuple[int, int]:
    gains = [x.shape[0] for x in jax.tree.leaves(controller) if getattr(x, "ndim", 0)]
    axes = plant.shape[0] if plant.shape[0] > 1 else max(gains, default=1)
    return axes, delay.shape[0]


def _laws(controller: Any, axis: int, members: int) -> LinearController:
    own = len(getattr(controller, "ensemble", ()))
    one = lambda i: without_idle_states(controller.linear(axis, (i,) if own else None))
    return jax.vmap(one)(jnp.arange(members))


def _flat(plant: DecoupledAxes, axes: int, members: int) -> AxisParameters:
    """All axes of all members in a row. Dry friction has no linear part."""

    def row(x: Any) -> Any:
        if x is None:
            return None
        wide = x if x.ndim > 1 else x[:, None]
        return jnp.broadcast_to(wide, (axes, members)).reshape(axes * members)

    names = AxisParameters._fields
    return AxisParameters(**{name: row(getattr(plant, name)) for name in names})


def _numbers(
    axis: AxisParameters,
    delay: Float[Array, ""],
    law: LinearController,
    longest: float,
    wanted: Collection[str],
    smoothing: float,
) -> dict[str, Float[Array, ""]]:
    dt = law.dt
    memory = math.floor(longest / dt + 1e-9) + 1 if longest > 0 else 0
    plant = sampled(axis, delay if memory else None, dt)
    closed = close(plant, law, memory).balanced()
    smoothing = sharpest(smoothing, dt, closed.matrix.dtype)
    ladder = powers(closed.matrix, dt, smoothing)
    found = {"abscissa": abscissa(closed.matrix, ladder, dt, smoothing)}
    rate = jax.lax.stop_gradient(found["abscissa"])
    if "noise_gain" in wanted:
        shift = jnp.where(rate < 0, 0.0, (rate + _STABLE) * dt)
        parts = (closed.matrix, closed.noise, closed.command, closed.through)
        found["noise_gain"] = noise_gain(*parts, ladder, shift)
    loop = join(plant, law)
    if "sensitivity_peak" in wanted:
        found["sensitivity_peak"] = _peak(loop)
    if _MARGINS & set(wanted):
        told = loop_qualities(loop, rate < 0)
        found |= {name: told[name] for name in _MARGINS & set(wanted)}
    return found


def _peak(loop: OpenLoop) -> Float[Array, ""]:
    grid = np.geomspace(_LOWEST, 1.0, _POINTS) * np.pi / loop.dt
    away = 1 + loop.loop(jnp.asarray(grid, loop.shift.dtype))
    square = away.real**2 + away.imag**2  # about a sharp peak it is a parabola
    low, middle, high = square[:-2], square[1:-1], square[2:]
    slope, bend = 0.5 * (high - low), low - 2 * middle + high
    deepest = (middle <= low) & (middle <= high) & (bend > 0)
    drop = jnp.where(deepest, 0.5 * slope**2 / jnp.where(deepest, bend, 1.0), 0.0)
    least = jnp.maximum(middle - drop, 0.01 * middle)
    return 1 / jnp.sqrt(jnp.minimum(jnp.min(least), square[-1]))
