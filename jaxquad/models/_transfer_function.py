"""Models of one input and one output in s, and Pade approximations of delays."""

import dataclasses
import importlib
import math
from collections.abc import Sequence
from types import ModuleType
from typing import NamedTuple, Protocol, runtime_checkable, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad._core import (
    as_float,
    is_concrete,
    is_zero,
    on_host,
    require_finite,
    require_nonnegative,
    require_positive,
)

from ._protocols import as_floats, as_frequencies, Frequencies, OPTIONAL, Scale, unit


if TYPE_CHECKING:
    import control
    import scipy.signal


@runtime_checkable
class HasCoefficients(Protocol):
    """A transfer function of python-control (outputs per inputs) or of scipy.signal (one pair)."""

    @property
    def num(self) -> Sequence | np.ndarray: ...

    @property
    def den(self) -> Sequence | np.ndarray: ...

    @property
    def dt(self) -> float | int | bool | None: ...  # s; None or 0 where it is continuous


def coefficients_of(
    system: HasCoefficients,
) -> tuple[list[list[np.ndarray]], list[list[np.ndarray]]]:
    """Numerators and denominators, outputs per inputs, without leading zeros."""
    trim = lambda x: np.trim_zeros(np.atleast_1d(np.asarray(x, float)), "f")
    polynomials = []
    for rows in (system.num, system.den):
        # scipy.signal has one array, a row for each output; python-control rows of arrays.
        if isinstance(rows, np.ndarray):
            rows = [[row] for row in np.atleast_2d(rows)]
        polynomials.append([[trim(x) if np.any(x) else np.zeros(1) for x in row] for row in rows])
    return polynomials[0], polynomials[1]


def require_continuous(dt: float | int | bool | None) -> None:
    """Raise ValueError for a sampled system."""
    if dt:
        raise ValueError(
            f"The system is sampled (dt = {dt}), and models here are continuous: convert the one "
            "that it was sampled from, or fit one to its response with jq.fit_transfer_function."
        )


def _namespace(*numbers: Array | np.ndarray):
    return np if all(map(is_concrete, numbers)) else jnp


def imaginary(omega: Frequencies) -> Complex[Array, "..."]:
    """s = j omega, in the precision of `omega`; whole numbers become floats."""
    omega = as_floats(omega)
    return jax.lax.complex(jnp.zeros_like(omega), omega)


