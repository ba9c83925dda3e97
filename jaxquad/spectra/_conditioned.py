"""One window length: responses by instrument, conditioned on the other inputs (CIFER's MISOSA)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


_TINY = 1e-300


class Channels(NamedTuple):
    """How many channels are inputs, outputs and instruments; without instruments, inputs serve."""

    inputs: int
    outputs: int
    instruments: int

    def split(self, rows: Array) -> tuple[Array, Array, Array]:
        """Instruments, inputs and outputs along the last axis."""
        n, m = self.inputs, self.inputs + self.outputs
        x = rows[..., :n]
        return (rows[..., m : m + n] if self.instruments else x), x, rows[..., n:m]


class Conditioned(NamedTuple):
    """Responses of one window length, and the spectra of each pair without the other inputs."""

    response: Complex[Array, "*groups frequencies outputs inputs"]
    solver: Complex[Array, "*groups frequencies inputs inputs"]  # (Z* X)^-1
    power: Float[Array, "*groups frequencies inputs"]  # of an input that no other input explains
    alone: Float[Array, "*groups frequencies inputs"]  # the share of its power that this is
    answer: Float[Array, "*groups frequencies outputs inputs"]  # output without the other inputs
    coherence: Float[Array, "*groups frequencies outputs inputs"]  # partial
    moved: Float[Array, "*groups frequencies inputs"]  # share of an input that instruments move
    multiple: Float[Array, "*groups frequencies outputs"]  # coherence of the output with all inputs


def condition(
    products: Complex[Array, "frequencies channels channels"],
    channels: Channels,
    count: Float[Array, ""],
) -> Conditioned:
    """`(Z* X)^-1 Z* Y` from the sums of `conj(a) b` over `count` windows.

    With two inputs and instruments z = x, this is the closed form of the textbook.
    Source: Bendat & Piersol, ch. 7; Tischler & Remple, ch. 9.
    """
    z, x, y = channels.split(jnp.arange(products.shape[1]))
    from_z = products[:, z]
    solver = _inverse(from_z[:, :, x])
    response = jnp.swapaxes(solver @ from_z[:, :, y], 1, 2)
    # The inverse power of what the instruments move of the inputs.
    inverted = solver @ from_z[:, :, z] @ jnp.conj(jnp.swapaxes(solver, 1, 2))
    moving = _inverse(inverted)
    power = 1 / jnp.maximum(_diagonal(inverted), _TINY)
    explained = jnp.real(jnp.sum(jnp.conj(response) * (response @ jnp.swapaxes(moving, 1, 2)), 2))
    whole = _diagonal(products)
    total = whole[:, y]
    own = jnp.abs(response) ** 2 * power[:, None, :]
    rest = jnp.maximum(total - explained, 0.0)
    answer = rest[:, :, None] + own
    return Conditioned(
        response,
        solver,
        power / count,
        power / jnp.maximum(_diagonal(moving), _TINY),
        answer / count,
        own / jnp.maximum(answer, _TINY),
        jnp.minimum(_diagonal(moving) / jnp.maximum(whole[:, x], _TINY), 1.0),
        jnp.clip(1 - rest / jnp.maximum(total, _TINY), 0.0, 1.0),
    )


def _inverse(
    matrix: Complex[Array, "frequencies inputs inputs"],
) -> Complex[Array, "frequencies inputs inputs"]:
    # One input needs no factorisation, which would double the time to compile.
    return 1 / matrix if matrix.shape[1] == 1 else jnp.linalg.inv(matrix)


def _diagonal(
    matrix: Complex[Array, "frequencies rows rows"],
) -> Float[Array, "frequencies rows"]:
    return jnp.real(jnp.diagonal(matrix, axis1=1, axis2=2))
