import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.models import TransferFunction

from ._ladrc_gains import LADRCGains
from ._linear import LinearController
from ._observers import continuous_gains, Observer


def linear_ladrc(
    gains: LADRCGains, b0: Float[Array, ""], observer: Observer, dt: float
) -> LinearController:
    """The law without its limit; the state is the observer's prediction."""
    states = len(gains.correction)
    unit, zero = jnp.eye(states, dtype=b0.dtype), jnp.zeros(states, b0.dtype)
    transition = jnp.stack(observer.predict(list(unit), zero, dt))
    drive = jnp.stack(observer.predict(list(zero), jnp.ones_like(b0), dt))
    feedback = jnp.stack([x for x in (*gains[:2], jnp.ones_like(b0)) if x is not None])
    keep = unit.at[:, 0].add(-gains.correction)
    # b0 u = kp r - late x - direct y
    late = _dot(feedback, keep) if observer.current else feedback
    direct = _dot(feedback, gains.correction) if observer.current else jnp.zeros_like(b0)
    return LinearController(
        A=_dot(transition, keep) - drive[:, None] * late[None],
        reference_in=drive * gains.proportional,
        measurement_in=_dot(transition, gains.correction) - drive * direct,
        C=-late / b0,
        reference_through=gains.proportional / b0,
        measurement_through=-direct / b0,
        dt=dt,
    )


def continuous_ladrc(
    wc: Float[Array, ""],
    wo: Float[Array, ""],
    b0: Float[Array, ""],
    order: int,
    factors: tuple[Float[Array, ""], Float[Array, ""]],
) -> tuple[TransferFunction, TransferFunction]:
    """Feedback and feedforward of u = feedforward r - feedback y; docs/control.md."""
    l = factors[1] * continuous_gains(wo, order)
    one, zero = jnp.ones_like(b0), jnp.zeros_like(b0)
    if order == 1:
        kp = factors[0] * wc
        back = [kp * l[0] + l[1], kp * l[1]]
        below = [one, l[0] + kp, zero]
    else:
        kp, kd = factors[0] * wc**2, factors[0] * 2 * wc
        back = [kp * l[0] + kd * l[1] + l[2], kp * l[1] + kd * l[2], kp * l[2]]
        below = [one, l[0] + kd, l[1] + kd * l[0] + kp, zero]
    ahead = kp * jnp.concatenate([one[None], l])
    below = jnp.stack(below)
    return TransferFunction(jnp.stack(back) / b0, below), TransferFunction(ahead / b0, below)


def _dot(a: Array, b: Array) -> Array:
    return jnp.dot(a, b, precision="highest")
