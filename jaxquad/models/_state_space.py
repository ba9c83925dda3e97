from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad._core import (
    as_float,
    as_float_or_none,
    is_concrete,
    require_finite,
    require_nonnegative,
)

from ._modes import transmission_zeros
from ._pade import check_order, Explicit, require_package, without_delays
from ._protocols import as_frequencies, Frequencies
from ._response import Matrices, response


if TYPE_CHECKING:
    import control
    import scipy.signal


def _as_pairs(
    names: Mapping[str, str] | Sequence[tuple[str, str]],
) -> tuple[tuple[str, str], ...]:
    return tuple(dict(names).items())


class StateSpace(eqx.Module):
    """M x' = F x + G u(t - input_delay), y(t + output_delay) = H0 x + H1 x': CIFER's DERIVID form.

    x' is the derivative that the delayed input causes, so H1 x' holds accelerations as they are
    measured. A term that is None is no parameter of a fit. In `free=` and in tables the entries are
    `F[0][1]`, `input_delay[0]`, or what `names` calls them.
    Source: Tischler & Remple, eq. 12.6 to 12.12; Eq. (11) and (29) of the paper.

    **Arguments:**

    - `F`: (states, states); `G`: (states, inputs); `H0`: (outputs, states).
    - `H1`: (outputs, states), or None for none; `M`: (states, states), or None for the unit matrix.
    - `input_delay`: (inputs,) in s; `output_delay`: (outputs,) in s; None for none.
    - `names`: of entries, as `{"Lp": "F[1][1]", "Lda": "G[1][0]"}`.

    **Raises:**

    - `ValueError`: the shapes do not fit together, a value is not finite, a delay is negative, M is
        singular, or a name stands for no entry.
    """

    F: Float[Array, "states states"] = eqx.field(converter=as_float)
    G: Float[Array, "states inputs"] = eqx.field(converter=as_float)
    H0: Float[Array, "outputs states"] = eqx.field(converter=as_float)
    H1: Float[Array, "outputs states"] | None = eqx.field(converter=as_float_or_none, default=None)
    M: Float[Array, "states states"] | None = eqx.field(converter=as_float_or_none, default=None)
    input_delay: Float[Array, " inputs"] | None = eqx.field(
        converter=as_float_or_none, default=None
    )  # s
    output_delay: Float[Array, " outputs"] | None = eqx.field(
        converter=as_float_or_none, default=None
    )  # s
    names: tuple[tuple[str, str], ...] = eqx.field(  # (name, entry)
        converter=_as_pairs, default=(), static=True
    )

    def __check_init__(self):
        _check_shapes(self)
        _check_names(self)
        for name, value in _arrays(self).items():
            if name.endswith("delay"):
                require_nonnegative(name, value, "a model cannot answer before its input")
            else:
                require_finite(name, value)
        _check_mass(self.M)

    def frequency_response(
        self, omega: Frequencies
    ) -> Complex[Array, "frequencies outputs inputs"]:
        """The response at `omega` in rad/s, outputs per inputs in their units.

        Infinite at a pole, to within rounding. Differentiable any number of times, in either mode.
        """
        return _frequency_response(self, as_frequencies(omega))

    def select(self, outputs: Sequence[int], inputs: Sequence[int]) -> "StateSpace":
        """The model of some channels, by position and in the order given."""
        rows, columns = np.array(outputs, int), np.array(inputs, int)
        moved = [(name, _select_entry(at, outputs, inputs)) for name, at in self.names]
        pick = lambda x, where: None if x is None else x[where]
        return StateSpace(
            F=self.F,
            G=self.G[:, columns],
            H0=self.H0[rows],
            H1=pick(self.H1, rows),
            M=self.M,
            input_delay=pick(self.input_delay, columns),
            output_delay=pick(self.output_delay, rows),
            names=[(name, entry) for name, entry in moved if entry],
        )

    def to_control(self, *, pade: int | None = None) -> "control.StateSpace":
        """The same model for python-control (extra `interop`): x' = A x + B u, y = C x + D u.

        **Arguments:**

        - `pade`: the order of the Pade approximations of the delays, 1 to 10; needed where there
            are delays. Each adds as many states.

        **Raises:**

        - `ValueError`: there is a delay, but no order.
        - `ImportError`: python-control is not installed.
        """
        return require_package("control").StateSpace(*_rational(self, pade))

    def to_scipy(self, *, pade: int | None = None) -> "scipy.signal.StateSpace":
        """The same model for scipy.signal, whose `lsim`, `step` and `bode` take it.

        **Arguments:**

        - `pade`: as in `to_control`.

        **Raises:**

        - `ValueError`: there is a delay, but no order.
        """
        return require_package("scipy.signal").StateSpace(*_rational(self, pade))

    @property
    def poles(self) -> np.ndarray:
        """Eigenvalues of M^-1 F, rad/s; on the host, so not under jit."""
        return np.linalg.eigvals(_host(self)[0])

    @property
    def zeros(self) -> np.ndarray:
        """Transmission zeros of all channels together, rad/s; on the host, so not under jit.

        Those of one pair are the zeros of `select([output], [input])`.
        """
        return transmission_zeros(*_host(self))

    @property
    def lateness(self) -> Float[Array, "outputs inputs"] | None:
        """Seconds from each input to each output; None without any delay."""
        by_input, by_output = self.input_delay, self.output_delay
        if by_input is None and by_output is None:
            return None
        shape = (self.H0.shape[0], self.G.shape[1])
        rows = jnp.zeros(shape[0], self.F.dtype) if by_output is None else by_output
        columns = jnp.zeros(shape[1], self.F.dtype) if by_input is None else by_input
        return rows[:, None] + columns[None]


