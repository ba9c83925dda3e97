"""What a model needs to be fitted, plotted and compared; models of one input and one output."""

import dataclasses
from collections.abc import Sequence
from typing import Any, Protocol, runtime_checkable, TYPE_CHECKING

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, PyTree

from jaxquad._core import (
    as_float,
    is_concrete,
    is_zero,
    on_host,
    require_finite,
    require_nonnegative,
    require_positive,
)

from ._declared import OPTIONAL, Scale, unit


if TYPE_CHECKING:
    from ._discrete import DiscreteTransferFunction

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

    **Raises:** `ValueError`: the result has neither one axis nor three.
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


class Convertible(eqx.Module):
    """A linear model that python-control and scipy.signal can take, as all of `jq.models` can.

    Delays need `pade`, the order of their Pade approximations, 1 to 10; in a state space each adds
    as many states.
    """

    def to_control(self, *, pade: int | None = None) -> Any:
        """The same model for python-control (extra `interop`): a transfer function or state space.

        **Raises:**

        - `ValueError`: there is a delay, but no order.
        - `ImportError`: python-control is not installed.
        """
        from ._convert import convert

        return convert(self, "control", pade)

    def to_scipy(self, *, pade: int | None = None) -> Any:
        """The same model for scipy.signal, whose `lsim`, `step` and `bode` take it.

        **Raises:** `ValueError`: there is a delay, but no order.
        """
        from ._convert import convert

        return convert(self, "scipy.signal", pade)

    def to_discrete(self, dt: float, *, hold: str = "zero") -> "DiscreteTransferFunction":
        """The model of its samples, exact for any delay; a part of a sample adds a pole at z = 0.

        On the host, not under jit. Source: Astrom & Wittenmark, Computer-Controlled Systems, 2.3.

        **Arguments:** `dt` in s; `hold`: the input stays ("zero") or is straight ("first").

        **Raises:** `ValueError`: another hold, dt is not above 0, or the model is a state space.
        """
        from ._discrete import discretise

        return discretise(self, dt, hold)


def require_continuous(dt: float | int | bool | None) -> None:
    """Raise ValueError for a sampled system."""
    if dt:
        raise ValueError(
            f"The system is sampled (dt = {dt}), and this model is continuous: convert the one "
            "that it was sampled from. jq.models.from_control takes a sampled ratio of one pair."
        )


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


def _namespace(*numbers: Array | np.ndarray):
    return np if all(map(is_concrete, numbers)) else jnp


def imaginary(omega: Frequencies) -> Complex[Array, "..."]:
    """s = j omega, in the precision of `omega`; whole numbers become floats."""
    omega = as_floats(omega)
    return jax.lax.complex(jnp.zeros_like(omega), omega)


class TransferFunction(Convertible):
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

    **Raises:** `ValueError`: the numerator has the higher degree, the denominator starts with 0,
    the delay is negative, or the system that is given is sampled or has several inputs or outputs.
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

    @property
    def poles(self) -> np.ndarray:
        """Roots of the denominator, rad/s; on the host, so not under jit."""
        return np.roots(np.asarray(self.denominator))

    @property
    def zeros(self) -> np.ndarray:
        """Roots of the numerator, rad/s; on the host, so not under jit."""
        return np.roots(np.asarray(self.numerator))


class LaggedIntegrator(Convertible):
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

    **Raises:** `ValueError`: lag, delay or damping is negative, or there is damping without an
    integrator.
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


class AttitudeAxis(Convertible):
    """One axis near hover, from the difference of two opposite motor inputs to the angle in rad.

    Only the ratio L K_t / J_x enters the response: one record cannot separate J_x from K_t. That
    takes a second record with a known added inertia (`with_added_inertia`), a known static torque,
    or a prior.
    Source: Eq. (28) of the paper with the lag, delay and damping that it neglects.

    **Arguments:**

    - `L`: the arm in m; `K_t`: the thrust in N/V; `J_x`: the inertia in kg m^2.
    - `lag`: of motor and propeller in s; `delay`: in s; `K_af`: the damping in N m s/rad.

    **Raises:** `ValueError`: a value is outside its physical range.
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
