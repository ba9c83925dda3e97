from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

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

from ._response import Matrices, response
from ._transfer_function import as_frequencies, Convertible, Frequencies


Realisation = tuple[
    Float[Array, "states states"],
    Float[Array, "states inputs"],
    Float[Array, "outputs states"],
    Float[Array, "outputs inputs"],
]


class StateSpace(Convertible):
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

    **Raises:** `ValueError`: the shapes do not fit together, a value is not finite, a delay is
    negative, M is singular, or a name stands for no entry.
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
        converter=lambda names: tuple(dict(names).items()), default=(), static=True
    )

    def __check_init__(self):
        F, G, H0 = self.F, self.G, self.H0
        if F.ndim != 2 or F.shape[0] != F.shape[1] or not F.size:
            raise ValueError(f"F has shape {F.shape}: give a square matrix of one row per state.")
        if G.ndim != 2 or H0.ndim != 2 or not G.shape[1] or not H0.shape[0]:
            raise ValueError(
                f"G has shape {G.shape} and H0 {H0.shape}: give matrices, a column of G per input "
                "and a row of H0 per output."
            )
        (states, inputs), outputs = (len(F), G.shape[1]), len(H0)
        shapes = {
            "F": (states, states), "G": (states, inputs), "H0": (outputs, states),
            "H1": (outputs, states), "M": (states, states),
            "input_delay": (inputs,), "output_delay": (outputs,),
        }  # fmt: skip
        arrays = {name: x for name in shapes if (x := getattr(self, name)) is not None}
        for name, shape in shapes.items():
            if name in arrays and arrays[name].shape != shape:
                raise ValueError(
                    f"{name} has shape {arrays[name].shape}, but {states} states, {inputs} inputs "
                    f"and {outputs} outputs need {shape}: look at F, G and H0 too."
                )
        _check_names(self.names, arrays)
        for name, value in arrays.items():
            if name.endswith("delay"):
                require_nonnegative(name, value, "a model cannot answer before its input")
            else:
                require_finite(name, value)
        if self.M is not None and is_concrete(self.M):
            mass = np.asarray(self.M)
            rows = np.max(np.abs(mass), axis=1, keepdims=True)
            mass = mass / np.where(rows > 0, rows, 1)
            columns = np.max(np.abs(mass), axis=0, keepdims=True)
            mass = mass / np.where(columns > 0, columns, 1)
            if np.linalg.matrix_rank(mass) < len(mass):
                raise ValueError(
                    f"M is {self.M}, which is singular: its rows must determine the derivative of "
                    "each state. Eliminate states that have no differential equation."
                )

    def frequency_response(
        self, omega: Frequencies
    ) -> Complex[Array, "frequencies outputs inputs"]:
        """The response at `omega` in rad/s, outputs per inputs in their units.

        Infinite at a pole, to within rounding. Differentiable any number of times, in either mode.
        """
        return _evaluate(self, as_frequencies(omega))

    def select(self, outputs: Sequence[int], inputs: Sequence[int]) -> "StateSpace":
        """The model of some channels, by position and in the order given."""
        rows, columns = np.array(outputs, int), np.array(inputs, int)
        axes = {"G": 1, "H0": 0, "H1": 0, "input_delay": 0, "output_delay": 0}
        names = []
        for name, entry in self.names:  # where an entry is in the model that is left
            field, *index = entry.replace("]", "").split("[")
            place, axis = [int(i) for i in index], axes.get(field)
            if axis is not None:
                kept = list(inputs if field in ("G", "input_delay") else outputs)
                if place[axis] not in kept:
                    continue
                place[axis] = kept.index(place[axis])
            names.append((name, f"{field}{_index(place)}"))
        pick = lambda x, where: None if x is None else x[where]
        return StateSpace(
            F=self.F,
            G=self.G[:, columns],
            H0=self.H0[rows],
            H1=pick(self.H1, rows),
            M=self.M,
            input_delay=pick(self.input_delay, columns),
            output_delay=pick(self.output_delay, rows),
            names=names,
        )

    @property
    def poles(self) -> np.ndarray:
        """Eigenvalues of M^-1 F, rad/s; on the host, so not under jit."""
        return np.linalg.eigvals(_host(self)[0])

    @property
    def zeros(self) -> np.ndarray:
        """Transmission zeros of all channels together, rad/s; on the host, so not under jit.

        There the response from all inputs to all outputs loses rank. Those of one pair are the
        zeros of `select([output], [input])`. Zeros at infinity are taken out beforehand: an
        eigenvalue solver would scatter them over large finite values. Source: Emami-Naeini &
        Van Dooren, Automatica 18 (1982), p. 415.
        """
        A, B, C, D = _host(self)
        from scipy.linalg import matrix_balance

        # In units of states, inputs and outputs that make the numbers alike.
        (states, inputs), outputs = B.shape, len(C)
        loop = np.block(
            [
                [A, B, np.zeros((states, outputs))],
                [np.zeros((inputs, states + inputs)), np.ones((inputs, outputs))],
                [C, D, np.zeros((outputs, outputs))],
            ]
        )
        unit = np.asarray(matrix_balance(loop, permute=False, separate=True)[1][0])
        x, u, y = np.split(unit, [states, states + inputs])
        A, B, C, D = A * x / x[:, None], B * u / x[:, None], C * x / y[:, None], D * u / y[:, None]
        limit = _RANK * float(np.linalg.norm(np.block([[A, B], [C, D]])))
        A, B, C, D = _without_rows(A, B, C, D, limit)
        A, C, B, D = (part.T for part in _without_rows(A.T, C.T, B.T, D.T, limit))
        return np.linalg.eigvals(A - B @ np.linalg.solve(D, C))

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


