"""Long linear recursions in two short loops: over a chunk's samples, then over the chunks."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._discretise import dot


def recursion(
    A: Float[Array, "states states"], drive: Float[Array, "samples states"]
) -> Float[Array, "samples states"]:
    """x[k] of x[k+1] = A x[k] + drive[k], from x[0] = 0."""
    samples, states = drive.shape
    length = _chunk(samples)
    chunks = -(-samples // length)
    padded = jnp.pad(drive, ((0, chunks * length - samples), (0, 0)))
    by_place = jnp.swapaxes(padded.reshape(chunks, length, states), 0, 1)

    def sample(x, w):
        return dot(x, A.T) + w, x

    ends, within = jax.lax.scan(sample, jnp.zeros((chunks, states), drive.dtype), by_place)
    steps, over = powers(A, length)
    starts = jax.lax.scan(lambda x, w: (dot(over, x) + w, x), jnp.zeros_like(ends[0]), ends)[1]
    carried = jnp.einsum("lij,cj->lci", steps, starts, precision="highest")
    return jnp.swapaxes(within + carried, 0, 1).reshape(chunks * length, states)[:samples]


def free_motion(
    rows: Float[Array, "outputs states"], A: Float[Array, "states states"], samples: int
) -> Float[Array, "samples outputs states"]:
    """`rows` A^k for each sample k."""
    length = _chunk(samples)
    steps, over = powers(A, length)
    chunks = powers(over, -(-samples // length))[0]
    starts = jnp.einsum("oi,cij->coj", rows, chunks, precision="highest")
    found = jnp.einsum("coi,lij->cloj", starts, steps, precision="highest")
    return found.reshape(len(chunks) * length, *rows.shape)[:samples]


def powers(
    A: Float[Array, "states states"], count: int
) -> tuple[Float[Array, "count states states"], Float[Array, "states states"]]:
    """A^0 to A^(count - 1), and A^count."""
    one = jnp.eye(len(A), dtype=A.dtype)
    last, found = jax.lax.scan(lambda P, _: (dot(A, P), P), one, length=count)
    return found, last


def _chunk(samples: int) -> int:
    return max(1, round(samples**0.5))
