"""Models from others: realisations, and models of python-control and scipy."""

import importlib
import math
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._discrete import DiscreteTransferFunction
from ._state_space import dot, explicit, Realisation, StateSpace
from ._transfer_function import (
    coefficients_of,
    Convertible,
    HasCoefficients,
    require_continuous,
    TransferFunction,
)


@eqx.filter_jit  # one compilation instead of one for each small operation
def realise(model: TransferFunction | DiscreteTransferFunction) -> Realisation:
    """A, B, C, D of dx/dt = A x + B u, y = C x + D u: the model without its delay.

    Of a discrete model they are those of x[k+1] = A x[k] + B u[k], y[k] = C x[k] + D u[k].

    The controllable canonical form, in a time measured in units of the fastest pole: written in
    seconds, its coefficients spread over many decades and its exponential loses digits.
    """
    states = model.denominator.size - 1
    missing = model.denominator.size - model.numerator.size
    a = (model.denominator / model.denominator[0])[1:]
    b = jnp.pad(model.numerator / model.denominator[0], (missing, 0))
    powers = jnp.arange(1, states + 1, dtype=a.dtype)
    # The input-output behaviour does not depend on this scale, hence neither does its gradient.
    speed = jnp.max(jax.lax.stop_gradient(jnp.abs(a)) ** (1 / powers), initial=0)
    speed = jnp.where(speed > 0, speed, 1)
    a, c = a / speed**powers, (b[1:] - b[0] * a) / speed**powers
    first = jnp.eye(states, 1, dtype=a.dtype)
    A = speed * (jnp.eye(states, k=-1, dtype=a.dtype) - first * a[None])
    return A, speed * first, c[None], b[:1, None]


def state_space(model: TransferFunction) -> StateSpace:
    """A transfer function as a `StateSpace`; its delay becomes that of the input.

    The states are those of `realise`. A direct passage from input to output, which H0 x + H1 x'
    does not have, becomes a share of x'.

    **Raises:** `ValueError`: the model is a pure gain, which has no states.
    """
    A, B, C, D = realise(model)
    if not len(A):
        raise ValueError(
            f"numerator {model.numerator} and denominator {model.denominator} are a pure gain "
            "without states: scale G or H0 of a neighbouring model by it."
        )
    late = model.delay[None]
    if model.numerator.size < model.denominator.size:
        return StateSpace(F=A, G=B, H0=C, input_delay=late)
    # x' = A x + B u with B = (b, 0, ...): D / b of the first derivative holds D u.
    H1 = jnp.zeros_like(C).at[0, 0].set(D[0, 0] / B[0, 0])
    return StateSpace(F=A, G=B, H0=C - dot(H1, A), H1=H1, input_delay=late)


def feedthrough(
    model: TransferFunction | StateSpace,
) -> tuple[Float[Array, "outputs inputs"], Float[Array, "outputs inputs"]] | None:
    """What passes directly from the inputs to the outputs, and how late in s; None if nothing can.

    A hold shows it a whole number of samples late: y = D u(t - delay) changes between samples.
    """
    if isinstance(model, TransferFunction):
        if model.numerator.size < model.denominator.size:
            return None
        gain = model.numerator[0] / model.denominator[0]
        return gain[None, None], jnp.asarray(model.delay)[None, None]
    if model.H1 is None:
        return None
    gain, late = explicit(model)[3], model.lateness
    return gain, jnp.zeros_like(gain) if late is None else late


_INDEPENDENT = 1e-8  # smallest singular value of the columns of B, beside the largest


@runtime_checkable
class HasMatrices(Protocol):
    """A state space of python-control or scipy.signal."""

    @property
    def A(self) -> np.ndarray: ...
    @property
    def B(self) -> np.ndarray: ...
    @property
    def C(self) -> np.ndarray: ...
    @property
    def D(self) -> np.ndarray: ...
    @property
    def dt(self) -> float | int | bool | None: ...  # s; None or 0 where it is continuous