def explicit(model: StateSpace) -> Realisation:
    """A, B, C, D of x' = A x + B u, y = C x + D u: the model without M, H1 and its delays."""
    A, B, C = model.F, model.G, model.H0
    if model.M is not None:
        rows = jnp.max(jnp.abs(model.M), axis=1, keepdims=True)
        solved = jnp.linalg.solve(model.M / rows, jnp.concatenate([A, B], axis=1) / rows)
        A, B = solved[:, : len(A)], solved[:, len(A) :]
    if model.H1 is None:
        return A, B, C, jnp.zeros((len(C), B.shape[1]), B.dtype)
    return A, B, C + dot(model.H1, A), dot(model.H1, B)


@eqx.filter_jit  # one call of many small operations is slow outside of it
def _evaluate(model: StateSpace, omega: Array) -> Array:
    matrices = Matrices(model.F, model.G, model.H0, model.H1, model.M, model.lateness)
    parts = response(matrices, omega)
    return jnp.moveaxis(jax.lax.complex(parts.real, parts.imag), -1, 0)


def _host(model: StateSpace) -> tuple[np.ndarray, ...]:
    return tuple(np.asarray(part) for part in explicit(model))


def _check_names(names: Sequence[tuple[str, str]], arrays: dict[str, Array]) -> None:
    if not names:
        return
    entries = {f"{k}{_index(i)}": k for k, x in arrays.items() for i in np.ndindex(x.shape)}
    for name, entry in names:
        if entry not in entries:
            shapes = ", ".join(f"{k} {x.shape}" for k, x in arrays.items())
            raise ValueError(
                f"names gives {name!r} to {entry!r}, which the model does not have: write an entry "
                f"as 'F[1][1]' or 'input_delay[0]', counted from 0. The model has {shapes}."
            )
        if name.split("[")[0] in arrays or not name:
            raise ValueError(f"The name {name!r} for {entry} is that of an array: choose another.")
    named = [entry for _, entry in names]
    twice = sorted({entry for entry in named if named.count(entry) > 1})
    if twice:
        raise ValueError(f"names gives {twice[0]} two names: give each entry one.")


def _index(place: Sequence[int]) -> str:
    return "".join(f"[{i}]" for i in place)


def dot(a: Array, b: Array) -> Array:
    """The matrix product; a GPU would round float32 products to 10 bits."""
    return jnp.dot(a, b, precision="highest")


_RANK = 1e-10  # of the norm, after balancing: below it a singular value is rounding


def _without_rows(A, B, C, D, limit):
    """The system with the same finite zeros whose D has independent rows."""
    while True:
        left, size, _ = np.linalg.svd(D)
        rank = int(np.sum(size > limit))
        C, D = left.T @ C, (left.T @ D)[:rank]
        free, bound = C[:rank], C[rank:]  # an output of 0 that no input reaches binds states
        if not bound.size:
            return A, B, free, D
        _, size, right = np.linalg.svd(bound)
        bound_count = int(np.sum(size > limit))
        if not bound_count:
            return A, B, free, D
        A, B, free = right @ A @ right.T, right @ B, free @ right.T
        C = np.vstack([A[:bound_count, bound_count:], free[:, bound_count:]])
        D = np.vstack([B[:bound_count], D])
        A, B = A[bound_count:, bound_count:], B[bound_count:]


@runtime_checkable
class HasPoles(Protocol):
    """A linear model."""

    @property
    def poles(self) -> np.ndarray: ...


class Mode(NamedTuple):
    """A real pole, or a pair of complex ones, of which the upper is named."""

    pole: complex  # rad/s
    frequency: float  # |pole|, rad/s
    damping: float  # - Re pole / |pole|; NaN for an integrator
    time_constant: float  # - 1 / Re pole, s; negative if unstable, infinite on the imaginary axis

    def __str__(self) -> str:
        if self.pole.imag:
            shape = f"zeta {self.damping:.3g}, omega {self.frequency:.4g} rad/s"
        else:
            shape = f"real, {self.pole.real:.4g} rad/s"
        return f"{shape}, time constant {self.time_constant:.4g} s"


def modes(model: HasPoles) -> tuple[Mode, ...]:
    """Frequency, damping and time constant of each mode of a linear model, slowest first.

    **Arguments:** `model`: has `poles` in rad/s. They are computed by NumPy, so not under jit.

    **Returns:** One `Mode` for each real pole and each pair of complex ones.
    """
    poles = [complex(pole) for pole in np.asarray(model.poles)]
    upper = [pole for pole in poles if pole.imag >= 0]
    result = []
    for pole in sorted(upper, key=lambda pole: (abs(pole), pole.real)):
        damping = -pole.real / abs(pole) if abs(pole) else float("nan")
        constant = -1 / pole.real if pole.real else float("inf")
        result.append(Mode(pole, abs(pole), damping, constant))
    return tuple(result)
