"""Growth and noise of a sampled system without its eigenvalues.

Values come from repeated squaring, derivatives from Lyapunov equations: only first ones exist.
"""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float


_SWEEPS = 6
_FADED = 20.0  # nepers, after which a sum over samples has no more to add
_ROUNDINGS = 100.0


class Powers(NamedTuple):
    """matrix^(2^k) = matrices[k] exp(logs[k]), without derivatives."""

    matrices: Float[Array, "powers states states"]
    logs: Float[Array, " powers"]


def sharpest(smoothing: float, dt: float, dtype: DTypeLike) -> float:
    """`smoothing` in 1/s, or what the rounding of a sample leaves of it."""
    return max(smoothing, _ROUNDINGS * float(jnp.finfo(dtype).eps) / dt)


def powers(matrix: Float[Array, "states states"], dt: float, smoothing: float) -> Powers:
    """Powers up to one in which modes that are `smoothing` in 1/s apart have parted."""
    count = max(1, math.ceil(math.log2(_FADED / (smoothing * dt))))
    size = lambda m: jnp.maximum(jnp.max(jnp.abs(m)), jnp.finfo(m.dtype).tiny)

    def square(carry, _):
        power, log = carry
        following = _dot(power, power)
        scale = size(following)
        return (following / scale, 2 * log + jnp.log(scale)), carry

    fixed = jax.lax.stop_gradient(matrix)
    start = (fixed / size(fixed), jnp.log(size(fixed)))
    last, earlier = jax.lax.scan(square, start, length=count)
    return Powers(*(jnp.concatenate([a, b[None]]) for a, b in zip(earlier, last, strict=True)))


def growth(ladder: Powers, dt: float) -> Float[Array, ""]:
    """ln |matrix^N| / (N dt) in 1/s for the highest power N.

    Never below the growth rate of the slowest mode, and above it by up to ln(N times the condition
    of the eigenvectors) / (N dt).
    """
    size = 0.5 * jnp.log(jnp.sum(ladder.matrices[-1] ** 2))
    return (ladder.logs[-1] + size) / (2.0 ** (len(ladder.logs) - 1) * dt)


def gramian(
    ladder: Powers, start: Float[Array, "states states"], shift: Float[Array, ""]
) -> Float[Array, "states states"]:
    """The sum over k of tame^k start tame'^k with tame = matrix exp(-shift): Smith's doubling."""

    def double(total, power):
        matrix, log = power
        return total + jnp.exp(2 * log) * _dot(_dot(matrix, total), matrix.T), None

    samples = jnp.exp2(jnp.arange(len(ladder.logs) - 1, dtype=start.dtype))
    logs = ladder.logs[:-1] - samples * shift
    return jax.lax.scan(double, start, (ladder.matrices[:-1], logs))[0]


def abscissa(
    matrix: Float[Array, "states states"], ladder: Powers, dt: float, smoothing: float
) -> Float[Array, ""]:
    """Growth rate of the slowest mode in 1/s, with derivatives that stay finite.

    With H(s) the sum over |matrix^k|^2 exp(-2 k s dt), 1 / H falls to 0 at that rate: a Newton step
    on it starts `smoothing` (1/s) above the `growth`, and the derivatives are those of the
    root of H(s) = H there. Both are exact for a single slowest mode or pair as the smoothing
    becomes small; of modes that coincide the value is above the rate by less than the smoothing.
    (The norm of matrix^N turns with the phase of complex modes: its own gradient is wrong.)
    Source: Vanbiervliet et al., The smoothed spectral abscissa for robust stability optimization,
    SIAM J. Optim. 20 (2009), for sampled time.
    """
    start = growth(ladder, dt) + smoothing
    unit, shift = jnp.eye(len(matrix), dtype=matrix.dtype), start * dt
    reachable, observable = gramian(ladder, unit, shift), gramian(_turned(ladder), unit, shift)
    tame = jnp.exp(-shift) * jax.lax.stop_gradient(matrix)
    pull = _dot(_dot(observable, tame), reachable)
    slope = jnp.sum(pull * tame) * dt
    moved = jnp.sum(pull * (jnp.exp(-shift) * matrix - tame)) / slope  # 0, with the derivative
    return start - 0.5 * jnp.trace(reachable) / slope + moved


def noise_gain(
    matrix: Float[Array, "states states"],
    noise: Float[Array, " states"],
    command: Float[Array, " states"],
    through: Float[Array, ""],
    ladder: Powers,
    shift: Float[Array, ""],
) -> Float[Array, ""]:
    """rms of command x + through n per rms of white n, a new value each sample.

    The state is x+ = tame x + noise n with tame = matrix exp(-shift), which is stable.
    """
    live = (jnp.exp(-shift) * matrix, noise, command, through)
    tame, entry, reading, direct = jax.lax.stop_gradient(live)
    reachable = gramian(ladder, jnp.outer(entry, entry), shift)
    observable = gramian(_turned(ladder), jnp.outer(reading, reading), shift)
    power = _dot(reading, _dot(reachable, reading)) + direct**2
    pulls = (
        _dot(_dot(observable, tame), reachable),
        _dot(observable, entry),
        _dot(reachable, reading),
        direct,
    )
    changes = (x - fixed for x, fixed in zip(live, (tame, entry, reading, direct), strict=True))
    moved = 2 * sum(jnp.sum(p * d) for p, d in zip(pulls, changes, strict=True))
    return jnp.sqrt(power) + moved / (2 * jnp.sqrt(jnp.where(power > 0, power, jnp.inf)))


def balance(matrix: Float[Array, "states states"]) -> Float[Array, " states"]:
    """Scales of the states for which rows and columns are of one size (Osborne)."""
    size = jax.lax.stop_gradient(jnp.abs(matrix)) * (1 - jnp.eye(len(matrix), dtype=matrix.dtype))
    scale = jnp.ones(len(matrix), matrix.dtype)
    for _ in range(_SWEEPS):
        now = size * scale[None] / scale[:, None]
        row, column = jnp.sum(now, axis=1), jnp.sum(now, axis=0)
        usable = (row > 0) & (column > 0)
        ratio = jnp.where(usable, row, 1.0) / jnp.where(usable, column, 1.0)
        scale = scale * ratio**0.25  # half of the step: all states move at once
    return scale


def _turned(ladder: Powers) -> Powers:
    return Powers(jnp.swapaxes(ladder.matrices, 1, 2), ladder.logs)


def _dot(a: Array, b: Array) -> Array:
    return jnp.dot(a, b, precision="highest")