class TransferFunction(eqx.Module):
    """One input to one output: numerator(s) / denominator(s) exp(-delay s).

    !!! example

        ```python
        # 10 e^(-0.02 s) / (s (s + 4))
        model = jq.TransferFunction([10.0], [1.0, 4.0, 0.0], delay=0.02)
        same = jq.TransferFunction(control.tf([10.0], [1.0, 4.0, 0.0]), delay=0.02)
        ```

    **Arguments:**

    - `numerator`, `denominator`: coefficients, the highest power of s first. Or, as the only one of
        the two, a continuous transfer function of python-control or scipy.signal with one input and
        one output.
    - `delay`: in s.

    **Raises:**

    - `ValueError`: the numerator has the higher degree, the denominator starts with 0, the delay is
        negative, or the system that is given is sampled or has several inputs or outputs.
    """

    numerator: Float[Array, " zeros"] = eqx.field(
        converter=as_float,
        # With a denominator that starts with 1.
        metadata=unit(lambda model, k: Scale(model.denominator.size - model.numerator.size + k)),
    )
    denominator: Float[Array, " poles"] = eqx.field(
        converter=as_float, metadata=unit(lambda model, k: Scale(k, of_ratio=False))
    )
    delay: Float[Array, ""] = eqx.field(converter=as_float, default=0.0, metadata=unit("s"))

    def __init__(
        self,
        numerator: ArrayLike | Sequence | HasCoefficients,
        denominator: ArrayLike | Sequence | None = None,
        delay: ArrayLike = 0.0,
    ):
        if isinstance(numerator, HasCoefficients):
            if denominator is not None:
                raise ValueError(
                    f"TransferFunction has a {type(numerator).__name__} and a denominator: leave "
                    "one out."
                )
            require_continuous(numerator.dt)
            above, below = coefficients_of(numerator)
            if len(above) * len(above[0]) != 1:
                raise ValueError(
                    f"The system has {len(above)} outputs and {len(above[0])} inputs: pick one "
                    "pair, system[0, 0], or convert all with jq.models.from_control."
                )
            numerator, denominator = above[0][0], below[0][0]
        elif denominator is None:
            raise ValueError(
                "TransferFunction has a numerator and no denominator: give both, or a transfer "
                "function of python-control or scipy.signal."
            )
        self.numerator, self.denominator = as_float(numerator), as_float(denominator)
        self.delay = as_float(delay)

    def __check_init__(self):
        above, below = self.numerator.size, self.denominator.size
        if not 0 < above <= below:
            raise ValueError(
                f"The numerator has {above} coefficients and the denominator {below}: a proper "
                "model has at least one, and no more above than below; drop leading zeros."
            )
        require_finite("numerator", self.numerator)
        require_finite("denominator", self.denominator)
        if is_concrete(self.denominator) and np.asarray(self.denominator)[0] == 0:
            raise ValueError(
                f"The denominator {self.denominator} starts with 0: drop leading zeros."
            )
        require_nonnegative("delay", self.delay, "a model cannot answer before its input")

    def __call__(self, s: Complex[Array, "*points"]) -> Complex[Array, "*points"]:
        """The value at complex frequencies `s` in rad/s."""
        above, below = (
            jnp.polyval(c.astype(s.dtype), s) for c in (self.numerator, self.denominator)
        )
        return above / below * jnp.exp(-self.delay.astype(s.dtype) * s)

    def frequency_response(self, omega: Frequencies) -> Complex[Array, "frequencies 1 1"]:
        """The response at `omega` in rad/s, in units of output per input."""
        return self(imaginary(as_frequencies(omega)))[:, None, None]

    def __mul__(self, other: "TransferFunction") -> "TransferFunction":
        """The two in series; their delays add."""
        return TransferFunction(
            jnp.convolve(self.numerator, other.numerator),
            jnp.convolve(self.denominator, other.denominator),
            self.delay + other.delay,
        )

    def to_control(self, *, pade: int | None = None) -> "control.TransferFunction":
        """The same model for python-control (extra `interop`).

        **Arguments:**

        - `pade`: the order of the Pade approximation of the delay, 1 to 10; needed where there is
            a delay.

        **Raises:**

        - `ValueError`: there is a delay, but no order.
        - `ImportError`: python-control is not installed.
        """
        return require_package("control").TransferFunction(*_rational(self, pade))

    def to_scipy(self, *, pade: int | None = None) -> "scipy.signal.TransferFunction":
        """The same model for scipy.signal, whose `lsim`, `step` and `bode` take it.

        **Arguments:**

        - `pade`: as in `to_control`.

        **Raises:**

        - `ValueError`: there is a delay, but no order.
        """
        return require_package("scipy.signal").TransferFunction(*_rational(self, pade))

    @property
    def poles(self) -> np.ndarray:
        """Roots of the denominator, rad/s; on the host, so not under jit."""
        return np.roots(np.asarray(self.denominator))

    @property
    def zeros(self) -> np.ndarray:
        """Roots of the numerator, rad/s; on the host, so not under jit."""
        return np.roots(np.asarray(self.numerator))


