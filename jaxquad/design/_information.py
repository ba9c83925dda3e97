"""What power at a frequency tells of the parameters."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

from jaxquad.identify._parameters import Parameters


Informations = Float[np.ndarray, "frequencies parameters parameters"]
_SINGULAR = 1e-12  # of a correlation matrix: beyond it, rounding decides


@eqx.filter_jit
def response_and_slopes(
    model: PyTree, parameters: Parameters, omega: Float[Array, " frequencies"], input: int
) -> tuple[Complex[Array, "frequencies outputs"], Complex[Array, "frequencies outputs parameters"]]:
    """The response to one input, and its derivatives with respect to relative changes."""

    def parts(z):
        response = parameters.insert(model, z).frequency_response(omega)
        if not 0 <= input < response.shape[2]:  # JAX would clamp it without a word.
            raise ValueError(f"input is {input}: the model has inputs 0 to {response.shape[2] - 1}")
        response = response[:, :, input]
        return jnp.stack([jnp.real(response), jnp.imag(response)])

    z = parameters.start[: parameters.count]
    value, slopes = parts(z), jax.jacfwd(parts)(z)
    return jax.lax.complex(value[0], value[1]), jax.lax.complex(slopes[0], slopes[1])


def information_per_energy(
    slopes: Complex[np.ndarray, "frequencies outputs parameters"],
    noise: Complex[np.ndarray, "frequencies outputs outputs"],
) -> Informations:
    """Fisher information of each frequency per unit of energy (mean square times seconds) there.

    2 Re(s^H S^-1 s) with the one-sided noise S. Source: Pintelon and Schoukens, System
    Identification, 2nd ed., section 5.4.2.
    """
    weighted = np.linalg.solve(noise, slopes)
    return 2 * np.real(np.conj(np.swapaxes(slopes, 1, 2)) @ weighted)


def check_distinct(
    total: Float[np.ndarray, "parameters parameters"], names: tuple[str, ...]
) -> None:
    """Raise ValueError where no excitation of these lines can tell the parameters apart."""
    size = np.sqrt(np.diagonal(total))
    for name, each in zip(names, size, strict=True):
        if not each > 0:
            raise ValueError(f"{name} does not change the response: leave it out of free=")
    values, vectors = np.linalg.eigh(total / np.outer(size, size))
    if values[0] < _SINGULAR * values[-1]:
        direction = vectors[:, 0]
        mixed = [n for n, x in zip(names, direction, strict=True) if abs(x) > 0.05]
        raise ValueError(
            f"no excitation at these lines can tell {', '.join(mixed)} apart: fix one of them "
            "(leave it out of free=), or offer more lines"
        )
