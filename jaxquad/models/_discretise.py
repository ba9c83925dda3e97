"""Exact steps of a linear model, with late inputs, over a sample or a part of one."""

import jax
import jax.numpy as jnp
from jax.scipy.linalg import expm
from jaxtyping import Array, Float, Int


_WHOLE = 1e-9  # samples; a delay this close to whole samples is whole, whatever the rounding


def split_delay(
    delay: Float[Array, "*n"], dt: float
) -> tuple[Int[Array, "*n"], Float[Array, "*n"]]:
    """Whole samples of a delay in s, and the rest in samples; differentiable through the rest."""
    shift = jax.lax.stop_gradient(jnp.floor(delay / dt + _WHOLE))
    return shift.astype(int), delay / dt - shift


def propagation(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    late: Float[Array, " inputs"],
    span: Float[Array, ""],
    dt: float,
) -> tuple[Float[Array, "states states"], Float[Array, "segments states"]]:
    """What the first `span` samples of a sample `dt` s long make of the state and of the inputs.

    Each input goes over from one straight segment to the next after `late` samples. The second
    result acts on value and change over a whole sample of the old and of the new segment, input by
    input. A may be singular.
    """
    over = lambda b, late: _crossing(A, b[:, None], late, span, dt)
    transition, drive = jax.vmap(over, in_axes=(1, 0))(B, late)
    return transition[0], jnp.swapaxes(drive, 1, 2).reshape(4 * len(late), len(A))


def _crossing(A, b, late, span, dt):
    old = jnp.minimum(late, span)
    new = span - old
    zero, one = jnp.zeros_like(late), jnp.ones_like(late)
    # From value and change of a segment to those over the part of it that acts.
    last = jnp.stack([jnp.stack([one, 1 - late]), jnp.stack([zero, old])])
    first = jnp.stack([jnp.stack([one, zero]), jnp.stack([zero, new])])
    (before, of_old), (after, of_new) = (_propagate(A, b, part * dt) for part in (old, new))
    drive = [dot(after, dot(of_old, last)), dot(of_new, first)]
    return dot(after, before), jnp.concatenate(drive, axis=1)


def _propagate(
    A: Float[Array, "states states"], B: Float[Array, "states 1"], time: Float[Array, ""]
) -> tuple[Float[Array, "states states"], Float[Array, "states 2"]]:
    # Van Loan's augmented exponential; the second part acts on value and change over `time`.
    states = len(A)
    plant = jnp.pad(jnp.concatenate([A, B], axis=1) * time, ((0, 0), (0, 1)))
    line = jnp.eye(2, states + 2, k=states + 1, dtype=A.dtype)
    step = expm(jnp.concatenate([plant, line]))[:states]
    return step[:, :states], step[:, states:]


def at_delay(
    segments: Float[Array, "samples 2"], delay: Float[Array, ""], dt: float
) -> Float[Array, " samples"]:
    """The input itself, `delay` s late, at the samples; where it jumps, the value just after."""
    shift, late = split_delay(delay, dt)
    old, new = shifted(segments, shift + 1), shifted(segments, shift)
    return jnp.where(late <= _WHOLE, new[:, 0], old[:, 0] + (1 - late) * old[:, 1])


def shifted(
    x: Float[Array, "samples columns"], shift: Int[Array, ""]
) -> Float[Array, "samples columns"]:
    """`x` so many samples later, and zero before."""
    index = jnp.arange(len(x)) - shift
    return jnp.where(index[:, None] >= 0, x[jnp.maximum(index, 0)], 0)


def dot(a: Array, b: Array) -> Array:
    """The matrix product; a GPU would round float32 products to 10 bits."""
    return jnp.dot(a, b, precision="highest")
