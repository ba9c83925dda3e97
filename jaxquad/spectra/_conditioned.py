"""One window length: responses by instrument, conditioned on the other inputs (CIFER's MISOSA)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


Inputs = Complex[Array, "frequencies windows inputs"]
Outputs = Complex[Array, "frequencies windows outputs"]
_TINY = 1e-300


class Conditioned(NamedTuple):
    """Responses of one window length, and the spectra of each pair without the other inputs."""

    response: Complex[Array, "*groups frequencies outputs inputs"]
    effect: Complex[Array, "*groups frequencies inputs windows"]  # of noise in the windows
    power: Float[Array, "*groups frequencies inputs"]  # of an input that no other input explains
    alone: Float[Array, "*groups frequencies inputs"]  # the share of its power that this is
    answer: Float[Array, "*groups frequencies outputs inputs"]  # output without the other inputs
    coherence: Float[Array, "*groups frequencies outputs inputs"]  # partial
    moved: Float[Array, "*groups frequencies inputs"]  # share of an input that instruments move
    multiple: Float[Array, "*groups frequencies outputs"]  # coherence of the output with all inputs


def condition(z: Inputs, x: Inputs, y: Outputs, count: Float[Array, ""]) -> Conditioned:
    """`(Z* X)^-1 Z* Y` with inputs x, outputs y and instruments z, which are x if there are none.

    `count` windows are averaged; more may stand there as zeros. With two inputs and z = x, this
    is the closed form of the textbook. Source: Bendat & Piersol, ch. 7; Tischler & Remple, ch. 9.
    """
    effect = _inverse(_cross(z, x)) @ jnp.conj(jnp.swapaxes(z, 1, 2))
    response = jnp.swapaxes(effect @ y, 1, 2)
    # The inverse power of what the instruments move of the inputs.
    inverted = effect @ jnp.conj(jnp.swapaxes(effect, 1, 2))
    moving = _inverse(inverted)
    power = 1 / jnp.maximum(_diagonal(inverted), _TINY)
    explained = jnp.real(jnp.sum(jnp.conj(response) * (response @ jnp.swapaxes(moving, 1, 2)), 2))
    total = jnp.sum(jnp.abs(y) ** 2, axis=1)
    own = jnp.abs(response) ** 2 * power[:, None, :]
    rest = jnp.maximum(total - explained, 0.0)
    answer = rest[:, :, None] + own
    whole = jnp.sum(jnp.abs(x) ** 2, axis=1)
    return Conditioned(
        response,
        effect,
        power / count,
        power / jnp.maximum(_diagonal(moving), _TINY),
        answer / count,
        own / jnp.maximum(answer, _TINY),
        jnp.minimum(_diagonal(moving) / jnp.maximum(whole, _TINY), 1.0),
        jnp.clip(1 - rest / jnp.maximum(total, _TINY), 0.0, 1.0),
    )


def _inverse(
    matrix: Complex[Array, "frequencies inputs inputs"],
) -> Complex[Array, "frequencies inputs inputs"]:
    # One input needs no factorisation, which would double the time to compile.
    return 1 / matrix if matrix.shape[1] == 1 else jnp.linalg.inv(matrix)


def _cross(a: Inputs, b: Inputs) -> Complex[Array, "frequencies inputs inputs"]:
    return jnp.conj(jnp.swapaxes(a, 1, 2)) @ b


def _diagonal(
    matrix: Complex[Array, "frequencies inputs inputs"],
) -> Float[Array, "frequencies inputs"]:
    return jnp.real(jnp.diagonal(matrix, axis1=1, axis2=2))
