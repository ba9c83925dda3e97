"""One window length: responses by instrument, conditioned on the other inputs (CIFER's MISOSA)."""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Complex, Float


Inputs = Complex[Array, "frequencies windows inputs"]
Outputs = Complex[Array, "frequencies windows outputs"]
_TINY = 1e-300


class Conditioned(NamedTuple):
    """Responses of one window length, and the spectra of each pair without the other inputs."""

    response: Complex[Array, "frequencies outputs inputs"]
    effect: Complex[Array, "frequencies inputs windows"]  # of noise in the windows
    power: Float[Array, "frequencies inputs"]  # of each input that no other input explains
    alone: Float[Array, "frequencies inputs"]  # the share of its whole power that this is
    answer: Float[Array, "frequencies outputs inputs"]  # output power that no other input explains
    coherence: Float[Array, "frequencies outputs inputs"]  # partial
    moved: Float[Array, "frequencies inputs"]  # share of each input that the instruments move
    multiple: Float[Array, "frequencies outputs"]  # of the output with all inputs


def condition(z: Inputs, x: Inputs, y: Outputs) -> Conditioned:
    """`(Z* X)^-1 Z* Y` with inputs x, outputs y and instruments z, which are x if there are none.

    With two inputs and z = x, the conditioned response is that of the textbook's two-input closed
    form. Source: Bendat & Piersol, ch. 7; Tischler & Remple, ch. 9.
    """
    count = z.shape[1]
    effect = inverse(_cross(z, x)) @ jnp.conj(jnp.swapaxes(z, 1, 2))
    response = jnp.swapaxes(effect @ y, 1, 2)
    # The inverse power of what the instruments move of the inputs.
    inverted = effect @ jnp.conj(jnp.swapaxes(effect, 1, 2))
    moved = inverse(inverted)
    power = 1 / jnp.maximum(_diagonal(inverted), _TINY)
    explained = jnp.real(jnp.einsum("foi,fij,foj->fo", jnp.conj(response), moved, response))
    total = jnp.sum(jnp.abs(y) ** 2, axis=1)
    own = jnp.abs(response) ** 2 * power[:, None, :]
    rest = jnp.maximum(total - explained, 0.0)
    answer = rest[:, :, None] + own
    whole = jnp.sum(jnp.abs(x) ** 2, axis=1)
    by_instrument = _diagonal(moved) / jnp.maximum(whole, _TINY)
    return Conditioned(
        response,
        effect,
        power / count,
        power / jnp.maximum(_diagonal(moved), _TINY),
        answer / count,
        own / jnp.maximum(answer, _TINY),
        jnp.minimum(by_instrument, 1.0),
        jnp.clip(1 - rest / jnp.maximum(total, _TINY), 0.0, 1.0),
    )


def inverse(
    matrix: Complex[Array, "frequencies inputs inputs"],
) -> Complex[Array, "frequencies inputs inputs"]:
    """Inverse of small matrices; one input needs no factorisation."""
    if matrix.shape[1] == 1:
        return 1 / matrix
    return jnp.linalg.inv(matrix)


def _cross(a: Inputs, b: Inputs) -> Complex[Array, "frequencies inputs inputs"]:
    return jnp.conj(jnp.swapaxes(a, 1, 2)) @ b


def _diagonal(
    matrix: Complex[Array, "frequencies inputs inputs"],
) -> Float[Array, "frequencies inputs"]:
    return jnp.real(jnp.diagonal(matrix, axis1=1, axis2=2))
