"""Difference equations over many samples, and a discrete model by its own."""

import functools as ft

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxquad._compile import brief_options, Jit

from ._convert import realise
from ._discrete import DiscreteTransferFunction
from ._state_space import dot


Square = Float[Array, "states states"]


@ft.partial(Jit, options=brief_options)
def simulate_samples(
    model: DiscreteTransferFunction, u: Float[Array, " samples"]
) -> Float[Array, " samples"]:
    A, B, C, D = realise(model)
    late = shift_samples(u[:, None], jnp.asarray(model.delay))
    return (dot(run_states(A, dot(late, B.T)), C.T) + dot(late, D.T))[:, 0]


@ft.partial(Jit, options=brief_options)
def free_samples(
    model: DiscreteTransferFunction, samples: int
) -> tuple[Float[Array, "samples 1 states"], Float[Array, "samples 1 states"]]:
    motion, states = free_motion(*step_with_bias(model), samples), model.denominator.size - 1
    return motion[:, :, :states], motion[:, :, states:]


def step_with_bias(
    model: DiscreteTransferFunction,
) -> tuple[Float[Array, "both both"], Float[Array, "1 both"]]:
    """Step of state and constant bias over a sample, and rows from these to the output."""
    A, _, C, _ = realise(model)
    one, none = jnp.eye(len(A), dtype=A.dtype), jnp.zeros_like(A)
    step = jnp.concatenate([jnp.concatenate([A, one], 1), jnp.concatenate([none, one], 1)])
    return step, jnp.concatenate([C, jnp.zeros_like(C)], axis=1)


def run_states(
    step: Square, pushed: Float[Array, "samples states"]
) -> Float[Array, "samples states"]:
    """x[k] of x[k+1] = step x[k] + pushed[k], from x[0] = 0, by chunks."""
    samples, count = pushed.shape
    length = _chunk(samples)
    chunks = -(-samples // length)
    padded = jnp.pad(pushed, ((0, chunks * length - samples), (0, 0)))
    by_place = jnp.swapaxes(padded.reshape(chunks, length, count), 0, 1)
    advance = lambda x, w: (dot(x, step.T) + w, x)
    ends, within = jax.lax.scan(advance, jnp.zeros((chunks, count), pushed.dtype), by_place)
    steps, over = _powers(step, length)
    starts = jax.lax.scan(lambda x, w: (dot(over, x) + w, x), jnp.zeros_like(ends[0]), ends)[1]
    carried = jnp.einsum("lij,cj->lci", steps, starts, precision="highest")
    return jnp.swapaxes(within + carried, 0, 1).reshape(chunks * length, count)[:samples]


def free_motion(
    step: Square, rows: Float[Array, "outputs both"], samples: int
) -> Float[Array, "samples outputs both"]:
    """`rows` step^k for each sample k, from powers of powers."""
    length = _chunk(samples)
    steps, over = _powers(step, length)
    chunks = _powers(over, -(-samples // length))[0]
    starts = jnp.einsum("oi,cij->coj", rows, chunks, precision="highest")
    motion = jnp.einsum("coi,lij->cloj", starts, steps, precision="highest")
    return motion.reshape(len(chunks) * length, *rows.shape)[:samples]


def shift_samples(
    x: Float[Array, "samples columns"], shift: Int[Array, ""]
) -> Float[Array, "samples columns"]:
    """`x` so many samples later, and zero before."""
    index = jnp.arange(len(x)) - shift
    return jnp.where(index[:, None] >= 0, x[jnp.maximum(index, 0)], 0)


def _powers(A: Square, count: int) -> tuple[Float[Array, "count states states"], Square]:
    """A^0 to A^(count - 1), and A^count."""
    one = jnp.eye(len(A), dtype=A.dtype)
    last, below = jax.lax.scan(lambda P, _: (dot(A, P), P), one, length=count)
    return below, last


def _chunk(samples: int) -> int:
    return max(1, round(samples**0.5))
