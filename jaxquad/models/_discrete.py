"""Models of samples: ratios of polynomials in z, those of a continuous model, and back."""

import math
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad._core import as_float, is_concrete, require_finite

from ._declared import OPTIONAL, Scale, SIGNED, unit
from ._transfer_function import as_frequencies, Frequencies, TransferFunction


_SAME = 1e-6  # relative: sample intervals that differ by less are one
_WHOLE = 1e-9  # samples; a delay this close to whole samples has no pole at z = 0
_TOP = 1e-9  # relative: a frequency this close above Nyquist's is rounding


class DiscreteTransferFunction(eqx.Module):
    """From samples of one input to those of one output: numerator(z) / denominator(z) z^-delay.

    It relates samples, at z = exp(j omega dt), and has the hold before the plant in it: `jq.fit`
    compares it with a measured response as that stands, and `jq.refine`, `jq.verify` and
    `jq.predict` take no `hold=`. Data have to be of the same sample interval. With as many
    coefficients above as below, these are b and a of `scipy.signal.lfilter`.

    !!! example

        ```python
        # y[k] = 0.9 y[k-1] + 0.2 u[k-3]
        model = jq.models.DiscreteTransferFunction([0.2], [1.0, -0.9], dt=0.01, delay=2)
        ```

    **Arguments:**

    - `numerator`, `denominator`: coefficients, the highest power of z first. A fit leaves those
        of 0 as they are, and the others may cross 0.
    - `dt`: the sample interval in s.
    - `delay`: in whole samples, beside what the powers of z are late by. No parameter of a fit.

    **Raises:** `ValueError`: the numerator has the higher degree, the denominator starts with 0, a
    coefficient is not finite, dt is not above 0, or the delay is no whole number of 0 or more.
    """

    numerator: Float[Array, " zeros"] = eqx.field(
        converter=as_float, metadata=unit(lambda model, k: Scale(0)) | OPTIONAL | SIGNED
    )
    denominator: Float[Array, " poles"] = eqx.field(converter=as_float, metadata=OPTIONAL | SIGNED)
    dt: float = eqx.field(static=True, converter=float)  # s
    delay: int = eqx.field(static=True, default=0)  # samples

    def __check_init__(self):
        above, below = self.numerator.size, self.denominator.size
        if not 0 < above <= below or self.numerator.ndim != 1 or self.denominator.ndim != 1:
            raise ValueError(
                f"The numerator has {above} coefficients and the denominator {below}: a causal "
                "model has at least one, and no more above than below. Powers of z come highest "
                "first: b0 + b1 z^-1 is [b0, b1] / [1, 0]."
            )
        require_finite("numerator", self.numerator)
        require_finite("denominator", self.denominator)
        if is_concrete(self.denominator) and np.asarray(self.denominator)[0] == 0:
            raise ValueError(
                f"The denominator {self.denominator} starts with 0: drop leading zeros."
            )
        if not 0 < self.dt < np.inf:
            raise ValueError(f"dt is {self.dt}: give the sample interval in s, above 0.")
        is_count = isinstance(self.delay, int | np.integer) and not isinstance(self.delay, bool)
        if not (is_count and self.delay >= 0):
            raise ValueError(
                f"delay is {self.delay!r}: give whole samples, 0 or more. A part of a sample is in "
                "the coefficients: jq.TransferFunction(..., delay=seconds).to_discrete(dt)."
            )

    def frequency_response(self, omega: Frequencies) -> Complex[Array, "frequencies 1 1"]:
        """The response at `omega` in rad/s, in units of output per input.

        **Raises:** `ValueError`: a frequency is above Nyquist's, pi / dt. Under jit, where that
        is unknown, the response repeats.
        """
        omega = as_frequencies(omega)
        if is_concrete(omega):
            require_sampled(self.dt, omega=omega)
        angle = omega * self.dt
        # By powers of z - 1, which lose no digits where z and the poles are near 1.
        step = jax.lax.complex(-2 * jnp.sin(angle / 2) ** 2, jnp.sin(angle))
        above, below = (
            jnp.polyval(_about_one(c).astype(step.dtype), step)
            for c in (self.numerator, self.denominator)
        )
        late = jax.lax.complex(jnp.cos(self.delay * angle), -jnp.sin(self.delay * angle))
        return (above / below * late)[:, None, None]

    @property
    def poles(self) -> np.ndarray:
        """log(z) / dt of the denominator's roots but 0, rad/s; on the host, so not under jit."""
        return self._in_seconds(self.denominator)

    @property
    def zeros(self) -> np.ndarray:
        """log(z) / dt of the numerator's roots but 0, rad/s; on the host, so not under jit."""
        return self._in_seconds(self.numerator)

    def _in_seconds(self, polynomial: Float[Array, " powers"]) -> np.ndarray:
        roots = np.roots(np.asarray(polynomial, float)).astype(complex)
        return np.log(roots[np.abs(roots) > 0]) / self.dt

    def to_continuous(self) -> TransferFunction:
        """The model with this response behind a zero-order hold: the inverse of `to_discrete`.

        Poles return to below Nyquist's frequency, samples of delay to seconds. On the host, so
        not under jit.

        **Raises:** `ValueError`: a pole is at z = 0 or negative, which no sampled model has whose
        delay is whole samples and whose poles are below Nyquist's frequency.

        Source: Astrom & Wittenmark, Computer-Controlled Systems, sec. 2.3 (inverse of sampling).
        """
        from ._convert import realise

        rational = TransferFunction(self.numerator, self.denominator)
        A, B, C, D = (np.asarray(part, float) for part in realise(rational))
        roots = np.linalg.eigvals(A).astype(complex)
        bad = (np.abs(np.imag(roots)) <= 1e-9 * np.abs(roots)) & (np.real(roots) <= 0)
        if np.any(bad):
            raise ValueError(
                f"The model has a pole at z = {roots[bad][0].real:.4g}, and a continuous one "
                "behind a hold has none at 0 or below: a part of a sample of delay, a filter of "
                "finite length or an oscillation at Nyquist's frequency makes one. Fit a "
                "continuous model to the response, jq.fit_transfer_function(frf)."
            )
        from scipy.linalg import logm

        states = len(A)
        both = np.zeros((states + 1, states + 1))
        both[:states, :states], both[:states, states:], both[states, states] = A, B, 1.0
        rates = np.real(np.asarray(logm(both)))  # of time in samples
        F, G = rates[:states, :states], rates[:states, states:]
        # Faddeev and LeVerrier's recursion for C adj(s - F) G.
        above, below, power = np.zeros(states + 1), np.eye(1, states + 1)[0], np.eye(states)
        for k in range(1, states + 1):
            above[k] = (C @ power @ G).item()
            below[k] = -np.trace(F @ power) / k
            power = F @ power + below[k] * np.eye(states)
        above = above + D[0, 0] * below
        # What rounding leaves of powers that the model does not have.
        first = int(np.argmax(np.abs(above) > _ROUNDING * np.max(np.abs(above))))
        seconds = self.dt ** np.arange(states + 1)
        above, below = above[first:] / seconds[first:], below / seconds
        return TransferFunction(above, below, self.delay * self.dt)

    def to_control(self) -> Any:
        """The same model for python-control (extra `interop`), its delay as poles at z = 0."""
        from ._convert import convert_discrete

        return convert_discrete(self, "control")

    def to_scipy(self) -> Any:
        """The same model for scipy.signal, whose `dlsim`, `dstep` and `dbode` take it."""
        from ._convert import convert_discrete

        return convert_discrete(self, "scipy.signal")


