"""A logged flight again, sample by sample at the loop's rate: the law's terms, and the whole loop.

What is not linear in a law, such as a relaxed or limited integral, is in its equations and so in
its replay. Source: docs/autopilots.md, "Which gains flew".
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad.control import LinearController, Setpoint

from ._law import FlownLoop


Samples = Float[Array | np.ndarray, "samples axes"]
Series = Float[Array | np.ndarray, " samples"]
_BLOCK = 1 << 15  # samples of the loop: programs of other lengths would be compiled anew


class HeldPlant(NamedTuple):
    """K e^(-delay s) / ((s + damping) (lag s + 1)), from a held command to the rate in rad/s."""

    gain: float  # rad/s^2 per unit of the command
    lag: float  # s
    delay: float = 0.0  # s
    damping: float = 0.0  # 1/s


class _Row(NamedTuple):
    """What a law sees at one sample of the loop, and where its integral begins anew."""

    setpoint: Array
    speed: Array
    rate: Array
    throttle: Array
    surge: Array
    integral_share: Array
    integral: Array
    anew: Array


def replay_terms(
    flown: FlownLoop, setpoint: Samples, gyro: Samples, throttle: Series, *, dt: float,
    feed_forward: Samples | None = None, integral: Samples | None = None,
    mixer_range: Series | None = None, late: float = 0.0, restart: float = 0.5,
) -> dict[str, Float[np.ndarray, "samples axes"]]:  # fmt: skip
    """P, I, D and F of a log again, from its set-point and its filtered gyro.

    The law runs at the loop's rate; between the samples of the log its signals are taken as
    straight. A log rounds them, and the integral of what is lost drifts away: with `integral`, the
    I term of the log, it starts anew from the log every `restart` seconds. Filters start at rest.

    **Arguments:**

    - `flown`: of the log's parameters, `betaflight_loop`, `px4_loop` or `ardupilot_loop`.
    - `setpoint`, `gyro`: in rad/s; `gyro` as it was logged, behind the gyro's filters.
    - `throttle`: 0 to 1.
    - `dt`: the interval of the log in s.
    - `feed_forward`: the logged F of Betaflight, which takes it from the sticks between their
        samples and raises D by its speed; None takes the slope of the set-point.
    - `integral`: the logged I term; None lets the integral run freely from 0.
    - `mixer_range`: highest less lowest motor over the mixer's range, which until Betaflight 4.5
        slows the integral.
    - `late`: s after its stamp at which the set-point acts.
    - `restart`: in s.

    **Returns:** the terms "P", "I", "D" and "F" in the firmware's units, at the log's samples.

    **Raises:**

    - `ValueError`: the log's interval is below the loop's.
    """
    if dt < 0.5 * flown.law.dt:
        raise ValueError(
            f"the log's interval is {dt:g} s, below the loop's {flown.law.dt:g} s: read "
            "the log at the loop's rate or below"
        )
    grid = _Grid(flown, len(setpoint), dt)
    rows = grid.rows(
        setpoint, throttle, late, feed_forward, grid.fine(gyro), mixer_range, integral, restart
    )
    terms = _replayed(flown.without_gyro_filters(), rows)
    return {name: grid.coarse(np.asarray(term)) for name, term in terms.items()}


def fly_again(
    flown: FlownLoop, plant: HeldPlant, setpoint: Series, throttle: Series, *, dt: float,
    feed_forward: Series | None = None, injected: Series | None = None, late: float = 0.0,
) -> Float[np.ndarray, " samples"]:  # fmt: skip
    """The rate that law and plant make of a logged set-point: the closed loop in time, undisturbed.

    **Arguments:**

    - `flown`: of one axis, with the gyro's filters; `plant`: up to what these are given.
    - `setpoint`: in rad/s; `throttle`: 0 to 1; `dt`: the interval of the log in s.
    - `feed_forward`: as for `replay_terms`.
    - `injected`: what is added to the command behind the law, in its unit.
    - `late`: s after their stamps at which set-point and injection act.

    **Returns:** the rate before the gyro's filters in rad/s, at the log's samples.
    """
    from scipy.linalg import expm

    dt_loop = flown.law.dt
    grid, column = _Grid(flown, len(setpoint), dt), lambda x: np.asarray(x)[:, None]
    added = np.zeros_like(setpoint) if injected is None else injected
    forward = None if feed_forward is None else column(feed_forward)
    rows = grid.rows(column(setpoint), throttle, late, forward, grid.fine(column(added), late))
    # Exactly over a sample, with its part by which the command comes late: torque, rate, command.
    lag, late_part = max(plant.lag, 1e-3 * dt_loop), plant.delay % dt_loop
    generator = np.zeros((3, 3))
    generator[0, 0], generator[0, 2] = -1 / lag, plant.gain / lag
    generator[1, 0], generator[1, 1] = 1.0, -plant.damping
    over = lambda span: expm(span * generator)
    rest = over(dt_loop - late_part)
    before = rest[:2, :2] @ over(late_part)[:2, 2]
    step = _Step(over(dt_loop)[:2, :2], before, rest[:2, 2])
    wait = max(int(np.floor(plant.delay / dt_loop + 1e-9)), 0)
    return grid.coarse(np.asarray(_flown_again(flown, step, wait, rows))[:, 0])


class _Grid:
    """The loop's samples in the span of a log, and signals on either."""

    def __init__(self, flown: FlownLoop, count: int, dt: float):
        self.flown, self.log, self.interval = flown, dt * np.arange(count), flown.law.dt
        size = int(np.floor(self.log[-1] / self.interval + 1e-6)) + 1
        self.loop = self.interval * np.arange(size)

    def fine(self, signal: Samples | Series, late: float = 0.0) -> np.ndarray:
        """At the loop's samples; what is `late` acts so long after its stamp."""
        return _straight(self.loop - late, self.log, np.asarray(signal, float))

    def coarse(self, signal: np.ndarray) -> np.ndarray:
        """At the log's samples, of a series that may have been padded."""
        return _straight(self.log, self.loop, signal[: self.loop.size])

    def rows(
        self, setpoint: Samples, throttle: Series, late: float, feed_forward: Samples | None,
        rate: np.ndarray, mixer_range: Series | None = None, integral: Samples | None = None,
        restart: float = 1.0,
    ) -> "_Row":  # fmt: skip
        """What the law sees, up to a whole number of blocks by the last samples."""
        flown, r = self.flown, self.fine(setpoint, late)
        speed = np.diff(r, axis=0, prepend=r[:1]) / self.interval
        if feed_forward is not None:
            speed = flown.setpoint_speed(speed, self.fine(feed_forward))
        # Throttle, anti-gravity's surge and the integral's share are of the loop before.
        before, surge = self.fine(throttle, self.interval), flown.surge(self.fine(throttle))
        share = np.ones_like(before)
        if mixer_range is not None:
            share = flown.integral_share(self.fine(mixer_range, self.interval))
        start, anew = np.zeros_like(r), np.zeros(len(r), bool)
        if integral is not None:
            start = self.fine(integral, self.interval)  # what the law adds to at this sample
            anew = np.arange(len(r)) % max(1, round(restart / self.interval)) == 0
        surge = np.concatenate([[0.0], surge[:-1]])
        more = -(-len(r) // _BLOCK) * _BLOCK - len(r)
        pad = lambda x: jnp.asarray(np.concatenate([x, np.repeat(x[-1:], more, axis=0)]))
        return _Row(*map(pad, (r, speed, rate, before, surge, share, start, anew)))


def _straight(at: np.ndarray, time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    """A series, or each column of one, at other times."""
    if signal.ndim == 1:
        return np.interp(at, time, signal)
    return np.stack([np.interp(at, time, column) for column in signal.T], axis=1)


@eqx.filter_jit
def _replayed(flown: FlownLoop, rows: _Row):
    zero = jnp.zeros_like(rows.rate[0])

    def sample(memory, row: _Row):
        memory = {**memory, "integral": jnp.where(row.anew, row.integral, memory["integral"])}
        reference = Setpoint(row.setpoint, row.speed, zero)
        memory, _, terms = flown.at_sample(row.throttle, row.surge, row.integral_share).advance(
            memory, zero, reference, row.rate
        )
        return memory, terms

    return jax.lax.scan(sample, flown.law.rest(zero), rows)[1]


class _Step(NamedTuple):
    """The held plant over a sample: the state's matrix, and those of the command before and now."""

    state: Float[np.ndarray, "2 2"]
    before: Float[np.ndarray, " 2"]
    now: Float[np.ndarray, " 2"]


@eqx.filter_jit
def _flown_again(flown: FlownLoop, step: _Step, wait: int, rows: _Row):
    zero = jnp.zeros_like(rows.setpoint[0])
    queue = jnp.zeros((wait + 1, *zero.shape))
    matrix, before, now = map(jnp.asarray, step)

    def sample(carry, row: _Row):
        memory, state, queue = carry
        rate = state[1]
        reference = Setpoint(row.setpoint, row.speed, zero)
        memory, command, _ = flown.at_sample(row.throttle, row.surge, row.integral_share).advance(
            memory, zero, reference, rate
        )
        queue = jnp.concatenate([(command + row.rate)[None], queue])  # the newest one first
        moved = matrix @ state + jnp.outer(now, queue[-2]) + jnp.outer(before, queue[-1])
        return (memory, moved, queue[:-1]), rate

    start = (flown.law.rest(zero), jnp.zeros((2, *zero.shape)), queue)
    return jax.lax.scan(sample, start, rows)[1]


@eqx.filter_jit
def predict_loop(
    law: LinearController,
    plant: Complex[Array | np.ndarray, "... frequencies"],
    omega: Float[Array | np.ndarray, " frequencies"],
) -> Complex[Array, "... frequencies"]:
    """The closed loop's response from set-point to measurement.

    **Arguments:**

    - `law`: of one axis, `law.linear(axis)`; of the rate, for a plant up to the rate.
    - `plant`: its response from the command to the measurement in rad or rad/s, the hold of the
        command included (`hold_response`); draws of it on leading axes.
    - `omega`: rad/s, below pi/dt.
    """
    turn = omega * law.dt
    z = jax.lax.complex(jnp.cos(turn), jnp.sin(turn))
    inputs = jnp.stack([law.reference_in, law.measurement_in], axis=1)
    through = jnp.stack([law.reference_through, law.measurement_through])
    states = len(law.A)

    def at(z: Array) -> Array:
        resolvent = z * jnp.eye(states, dtype=z.dtype) - law.A.astype(z.dtype)
        return law.C.astype(z.dtype) @ jnp.linalg.solve(resolvent, inputs.astype(z.dtype))

    ahead, back = (jax.vmap(at)(z) + through.astype(z.dtype)[None]).T
    plant = jnp.asarray(plant, z.dtype)
    wide = (1,) * (plant.ndim - 1) + (-1,)
    return plant * ahead.reshape(wide) / (1 - plant * back.reshape(wide))


def hold_response(
    omega: Float[Array | np.ndarray, " frequencies"], dt: float
) -> Complex[np.ndarray, " frequencies"]:
    """Of a command that is held over samples of `dt` seconds, at `omega` in rad/s."""
    half = np.asarray(omega) * dt / 2
    return np.sinc(half / np.pi) * np.exp(-1j * half)