def from_control(
    system: HasCoefficients | HasMatrices,
) -> TransferFunction | StateSpace | DiscreteTransferFunction:
    """A model of python-control or scipy.signal.

    A direct passage from input to output, which H0 x + H1 x' does not have, becomes a share of x';
    where the inputs drive no states of their own, each gets one that cancels in the response. A
    transfer function of several inputs or outputs becomes a state space with states of their own
    for each pair.

    !!! example

        ```python
        model = jq.models.from_control(control.tf([10.0], [1.0, 4.0, 0.0]))
        ```

    **Arguments:** `system`: a `TransferFunction` or a `StateSpace` of python-control or
    scipy.signal. Neither has delays: put them in with `dataclasses.replace`.

    **Returns:** A `jq.TransferFunction` for a ratio of polynomials with one input and one output, a
    `jq.models.DiscreteTransferFunction` if it is sampled, otherwise a `jq.StateSpace`.

    **Raises:** `ValueError`: the system is improper, of another kind, or sampled with several
    inputs or outputs, in state space, or every unknown seconds.
    """
    if isinstance(system, HasMatrices):
        require_continuous(system.dt)
        return _with_passage(
            *(np.asarray(x, float) for x in (system.A, system.B, system.C, system.D))
        )
    if isinstance(system, HasCoefficients):
        above, below = coefficients_of(system)
        if len(above) == len(above[0]) == 1:
            if system.dt and system.dt is not True:
                return DiscreteTransferFunction(above[0][0], below[0][0], system.dt)
            require_continuous(system.dt)
            return TransferFunction(above[0][0], below[0][0])
        require_continuous(system.dt)
        outputs, inputs = len(above), len(above[0])
        parts, D = [], np.zeros((outputs, inputs))
        for row in range(outputs):  # a bank of all pairs
            for column in range(inputs):
                pair = TransferFunction(above[row][column], below[row][column])
                A, b, c = np.zeros((0, 0)), np.zeros(0), np.zeros(0)
                if np.any(pair.numerator):  # no states for a response of 0
                    # The controllable canonical form.
                    over, under = above[row][column], below[row][column]
                    a, states = under[1:] / under[0], under.size - 1
                    over = np.concatenate([np.zeros(under.size - over.size), over]) / under[0]
                    b, D[row, column] = np.eye(states, 1)[:, 0], float(over[0])
                    A, c = np.eye(states, k=-1) - np.outer(b, a), over[1:] - over[0] * a
                unit_in, unit_out = np.eye(inputs)[column], np.eye(outputs)[row]
                parts.append((A, np.outer(b, unit_in), np.outer(unit_out, c)))
        from scipy.linalg import block_diag

        A = np.asarray(block_diag(*(part[0] for part in parts)))
        B = np.concatenate([part[1] for part in parts])
        return _with_passage(A, B, np.concatenate([part[2] for part in parts], axis=1), D)
    remedy = "TransferFunction or a StateSpace of python-control or scipy.signal (control.tf)"
    if hasattr(system, "frdata"):
        remedy += "; data go to jq.spectra.FrequencyResponse.from_table(system, random_error=0.02)"
    raise ValueError(f"from_control cannot convert a {type(system).__name__}: give a {remedy}.")


def _with_passage(
    A: Float[np.ndarray, "states states"],
    B: Float[np.ndarray, "states inputs"],
    C: Float[np.ndarray, "outputs states"],
    D: Float[np.ndarray, "outputs inputs"],
) -> StateSpace:
    """H0 x + H1 x' that equals C x + D u."""
    if not np.any(D) and len(A):
        return StateSpace(F=A, G=B, H0=C)
    H1 = D @ np.linalg.pinv(B, rcond=_INDEPENDENT)
    if not np.allclose(H1 @ B, D, rtol=0, atol=1e-13 * np.max(np.abs(D), initial=0.0)):
        # One more state z' = u - a z for each input: H1 reads z', and H0 adds a z.
        inputs = D.shape[1]
        speed = float(np.max(np.abs(np.linalg.eigvals(A)), initial=0.0)) or 1.0  # a, rad/s
        across = np.zeros((len(A), inputs))
        A = np.block([[A, across], [across.T, -speed * np.eye(inputs)]])
        B = np.concatenate([B, np.eye(inputs)])
        C = np.concatenate([C, np.zeros_like(D)], axis=1)
        H1 = np.concatenate([np.zeros((len(D), len(across))), D], axis=1)
    return StateSpace(F=A, G=B, H0=C - H1 @ A, H1=H1)


_MOST_ORDER = 10  # above it the coefficients lose digits


class Explicit(NamedTuple):
    """x' = A x + B u, y = C x + D u."""

    A: Float[np.ndarray, "states states"]
    B: Float[np.ndarray, "states inputs"]
    C: Float[np.ndarray, "outputs states"]
    D: Float[np.ndarray, "outputs inputs"]


def convert(model: Convertible, package: str, pade: int | None) -> Any:
    """A model for python-control or scipy.signal: to_control and to_scipy."""
    if isinstance(model, StateSpace):
        kind, coefficients = "StateSpace", _matrices(model, pade)
    else:
        kind, rational = "TransferFunction", model
        if not isinstance(rational, TransferFunction):
            rational = model.transfer_function()  # pyright: ignore[reportAttributeAccessIssue]
        parts = (rational.numerator, rational.denominator, rational.delay)
        above, below, delay = (np.asarray(x, float) for x in parts)
        _check_order(delay, pade)
        if pade is not None and delay:
            over, under = _pade_coefficients(float(delay), pade)
            above, below = np.convolve(above, over), np.convolve(below, under)
        coefficients = (above, below)
    return _made_by(package, kind, *coefficients)