_ROUNDING = 1e-9  # of the largest coefficient, in time measured in samples


def _about_one(polynomial: Float[Array, " powers"]) -> Float[Array, " powers"]:
    """The same polynomial of z - 1, the highest power first."""
    top = polynomial.size - 1
    choose = [[math.comb(top - k, top - j) for j in range(top + 1)] for k in range(top + 1)]
    return jnp.dot(polynomial, jnp.asarray(choose, polynomial.dtype), precision="highest")


def require_sampled(
    dt: float, *, samples: float | None = None,
    omega: Float[ArrayLike, " frequencies"] | Sequence[float] = (),
) -> None:  # fmt: skip
    """Raise ValueError for samples at another interval than `dt`, and above Nyquist's frequency."""
    if samples is not None and not np.isclose(dt, samples, rtol=_SAME, atol=0):
        raise ValueError(
            f"The model is of samples every {dt:.6g} s, the data have one every {samples:.6g} s: "
            "resample the record, or convert the model, model.to_continuous().to_discrete(dt)."
        )
    nyquist, highest = np.pi / dt, np.max(np.abs(np.asarray(omega)), initial=0.0)
    if highest > nyquist * (1 + _TOP):
        raise ValueError(
            f"The frequency {highest:.6g} rad/s is above Nyquist's, pi / dt = {nyquist:.6g} rad/s "
            f"({nyquist / (2 * np.pi):.4g} Hz), where samples tell nothing: give lower ones."
        )


def discretise(model: Any, dt: float, hold: str) -> DiscreteTransferFunction:
    """A continuous model behind a hold, as `jq.TransferFunction.to_discrete` gives it."""
    from ._simulate_linear import sample_rational, split_delay

    if not (isinstance(model, TransferFunction) or hasattr(model, "transfer_function")):
        raise ValueError(
            f"A {type(model).__name__} is no ratio of polynomials: jq.models.simulate_linear and "
            "jq.verify take it as it is, exactly at the samples."
        )
    rational = model if isinstance(model, TransferFunction) else model.transfer_function()
    if hold not in ("zero", "first") or not 0 < dt < np.inf:
        raise ValueError(f'hold is {hold!r} and dt {dt}: give "zero" or "first", and s above 0.')
    sampled = eqx.filter_jit(sample_rational)(rational, jnp.asarray(dt), hold)
    above, shift = np.asarray(sampled.above, float), int(sampled.shift)
    below = np.concatenate([[1.0], np.asarray(sampled.below, float), [0.0]])
    if float(split_delay(rational.delay, dt)[1]) <= _WHOLE:
        above, below = above[:-1], below[:-1]
    first = int(np.argmax(above != 0))
    return DiscreteTransferFunction(above[first:], below, dt, shift)
