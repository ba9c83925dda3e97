"""What a model needs to be fitted, plotted and compared: one method."""

from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, PyTree

from jaxquad._core import as_float


Frequencies = ArrayLike | Sequence[float | int]  # rad/s


@runtime_checkable
class Model(Protocol):
    """A linear model, `jq.TransferFunction`, `jq.StateSpace` or a user's own `eqx.Module`.

    !!! example

        ```python
        class Integrator(eqx.Module):
            gain: float

            def frequency_response(self, omega):
                return self.gain / (1j * omega)

        fit = jq.fit(Integrator(2), frf)
        ```
    """

    def frequency_response(
        self, omega: Float[Array, " frequencies"]
    ) -> Complex[Array, "frequencies ..."]:
        """The response at `omega` in rad/s: (frequencies, outputs, inputs), outputs per inputs.

        A result of one axis, (frequencies,), stands for one input and one output.
        """
        ...


def evaluate_response(
    model: Model, omega: Float[Array, " frequencies"]
) -> Complex[Array, "frequencies outputs inputs"]:
    """`model.frequency_response(omega)` with axes for outputs and inputs, also where it has none.

    **Raises:**

    - `ValueError`: the result has neither one axis nor three.
    """
    response = jnp.asarray(model.frequency_response(omega))
    if response.ndim not in (1, 3):
        raise ValueError(
            f"{type(model).__name__}.frequency_response returned the shape {response.shape} for "
            f"{omega.size} frequencies: return (frequencies, outputs, inputs), or (frequencies,) "
            "for one input and one output."
        )
    return response[:, None, None] if response.ndim == 1 else response


def with_arrays(model: PyTree) -> PyTree:
    """`model` with every number in it as an array of floats, so that it can be free in a fit.

    Python's `float` and `int`, and arrays of whole numbers. What is no number to fit, such as an
    index or a count, belongs into a field of `eqx.field(static=True)`.
    """
    return jax.tree.map(lambda x: as_float(x) if _is_number(x) else x, model)


def _is_number(x: object) -> bool:
    """Whether JAX would not take it for a parameter, although it is a number."""
    if isinstance(x, np.ndarray | np.generic | jax.Array):
        return x.dtype.kind in "iu"
    return isinstance(x, int | float) and not isinstance(x, bool)


def as_frequencies(omega: Frequencies) -> Float[Array, " frequencies"]:
    """Frequencies as a row of floats; a number by itself is one frequency."""
    omega = as_floats(omega)
    return omega if omega.ndim else omega[None]


def as_floats(omega: Frequencies) -> Float[Array, "..."]:
    """Frequencies as an array of floats; floats keep their precision."""
    omega = jnp.asarray(omega)
    return omega if eqx.is_inexact_array(omega) else omega.astype(float)