def _rational(model: TransferFunction, pade: int | None) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator with the delay approximated."""
    above, below, delay = (
        np.asarray(x, float) for x in (model.numerator, model.denominator, model.delay)
    )
    check_order(delay, pade)
    if pade is None or not delay:
        return above, below
    over, under = _pade_coefficients(float(delay), pade)
    return np.convolve(above, over), np.convolve(below, under)


class LaggedIntegrator(eqx.Module):
    """The simplest model of an axis: K e^(-delay s) / (s^integrators (lag s + 1)).

    From a moment command to a rate with one integration, to an angle with two. With `damping` one
    of the integrators is s + damping instead of s, as air slows a rotation. Over a narrow band a
    record determines only the sum of lag and delay.

    **Arguments:**

    - `gain`: K, in units of the output per unit of input and s^integrators.
    - `lag`, `delay`: in s.
    - `integrators`: 0 to 3.
    - `damping`: in 1/s, of the rate; it takes at least one integrator. A fit leaves one of 0 as it
        is, unless `free` names it, which takes a start above 0.

    **Raises:**

    - `ValueError`: lag, delay or damping is negative, or there is damping without an integrator.
    """

    gain: Float[Array, ""] = eqx.field(
        converter=as_float, metadata=unit(lambda model, _: Scale(model.integrators))
    )
    lag: Float[Array, ""] = eqx.field(converter=as_float, default=0.0, metadata=unit("s"))
    delay: Float[Array, ""] = eqx.field(converter=as_float, default=0.0, metadata=unit("s"))
    integrators: int = eqx.field(static=True, default=1)
    damping: Float[Array, ""] = eqx.field(
        converter=as_float, default=0.0, metadata=unit("1/s") | OPTIONAL
    )

    def __check_init__(self):
        require_finite("gain", self.gain)
        for name, value in {"lag": self.lag, "delay": self.delay}.items():
            require_nonnegative(name, value, "give seconds, and 0 for none")
        require_nonnegative("damping", self.damping, "give 1/s, and 0 for none")
        if self.integrators not in (0, 1, 2, 3):
            raise ValueError(f"integrators is {self.integrators}: give 0 to 3.")
        if not self.integrators and is_concrete(self.damping) and np.any(self.damping):
            raise ValueError(
                f"damping is {np.asarray(self.damping)} 1/s, but integrators is 0: damping stands "
                "in the place of one of 1 to 3 integrators."
            )

    def frequency_response(self, omega: Frequencies) -> Complex[Array, "frequencies 1 1"]:
        """Response at `omega` in rad/s."""
        s = imaginary(as_frequencies(omega))
        gain, lag, delay, damping = (
            x.astype(s.dtype) for x in (self.gain, self.lag, self.delay, self.damping)
        )
        n = self.integrators
        rigid = s ** (n - 1) * (s + damping) if n else 1.0
        return (gain * jnp.exp(-delay * s) / ((lag * s + 1) * rigid))[:, None, None]

    def to_control(self, *, pade: int | None = None) -> "control.TransferFunction":
        """`transfer_function().to_control(pade=)`: the same model for python-control."""
        return self.transfer_function().to_control(pade=pade)

    def to_scipy(self, *, pade: int | None = None) -> "scipy.signal.TransferFunction":
        """`transfer_function().to_scipy(pade=)`: the same model for scipy.signal."""
        return self.transfer_function().to_scipy(pade=pade)

    def transfer_function(self) -> TransferFunction:
        """The same model as a ratio of polynomials; a known lag of 0 is left out."""
        numbers = self.gain, self.lag, self.damping
        (gain, lag, damping), xp = on_host(numbers), _namespace(*numbers)
        one, zero, n = xp.ones_like(lag), xp.zeros_like(lag), self.integrators
        slow = [one, damping] if n else [one]
        if not is_zero(self.lag):
            slow = [lag, one + lag * damping, damping] if n else [lag, one]
        denominator = xp.stack([*slow, *[zero] * (n - 1)])
        return TransferFunction(gain[None], denominator, self.delay)


class AttitudeAxis(eqx.Module):
    """One axis near hover, from the difference of two opposite motor inputs to the angle in rad.

    Only the ratio L K_t / J_x enters the response: one record cannot separate J_x from K_t. That
    takes a second record with a known added inertia (`with_added_inertia`), a known static torque,
    or a prior.
    Source: Eq. (28) of the paper with the lag, delay and damping that it neglects.

    **Arguments:**

    - `L`: the arm in m; `K_t`: the thrust in N/V; `J_x`: the inertia in kg m^2.
    - `lag`: of motor and propeller in s; `delay`: in s; `K_af`: the damping in N m s/rad.

    **Raises:**

    - `ValueError`: a value is outside its physical range.
    """

    L: Float[Array, ""] = eqx.field(converter=as_float, metadata=unit("m"))  # arm
    K_t: Float[Array, ""] = eqx.field(converter=as_float, metadata=unit("N/V"))  # thrust
    J_x: Float[Array, ""] = eqx.field(converter=as_float, metadata=unit("kg m^2"))
    lag: Float[Array, ""] = eqx.field(converter=as_float, default=0.0, metadata=unit("s"))
    delay: Float[Array, ""] = eqx.field(converter=as_float, default=0.0, metadata=unit("s"))
    K_af: Float[Array, ""] = eqx.field(  # damping
        converter=as_float, default=0.0, metadata=unit("N m s/rad")
    )

    def __check_init__(self):
        for name, value in {"L": self.L, "K_t": self.K_t, "J_x": self.J_x}.items():
            require_positive(name, value, "give it in SI units")
        for name, value in {"lag": self.lag, "delay": self.delay}.items():
            require_nonnegative(name, value, "give seconds, and 0 for none")
        require_finite("K_af", self.K_af)

    @property
    def gain(self) -> Float[Array, ""]:
        """Angular acceleration per unit of input, L K_t / J_x, in rad/s^2/V."""
        return self.L * self.K_t / self.J_x

    def frequency_response(self, omega: Frequencies) -> Complex[Array, "frequencies 1 1"]:
        """Angle over input, rad/V, at `omega` in rad/s; infinite at 0."""
        s = imaginary(as_frequencies(omega))
        lever, inertia, lag, delay, damping = (
            x.astype(s.dtype)
            for x in (self.L * self.K_t, self.J_x, self.lag, self.delay, self.K_af)
        )
        rigid = s * (inertia * s + damping)
        return (lever * jnp.exp(-delay * s) / (rigid * (lag * s + 1)))[:, None, None]

    def to_control(self, *, pade: int | None = None) -> "control.TransferFunction":
        """`transfer_function().to_control(pade=)`: the same model for python-control."""
        return self.transfer_function().to_control(pade=pade)

    def to_scipy(self, *, pade: int | None = None) -> "scipy.signal.TransferFunction":
        """`transfer_function().to_scipy(pade=)`: the same model for scipy.signal."""
        return self.transfer_function().to_scipy(pade=pade)

    def transfer_function(self) -> TransferFunction:
        """The same model as a ratio of polynomials.

        A lag of 0 has no pole and is left out. Under jit its value is unknown: it must not be 0.
        """
        numbers = self.L, self.K_t, self.J_x, self.K_af, self.lag
        (L, K_t, J_x, K_af, lag), xp = on_host(numbers), _namespace(*numbers)
        denominator = xp.stack([J_x, K_af, xp.zeros_like(J_x)])
        if not is_zero(self.lag):
            denominator = xp.convolve(denominator, xp.stack([lag, xp.ones_like(lag)]))
        return TransferFunction(xp.reshape(L * K_t, (1,)), denominator, self.delay)

    def with_added_inertia(self, inertia: ArrayLike) -> "AttitudeAxis":
        """The same axis carrying a known extra `inertia` in kg m^2."""
        J_x, added = on_host((self.J_x, as_float(inertia)))
        return dataclasses.replace(self, J_x=J_x + added)


_MOST_ORDER = 10  # above it the coefficients lose digits


class Explicit(NamedTuple):
    """x' = A x + B u, y = C x + D u."""

    A: Float[np.ndarray, "states states"]
    B: Float[np.ndarray, "states inputs"]
    C: Float[np.ndarray, "outputs states"]
    D: Float[np.ndarray, "outputs inputs"]


def require_package(name: str) -> ModuleType:
    """A package of the extra `interop`; ImportError with the line that installs it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise ImportError(
            f"{name} is not installed: run pip install 'jaxquad[interop]', or pip install {name}."
        ) from error


def check_order(delay: Float[np.ndarray, "..."], pade: int | None) -> None:
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


def without_delays(
    model: Explicit,
    by_input: Float[np.ndarray, " inputs"],
    by_output: Float[np.ndarray, " outputs"],
    order: int,
) -> Explicit:
    """The model between approximations of its delays (s)."""
    return _series(_series(_bank(by_input, order), model), _bank(by_output, order))


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
