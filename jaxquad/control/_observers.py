import math
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float


@runtime_checkable
class Observer(Protocol):
    """An extended state observer of y'' = u0 + f (order 2) or y' = u0 + f (order 1), sampled.

    At a sample it predicts the states [y, y', f] (or [y, f]) from the last estimate and the
    acceleration (or rate) `drive` = b0 u held since, and adds `correction` times the error of the
    predicted y. `current` tells whether the feedback uses this corrected estimate or still the
    prediction. `gains` are those of the textbook form, `fastest` is the highest wo dt.
    """

    @property
    def current(self) -> bool: ...
    @property
    def fastest(self) -> float: ...
    def gains(
        self, wo: Float[Array, "..."], dt: float, order: int
    ) -> Float[Array, "states ..."]: ...
    def correction(
        self, wo: Float[Array, "..."], dt: float, order: int
    ) -> Float[Array, "states ..."]: ...
    def predict(
        self, estimate: Sequence[Float[Array, "..."]], drive: Float[Array, "..."], dt: float
    ) -> list[Float[Array, "..."]]: ...


class CurrentObserver(eqx.Module):
    """The zero-order-hold observer whose estimate holds the latest measurement (Herbst).

    All poles at exp(-wo dt), exactly. Source: docs/control.md; Herbst, "A simulative study on
    active disturbance rejection control" (2013) and arXiv 1908.04610.
    """

    @property
    def current(self) -> bool:
        return True

    @property
    def fastest(self) -> float:
        return math.pi

    def gains(self, wo: Float[Array, "..."], dt: float, order: int) -> Float[Array, "states ..."]:
        """l of z[k] = (I - l C) (Ad z[k-1] + Bd b0 u[k-1]) + l y[k]; `wo` in rad/s."""
        return _current_gains(wo, dt, order)

    def correction(
        self, wo: Float[Array, "..."], dt: float, order: int
    ) -> Float[Array, "states ..."]:
        return _current_gains(wo, dt, order)

    def predict(
        self, estimate: Sequence[Float[Array, "..."]], drive: Float[Array, "..."], dt: float
    ) -> list[Float[Array, "..."]]:
        return _held(estimate, drive, dt)


class PredictiveObserver(eqx.Module):
    """The zero-order-hold observer whose estimate precedes the measurement: a sample to compute.

    All poles at exp(-wo dt), exactly. Source: docs/control.md.
    """

    @property
    def current(self) -> bool:
        return False

    @property
    def fastest(self) -> float:
        return math.pi

    def gains(self, wo: Float[Array, "..."], dt: float, order: int) -> Float[Array, "states ..."]:
        """l of z[k+1] = (Ad - l C) z[k] + Bd b0 u[k] + l y[k], that is, Ad times the current."""
        off = _off_unity(wo, dt)
        if order == 1:
            return jnp.stack([2 * off, off**2 / dt])
        return jnp.stack([3 * off, off**2 * (6 - off) / (2 * dt), off**3 / dt**2])

    def correction(
        self, wo: Float[Array, "..."], dt: float, order: int
    ) -> Float[Array, "states ..."]:
        return _current_gains(wo, dt, order)

    def predict(
        self, estimate: Sequence[Float[Array, "..."]], drive: Float[Array, "..."], dt: float
    ) -> list[Float[Array, "..."]]:
        return _held(estimate, drive, dt)


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

    def gains(self, wo: Float[Array, "..."], dt: float, order: int) -> Float[Array, "states ..."]:
        """dt times the continuous gains [3 wo, 3 wo^2, wo^3], or [2 wo, wo^2]."""
        return dt * continuous_gains(wo, order)

    def correction(
        self, wo: Float[Array, "..."], dt: float, order: int
    ) -> Float[Array, "states ..."]:
        rows = list(self.gains(wo, dt, order))
        for k in reversed(range(order)):  # what the next prediction turns into the gains
            rows[k] = rows[k] - dt * rows[k + 1]
        return jnp.stack(rows)

    def predict(
        self, estimate: Sequence[Float[Array, "..."]], drive: Float[Array, "..."], dt: float
    ) -> list[Float[Array, "..."]]:
        *known, unknown = estimate
        slopes = [*known[1:], unknown + drive]
        return [*(x + dt * v for x, v in zip(known, slopes, strict=True)), unknown]


def continuous_gains(wo: Float[Array, "..."], order: int) -> Float[Array, "states ..."]:
    """Those that place all poles of the continuous observer at -wo."""
    rows = [2 * wo, wo**2] if order == 1 else [3 * wo, 3 * wo**2, wo**3]
    return jnp.stack(rows)


def _off_unity(wo: Float[Array, "..."], dt: float) -> Float[Array, "..."]:
    """1 - exp(-wo dt), which would lose half its digits as written."""
    return -jnp.expm1(-wo * dt)


def _current_gains(wo: Float[Array, "..."], dt: float, order: int) -> Float[Array, "states ..."]:
    off = _off_unity(wo, dt)
    if order == 1:
        return jnp.stack([off * (2 - off), off**2 / dt])
    first = off * (3 - 3 * off + off**2)
    return jnp.stack([first, 1.5 / dt * off**2 * (2 - off), off**3 / dt**2])


def _held(
    estimate: Sequence[Float[Array, "..."]], drive: Float[Array, "..."], dt: float
) -> list[Float[Array, "..."]]:
    """A sample later, with the drive and the disturbance held."""
    if len(estimate) == 2:
        y, unknown = estimate
        return [y + dt * (unknown + drive), unknown]
    y, rate, unknown = estimate
    push = dt * (unknown + drive)
    return [y + dt * (rate + 0.5 * push), rate + push, unknown]
