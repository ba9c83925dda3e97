"""What a model needs to be fitted, plotted and compared, and the units of its numbers."""

import dataclasses
import re
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

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

    def is_number(x: object) -> bool:  # which JAX would not take for a parameter
        if isinstance(x, np.ndarray | np.generic | jax.Array):
            return x.dtype.kind in "iu"
        return isinstance(x, int | float) and not isinstance(x, bool)

    return jax.tree.map(lambda x: as_float(x) if is_number(x) else x, model)


def as_frequencies(omega: Frequencies) -> Float[Array, " frequencies"]:
    """Frequencies as a row of floats; a number by itself is one frequency."""
    omega = as_floats(omega)
    return omega if omega.ndim else omega[None]


def as_floats(omega: Frequencies) -> Float[Array, "..."]:
    """Frequencies as an array of floats; floats keep their precision."""
    omega = jnp.asarray(omega)
    return omega if eqx.is_inexact_array(omega) else omega.astype(float)


class Scale(NamedTuple):
    """The unit of a coefficient: (output unit / input unit) / s^power, or 1 / s^power alone."""

    power: int
    of_ratio: bool = True


Unit = str | Callable[[PyTree, int], Scale]  # by the model, and by the index within an array


def unit(declared: Unit) -> dict[str, Unit]:
    """The metadata of a field whose numbers have this unit."""
    return {"unit": declared}


OPTIONAL = {"optional": True}  # metadata of a field that is no term of the model while it is 0


_NAME = re.compile(r"([A-Za-z_][\w.]*)(?:\[(\d+)\])?.*")
_PER_SECOND = re.compile(r"(.*?)(?:/s(?:\^(\d+))?)?")


def parameter_units(
    model: PyTree, names: Sequence[str], *, output: str = "output", input: str = "input"
) -> tuple[str, ...]:
    """The units of numbers of a model, as its fields declare them.

    **Arguments:**

    - `model`: for instance `Fit.model`.
    - `names`: of its numbers, as `Fit.names`: `gain`, `numerator[0]`, `plant.lag`.
    - `output`, `input`: the units of the channels, or their names where those are not known.

    **Returns:** a text for each name, such as `rad/s^2 per N m`; empty where the model declares
    none.
    """
    units = []
    for name in names:
        owner, metadata = _declared(model, name)
        kind = metadata.get("unit", "")
        if not isinstance(kind, str):
            match = _NAME.fullmatch(name)
            power, of_ratio = kind(owner, int(match[2] or 0) if match else 0)
            if of_ratio:
                kind = f"{_over_seconds(output, power)} per {input}"
            else:
                kind = _over_seconds("1", power) if power else ""
        units.append(kind)
    return tuple(units)


def is_optional(model: PyTree, name: str) -> bool:
    """Whether a number of a model is no term of it while it is 0, as its field declares."""
    return bool(_declared(model, name)[1].get("optional"))


def _declared(model: PyTree, name: str) -> tuple[PyTree, Mapping]:
    """The part of a model that has a number, and the metadata of its field there."""
    match = _NAME.fullmatch(name)
    *owners, leaf = match[1].split(".") if match else ("",)
    for owner in owners:
        model = vars(model).get(owner) if dataclasses.is_dataclass(model) else None
    fields = dataclasses.fields(model) if dataclasses.is_dataclass(model) else ()
    return model, {field.name: field.metadata for field in fields}.get(leaf, {})


def _over_seconds(unit: str, power: int) -> str:
    """`rad/s` over s is `rad/s^2`."""
    match = _PER_SECOND.fullmatch(unit)
    if match and unit != match[1]:
        unit, power = match[1], power + int(match[2] or 1)
    return unit if power == 0 else f"{unit}/s" if power == 1 else f"{unit}/s^{power}"
