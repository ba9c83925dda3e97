from typing import Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


Placement = Literal["discrete", "continuous"]


class LADRCGains(NamedTuple):
    """What multiplies errors of the angle, of the rate and of the observer, half gains included."""

    proportional: Float[Array, "..."]  # 1/s^2; order 1: 1/s
    derivative: Float[Array, "..."] | None  # 1/s; None for order 1
    correction: Float[Array, "states ..."]  # of the observer's prediction


def feedback_gains(
    wc: Float[Array, "..."], dt: float, order: int, placement: Placement
) -> tuple[Float[Array, "..."], Float[Array, "..."] | None]:
    """kp and kd that place the poles of u0/s^2 (order 1: u0/s) at -wc; order 1 has no kd.

    "discrete": at exp(-wc dt) exactly, with u0 held over the sample. "continuous": kp = wc^2 and
    kd = 2 wc, so at -wc only as dt goes to 0. Source: docs/control.md.
    """
    if placement == "continuous":
        return (wc, None) if order == 1 else (wc**2, 2 * wc)
    off = -jnp.expm1(-wc * dt)  # 1 - exp(-wc dt) without cancellation
    if order == 1:
        return off / dt, None
    return (off / dt) ** 2, off * (4 - off) / (2 * dt)


def fastest_feedback(order: int, placement: Placement) -> float:
    """The highest wc dt: Nyquist's, or where the held feedback turns unstable."""
    return jnp.pi if placement == "discrete" else 2.0 / order
