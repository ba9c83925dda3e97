import math
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import multiply_gains

from ._protocols import Gain, Observer


Rows = Float[Array, "states ..."]
Matrices = Float[Array, "... states states"]


class _ZeroOrderHold(eqx.Module):
    @property
    def fastest(self) -> float:
        return math.pi

    def correction(self, wo: Gain, dt: float, order: int) -> Rows:
        off = _off_unity(wo, dt)
        if order == 1:
            return jnp.stack([off * (2 - off), off**2 / dt])
        first = off * (3 - 3 * off + off**2)
        return jnp.stack([first, 1.5 / dt * off**2 * (2 - off), off**3 / dt**2])

    def predict(self, estimate: Sequence[Gain], drive: Gain, dt: float) -> list[Gain]:
        if len(estimate) == 2:
            y, unknown = estimate
            return [y + dt * (unknown + drive), unknown]
        y, rate, unknown = estimate
        push = dt * (unknown + drive)
        return [y + dt * (rate + 0.5 * push), rate + push, unknown]


class CurrentObserver(_ZeroOrderHold):
    """The zero-order-hold observer whose estimate holds the latest measurement (Herbst).

    All poles at exp(-wo dt), exactly. Source: docs/control.md; Herbst, "A simulative study on
    active disturbance rejection control" (2013) and arXiv 1908.04610.
    """

    @property
    def current(self) -> bool:
        return True

    def gains(self, wo: Gain, dt: float, order: int) -> Rows:
        """l of z[k] = (I - l C) (Ad z[k-1] + Bd b0 u[k-1]) + l y[k]; `wo` in rad/s."""
        return self.correction(wo, dt, order)


class PredictiveObserver(_ZeroOrderHold):
    """The zero-order-hold observer whose estimate precedes the measurement: a sample to compute.

    All poles at exp(-wo dt), exactly. Source: docs/control.md.
    """

    @property
    def current(self) -> bool:
        return False

    def gains(self, wo: Gain, dt: float, order: int) -> Rows:
        """l of z[k+1] = (Ad - l C) z[k] + Bd b0 u[k] + l y[k], that is, Ad times the current."""
        off = _off_unity(wo, dt)
        if order == 1:
            return jnp.stack([2 * off, off**2 / dt])
        return jnp.stack([3 * off, off**2 * (6 - off) / (2 * dt), off**3 / dt**2])


class EulerObserver(eqx.Module):
    """The continuous observer stepped forward by Euler's rule, as much code in use has it.

    For comparison: the loop's poles are not where wc and wo say, the more so the slower the
    sampling (docs/control.md).
    """

    @property
    def current(self) -> bool:
        return False

    @property
    def fastest(self) -> float:
        return 2.0  # the observer alone diverges beyond it

    def gains(self, wo: Gain, dt: float, order: int) -> Rows:
        """dt times the continuous gains [3 wo, 3 wo^2, wo^3], or [2 wo, wo^2]."""
        return dt * continuous_gains(wo, order)

    def correction(self, wo: Gain, dt: float, order: int) -> Rows:
        rows = list(self.gains(wo, dt, order))
        for k in reversed(range(order)):  # what the next prediction turns into the gains
            rows[k] = rows[k] - dt * rows[k + 1]
        return jnp.stack(rows)

    def predict(self, estimate: Sequence[Gain], drive: Gain, dt: float) -> list[Gain]:
        *derivatives, unknown = estimate
        slopes = [*derivatives[1:], unknown + drive]
        return [*(x + dt * v for x, v in zip(derivatives, slopes, strict=True)), unknown]


def continuous_gains(wo: Gain, order: int) -> Rows:
    """Those that place all poles of the continuous observer at -wo."""
    rows = [2 * wo, wo**2] if order == 1 else [3 * wo, 3 * wo**2, wo**3]
    return jnp.stack(rows)


def _off_unity(wo: Gain, dt: float) -> Gain:
    """1 - exp(-wo dt), which would lose half its digits as written."""
    return -jnp.expm1(-wo * dt)


def error_dynamics(observer: Observer, correction: Rows, dt: float) -> Matrices:
    """(I - l C) Ad: the matrix that takes an error of the estimate to the next sample."""
    rows = jnp.moveaxis(correction, 0, -1)
    unit = jnp.eye(len(correction), dtype=rows.dtype)
    predict = jnp.stack(observer.predict(list(unit), jnp.zeros_like(unit[0]), dt))
    shape = (*rows.shape, len(unit))
    observed = rows[..., None] * jnp.broadcast_to(predict[0], shape)
    return jnp.broadcast_to(predict, shape) - observed


_STABLE = 1 - 1e-9  # the spectral radius below which an error of the observer decays


def _radius(error: Matrices) -> Float[np.ndarray, "..."]:
    return np.asarray(np.max(np.abs(np.linalg.eigvals(np.asarray(error))), axis=-1))


def instability_in_words(error: Matrices, named: str) -> str:
    """Empty for an observer whose error decays; `named` are its gains."""
    if (radius := float(np.max(_radius(error)))) < _STABLE:
        return ""
    return (
        f"The observer alone is unstable at {named} (spectral radius {radius:.4g} per sample): it "
        "would diverge while the command saturates. Raise observer_factor or lower wo."
    )


def slowness_in_words(error: Matrices, wc: Gain, dt: float, named: str) -> str:
    """Empty for an observer whose error decays at least as fast as exp(-wc t)."""
    ratio = np.asarray(multiply_gains(1 / wc, jnp.asarray(-np.log(_radius(error)) / dt)))
    if np.all(ratio >= 1):
        return ""
    return (
        f"The observer alone decays at {ratio.min():.3g} wc at {named}, slower than the feedback: "
        "after saturation its estimate would mislead. Raise observer_factor or wo."
    )


def barrier(error: Matrices, full: Matrices, wc: Gain, dt: float) -> Float[Array, ""]:
    """-ln of the room left to an observer before it is as slow as wc; near 0 for a fast one.

    The room is that of Jury's conditions on the polynomial of the observer's `error`, its roots
    scaled so that those of wc come to 1, over the room that the observer with `full` gains has to
    where it is unstable. NaN for a slower observer.
    """
    pairs = zip(_room(error, wc, dt), _room(full, 0 * wc, dt), strict=True)
    share = [multiply_gains(x, 1 / full_room) for x, full_room in pairs]
    return sum((jnp.mean(0.5 * jnp.log1p(x**2) - jnp.log(x)) for x in share), jnp.zeros(()))


def _room(error: Matrices, decay: Gain, dt: float) -> list[Gain]:
    """What is above 0 while every root of the error's polynomial is within exp(-decay dt)."""
    states, closer = error.shape[-1], jnp.exp(decay * dt)
    trace = multiply_gains(jnp.trace(error, axis1=-2, axis2=-1), closer)
    determinant = multiply_gains(jnp.linalg.det(error), closer**states)
    if states == 2:
        return [1 - trace + determinant, 1 - determinant]
    square = multiply_gains(jnp.trace(error @ error, axis1=-2, axis2=-1), closer**2)
    minors = 0.5 * (trace**2 - square)
    real = 1 - trace + minors - determinant
    return [real, 1 - minors + determinant * (trace - determinant)]


def list_range(values: Gain) -> str:
    """One number, or the lowest and the highest of several."""
    low, high = np.min(np.asarray(values)), np.max(np.asarray(values))
    return f"{low:.4g}" if low == high else f"{low:.4g} .. {high:.4g}"
