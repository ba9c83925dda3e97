"""Numbers of linear loops: only those that are wanted, of all axes of all members at once."""

from collections.abc import Collection, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ._closed_loop import close, ClosedLoopMatrix, join, OpenLoop
from ._linear_parts import linear_parts, LinearParts
from ._loop import Loop
from ._spectrum import abscissa, noise_gain, powers, sharpest
from .qualities._margins import margins
from .qualities._rejection import disturbance_rejection


_LOWEST, _BEYOND, _POINTS = 1e-5, 1.0005, 500  # of pi / dt; a crossing may lie at pi / dt itself
_SMOOTH_LOWEST, _SMOOTH_POINTS = 1e-4, 160  # of pi / dt, where the smooth peak of |S| is looked for
_STATIC = 1e-9  # a static gain margin below it is rounding: the loop integrates
_STABLE = 1.0  # 1/s, what an unstable loop is made to decay at where only its gradient must exist

MARGINS = ("gain_margin", "gain_reduction", "phase_margin", "crossover", "delay_margin")
REJECTION = ("sensitivity_peak", "sensitivity_frequency", "rejection_bandwidth")
NUMBERS = ("abscissa", "noise_gain", *MARGINS, *REJECTION)


def linear_numbers(
    loop: Loop,
    axes: Sequence[int],
    wanted: Collection[str],
    *,
    smoothing: float = 1e-5,
    smooth: bool = False,
) -> dict[str, Float[Array, " axes *ensemble"]]:
    """The `wanted` numbers of a `LoopAnalysis`, and the abscissa, of some axes of all members.

    With `smooth`, noise gain and sensitivity peak stay finite and differentiable in an unstable
    loop; the peak is then where a parabola through three neighbouring values of |1 + L|^2 is least.
    """
    parts, ensemble = linear_parts(loop, axes)
    numbers = jax.vmap(lambda one: _of_one(one, tuple(wanted), smoothing, smooth))(parts)
    return {name: x.reshape(len(axes), *ensemble) for name, x in numbers.items()}


def _of_one(
    parts: LinearParts, wanted: tuple[str, ...], smoothing: float, smooth: bool
) -> dict[str, Float[Array, ""]]:
    plant, controller = parts.sampled()
    closed = close(plant, controller, parts.memory).balanced()
    return numbers_of(join(plant, controller), closed, wanted, smoothing, smooth=smooth)


def numbers_of(
    loop: OpenLoop,
    closed: ClosedLoopMatrix,
    wanted: Collection[str],
    smoothing: float,
    *,
    smooth: bool = False,
) -> dict[str, Float[Array, ""]]:
    """The `wanted` numbers of one loop, and the abscissa; see `linear_numbers`."""
    smoothing = sharpest(smoothing, loop.dt, closed.matrix.dtype)
    ladder = powers(closed.matrix, loop.dt, smoothing)
    numbers = {"abscissa": abscissa(closed.matrix, ladder, loop.dt, smoothing)}
    rate = jax.lax.stop_gradient(numbers["abscissa"])
    stable = rate < 0
    if "noise_gain" in wanted:
        shift = jnp.where(stable, 0.0, (rate + _STABLE) * loop.dt)
        system = (closed.matrix, closed.noise, closed.command, closed.through)
        noise = noise_gain(*system, ladder, shift)
        numbers["noise_gain"] = noise if smooth else jnp.where(stable, noise, jnp.inf)
    if smooth and "sensitivity_peak" in wanted:
        numbers["sensitivity_peak"] = _smooth_peak(loop)
    if any(name in wanted for name in MARGINS):
        numbers |= _only(_margins(loop, stable), wanted)
    if any(name in wanted and name not in numbers for name in REJECTION):
        numbers = _only(_rejection(loop, stable), wanted) | numbers
    return numbers


def _only(numbers: dict[str, Array], wanted: Collection[str]) -> dict[str, Array]:
    return {name: x for name, x in numbers.items() if name in wanted}


def _grid(loop: OpenLoop) -> Float[Array, " points"]:
    # It holds all frequencies but 0: a crossing that is missing does not exist.
    grid = np.geomspace(_LOWEST, _BEYOND, _POINTS) * np.pi / loop.dt
    return jnp.asarray(grid, loop.shift.dtype)


def _margins(loop: OpenLoop, stable: Bool[Array, ""]) -> dict[str, Float[Array, ""]]:
    margin, static = margins(loop, omega=_grid(loop)), loop.static_gain_margin()
    up, down = _or(jnp.inf, margin.gain_margin), _or(0.0, margin.gain_reduction)
    falls = (static < 1) & (static > _STATIC)
    numbers = {
        "gain_margin": jnp.where(static >= 1, jnp.minimum(up, static), up),
        "gain_reduction": jnp.where(falls, jnp.maximum(down, static), down),
        "phase_margin": _or(jnp.inf, margin.phase_margin),
        "crossover": margin.crossover,
        "delay_margin": _or(jnp.inf, margin.delay_margin),
    }
    return {name: jnp.where(stable, value, jnp.nan) for name, value in numbers.items()}


def _rejection(loop: OpenLoop, stable: Bool[Array, ""]) -> dict[str, Float[Array, ""]]:
    rejection = disturbance_rejection(loop, omega=_grid(loop))
    return {
        "sensitivity_peak": jnp.where(stable, rejection.peak, jnp.inf),
        "sensitivity_frequency": jnp.where(stable, rejection.peak_frequency, jnp.nan),
        "rejection_bandwidth": jnp.where(stable, rejection.bandwidth, jnp.nan),
    }


def _or(missing: float, value: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(jnp.isnan(value), missing, value)


def _smooth_peak(loop: OpenLoop) -> Float[Array, ""]:
    grid = np.geomspace(_SMOOTH_LOWEST, 1.0, _SMOOTH_POINTS) * np.pi / loop.dt
    distance = 1 + loop.loop(jnp.asarray(grid, loop.shift.dtype))
    square = distance.real**2 + distance.imag**2  # about a sharp peak it is a parabola
    low, middle, high = square[:-2], square[1:-1], square[2:]
    slope, bend = 0.5 * (high - low), low - 2 * middle + high
    deepest = (middle <= low) & (middle <= high) & (bend > 0)
    drop = jnp.where(deepest, 0.5 * slope**2 / jnp.where(deepest, bend, 1.0), 0.0)
    least = jnp.maximum(middle - drop, 0.01 * middle)
    return 1 / jnp.sqrt(jnp.minimum(jnp.min(least), square[-1]))