def explicit(
    model: StateSpace,
) -> tuple[
    Float[Array, "states states"],
    Float[Array, "states inputs"],
    Float[Array, "outputs states"],
    Float[Array, "outputs inputs"],
]:
    """A, B, C, D of x' = A x + B u, y = C x + D u: the model without M, H1 and its delays."""
    A, B, C = model.F, model.G, model.H0
    if model.M is not None:
        rows = jnp.max(jnp.abs(model.M), axis=1, keepdims=True)
        solved = jnp.linalg.solve(model.M / rows, jnp.concatenate([A, B], axis=1) / rows)
        A, B = solved[:, : len(A)], solved[:, len(A) :]
    if model.H1 is None:
        return A, B, C, jnp.zeros((len(C), B.shape[1]), B.dtype)
    return A, B, C + _dot(model.H1, A), _dot(model.H1, B)


@eqx.filter_jit  # one call of many small operations is slow outside of it
def _frequency_response(model: StateSpace, omega: Array) -> Array:
    matrices = Matrices(model.F, model.G, model.H0, model.H1, model.M, model.lateness)
    parts = response(matrices, omega)
    return jnp.moveaxis(jax.lax.complex(parts.real, parts.imag), -1, 0)


def _host(model: StateSpace) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(part) for part in explicit(model))


def _rational(model: StateSpace, pade: int | None) -> Explicit:
    """The model on the host, its delays approximated."""
    plain = Explicit(*(np.asarray(part, float) for part in _host(model)))
    outputs, inputs = plain.D.shape
    late = lambda delay, n: np.zeros(n) if delay is None else np.asarray(delay, float)
    by_input, by_output = late(model.input_delay, inputs), late(model.output_delay, outputs)
    check_order(np.concatenate([by_input, by_output]), pade)
    return plain if pade is None else without_delays(plain, by_input, by_output, pade)


def _arrays(model: StateSpace) -> dict[str, Array]:
    """What is not left out, by name."""
    arrays = {
        "F": model.F, "G": model.G, "H0": model.H0, "H1": model.H1, "M": model.M,
        "input_delay": model.input_delay, "output_delay": model.output_delay,
    }  # fmt: skip
    return {name: x for name, x in arrays.items() if x is not None}


def _check_shapes(model: StateSpace) -> None:
    F, G, H0 = model.F, model.G, model.H0
    if F.ndim != 2 or F.shape[0] != F.shape[1] or not F.size:
        raise ValueError(f"F has shape {F.shape}: give a square matrix of one row per state.")
    if G.ndim != 2 or H0.ndim != 2 or not G.shape[1] or not H0.shape[0]:
        raise ValueError(
            f"G has shape {G.shape} and H0 {H0.shape}: give matrices, a column of G per input and "
            "a row of H0 per output."
        )
    (states, inputs), outputs = (len(F), G.shape[1]), len(H0)
    wanted = {
        "G": (states, inputs),
        "H0": (outputs, states),
        "H1": (outputs, states),
        "M": (states, states),
        "input_delay": (inputs,),
        "output_delay": (outputs,),
    }
    arrays = _arrays(model)
    for name, shape in wanted.items():
        if name in arrays and arrays[name].shape != shape:
            raise ValueError(
                f"{name} has shape {arrays[name].shape}, but {states} states, {inputs} inputs and "
                f"{outputs} outputs need {shape}: look at F, G and H0 too."
            )


def _check_names(model: StateSpace) -> None:
    if not model.names:
        return
    arrays = _arrays(model)
    entries = {f"{k}{_index(i)}": k for k, x in arrays.items() for i in np.ndindex(x.shape)}
    for name, entry in model.names:
        if entry not in entries:
            known = ", ".join(f"{k} {x.shape}" for k, x in arrays.items())
            raise ValueError(
                f"names gives {name!r} to {entry!r}, which the model does not have: write an entry "
                f"as 'F[1][1]' or 'input_delay[0]', counted from 0. The model has {known}."
            )
        if name.split("[")[0] in arrays or not name:
            raise ValueError(f"The name {name!r} for {entry} is that of an array: choose another.")
    named = [entry for _, entry in model.names]
    twice = sorted({entry for entry in named if named.count(entry) > 1})
    if twice:
        raise ValueError(f"names gives {twice[0]} two names: give each entry one.")


def _index(place: Sequence[int]) -> str:
    return "".join(f"[{i}]" for i in place)


def _select_entry(entry: str, outputs: Sequence[int], inputs: Sequence[int]) -> str:
    """Where an entry is after `StateSpace.select`; empty where it is left out."""
    field, *index = entry.replace("]", "").split("[")
    place = [int(i) for i in index]
    axis = {"G": 1, "H0": 0, "H1": 0, "input_delay": 0, "output_delay": 0}.get(field)
    if axis is None:
        return entry
    kept = inputs if field in ("G", "input_delay") else outputs
    if place[axis] not in kept:
        return ""
    place[axis] = list(kept).index(place[axis])
    return f"{field}{_index(place)}"


def _check_mass(M: Array | None) -> None:
    if M is None or not is_concrete(M):
        return
    mass = np.asarray(M)
    rows = np.max(np.abs(mass), axis=1, keepdims=True)
    mass = mass / np.where(rows > 0, rows, 1)
    columns = np.max(np.abs(mass), axis=0, keepdims=True)
    mass = mass / np.where(columns > 0, columns, 1)
    if np.linalg.matrix_rank(mass) < len(mass):
        raise ValueError(
            f"M is {M}, which is singular: its rows must determine the derivative of each state. "
            "Eliminate states that have no differential equation."
        )


def _dot(a: Array, b: Array) -> Array:
    return jnp.dot(a, b, precision="highest")