def convert_discrete(model: DiscreteTransferFunction, package: str) -> Any:
    """A model of samples for python-control or scipy.signal."""
    above, below = (np.asarray(x, float) for x in (model.numerator, model.denominator))
    below = np.pad(below, (0, model.delay))
    return _made_by(package, "TransferFunction", above, below, dt=model.dt)


def _made_by(package: str, kind: str, *coefficients: np.ndarray, **options: float) -> Any:
    try:
        return getattr(importlib.import_module(package), kind)(*coefficients, **options)
    except ImportError as error:
        raise ImportError(
            f"{package} is not installed: run pip install 'jaxquad[interop]', or pip install "
            f"{package}."
        ) from error


def _matrices(model: StateSpace, pade: int | None) -> Explicit:
    """The model on the host, its delays approximated."""
    plain = Explicit(*(np.asarray(part, float) for part in explicit(model)))
    outputs, inputs = plain.D.shape
    late = lambda delay, n: np.zeros(n) if delay is None else np.asarray(delay, float)
    by_input, by_output = late(model.input_delay, inputs), late(model.output_delay, outputs)
    _check_order(np.concatenate([by_input, by_output]), pade)
    if pade is None:
        return plain
    return _series(_series(_bank(by_input, pade), plain), _bank(by_output, pade))


def _check_order(delay: Float[np.ndarray, "..."], pade: int | None) -> None:
    """Raise ValueError for delays without an order, and for an order that loses digits."""
    if pade is not None and not 1 <= pade <= _MOST_ORDER:
        raise ValueError(
            f"pade is {pade}: give an order of 1 to {_MOST_ORDER}, or None for no delay."
        )
    longest = float(np.max(delay, initial=0.0))
    if longest and pade is None:
        # omega times delay at which a phase of order 3 is 1 deg off, by its first term.
        first = math.factorial(3) ** 2 / (math.factorial(6) * math.factorial(7))
        limit = (math.radians(1.0) / first) ** (1 / 7) / longest
        raise ValueError(
            f"The model has a delay of {longest:.4g} s, and a rational model has none: give the "
            f"order of a Pade approximation. pade=3 is within 1 deg of it up to {limit:.3g} rad/s "
            f"({limit / (2 * math.pi):.3g} Hz). Or set the delay to 0 with dataclasses.replace."
        )


def _pade_coefficients(
    delay: float, order: int
) -> tuple[Float[np.ndarray, " powers"], Float[np.ndarray, " powers"]]:
    """Numerator and denominator of exp(-delay s), the highest power of s first.

    Source: Golub & Van Loan, Matrix Computations, section 9.3.1.
    """
    counts = np.arange(order, -1, -1)
    choose = lambda k: math.comb(order, k) * math.factorial(2 * order - k)
    terms = np.array([choose(int(k)) / math.factorial(2 * order) for k in counts])
    below = terms * delay**counts
    return below * (-1.0) ** counts, below


def _bank(delays: Float[np.ndarray, " channels"], order: int) -> Explicit:
    """Approximations side by side; no states where there is no delay."""
    late = np.flatnonzero(delays)
    count = late.size * order
    A, B = np.zeros((count, count)), np.zeros((count, delays.size))
    C, D = np.zeros((delays.size, count)), np.eye(delays.size)
    # One approximation in time measured in delays, so that no digit is lost.
    above, below = _pade_coefficients(1.0, order)
    above, below = above / below[0], below / below[0]
    first = np.eye(order)[0]
    companion = np.eye(order, k=-1) - np.outer(first, below[1:])
    for k, channel in enumerate(late):
        block = slice(k * order, (k + 1) * order)
        A[block, block] = companion / delays[channel]
        B[block, channel] = first / delays[channel]
        C[channel, block] = above[1:] - above[0] * below[1:]
    D[late, late] = (-1.0) ** order
    return Explicit(A, B, C, D)


def _series(first: Explicit, second: Explicit) -> Explicit:
    """The outputs of `first` drive the inputs of `second`."""
    none = np.zeros((len(first.A), len(second.A)))
    return Explicit(
        np.block([[first.A, none], [second.B @ first.C, second.A]]),
        np.concatenate([first.B, second.B @ first.D]),
        np.concatenate([second.D @ first.C, second.C], axis=1),
        second.D @ first.D,
    )
