"""The terms of a logged law, computed again from its set-point and its gyro."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ._filters import FilterChain
from ._flown import FlownBetaflight


Samples = Float[Array | np.ndarray, "samples axes"]


def replay_terms(
    flown: FlownBetaflight,
    setpoint: Samples,
    gyro: Samples,
    throttle: Float[Array | np.ndarray, " samples"],
    *,
    dt: float,
    integral: Samples | None = None,
    restart: float = 0.5,
) -> dict[str, Float[Array, "samples axes"]]:
    """P, I, D and F of a Betaflight log again, from its set-point and its filtered gyro.

    Between the samples of the log both are taken as straight. A log rounds them to 1 deg/s, and
    the integral of what is lost drifts away: with `integral`, the I term of the log, it starts anew
    from the log every `restart` seconds. Filters start at rest. F is that of the logged set-point
    times the law's `f_share`: the firmware takes it from the sticks between their samples, which no
    log holds.

    **Arguments:**

    - `flown`: of the log's header, `betaflight_loop`.
    - `setpoint`, `gyro`: in rad/s; `gyro` as it was logged behind the gyro's filters (gyroADC).
    - `throttle`: 0 to 1.
    - `dt`: the interval of the log in s, a multiple of the loop's.
    - `integral`: the logged I term; None lets the integral run freely from 0.
    - `restart`: in s.

    **Returns:** the terms "P", "I", "D" and "F" in units of pidsum.

    **Raises:**

    - `ValueError`: `dt` is no multiple of the loop's interval.
    """
    count = dt / flown.law.dt
    if abs(count - round(count)) > 0.05 or count < 0.5:
        raise ValueError(
            f"the log's interval is {dt:g} s, which is {count:.3g} samples of the loop: read the "
            "log without resampling."
        )
    every = max(1, round(restart / dt))
    anew = np.arange(len(throttle)) % every == 0
    held = np.zeros_like(setpoint) if integral is None else np.asarray(integral, float)
    anew = anew & (integral is not None)
    return _replayed(flown, setpoint, gyro, throttle, held, anew, round(count))


@eqx.filter_jit
def _replayed(flown, setpoint, gyro, throttle, integral, anew, count):
    bare = dataclasses.replace(flown.law, gyro=FilterChain(), filters=())
    flown = dataclasses.replace(flown, law=bare, gyro_dynamic=None)
    parts = jnp.arange(1, count + 1) / count

    def between(memory, part, before, now):
        r, y, x = (a + part * (b - a) for a, b in zip(before, now, strict=True))
        memory, _, terms = flown.at(x).advance(memory, jnp.zeros_like(y), r, y)
        return memory, terms

    def sample(carry, row):
        memory, before = carry
        now, logged, start = row
        memory = {**memory, "integral": jnp.where(start, logged, memory["integral"])}
        memory, terms = jax.lax.scan(lambda m, part: between(m, part, before, now), memory, parts)
        return (memory, now), jax.tree.map(lambda x: x[-1], terms)

    now = tuple(map(jnp.asarray, (setpoint, gyro, throttle)))
    first = jax.tree.map(lambda x: x[0], now)
    start = (flown.law.rest(jnp.zeros_like(first[0])), first)
    return jax.lax.scan(sample, start, (now, jnp.asarray(integral), jnp.asarray(anew)))[1]
