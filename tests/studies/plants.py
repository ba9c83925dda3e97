"""The healthy plants of the study: what is flown, what is true, and where a fit starts.

Each is simulated by `systems.py`, which shares nothing with the library; the library's models
appear only as what a user would fit. Sampled noise; inputs that are commands are held, and the
record says so, as `jq.simulate` and the readers do.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from systems import (
    advance,
    Chirp,
    coloured,
    Continuous,
    from_transfer_function,
    Held,
    Linear,
    linear,
    multisine,
    respond,
    respond_smoothly,
    sampled,
)

import jaxquad as jq


class Mode(eqx.Module):
    """gain e^(-delay s) / (s^2 / frequency^2 + 2 damping s / frequency + 1)."""

    gain: jax.Array
    damping: jax.Array
    frequency: jax.Array  # rad/s
    delay: jax.Array  # s

    def frequency_response(self, omega):
        s = jax.lax.complex(jnp.zeros_like(omega), omega) / self.frequency
        late = jnp.exp(-self.delay * self.frequency * s)
        return (self.gain * late / (s**2 + 2 * self.damping * s + 1))[:, None, None]


class Rate(eqx.Module):
    """gain e^(-delay s) / ((s + damping) (lag s + 1)): a damped axis behind an actuator."""

    gain: jax.Array
    damping: jax.Array  # rad/s
    lag: jax.Array  # s
    delay: jax.Array  # s

    def frequency_response(self, omega):
        s = jax.lax.complex(jnp.zeros_like(omega), omega)
        slow = (s + self.damping) * (self.lag * s + 1)
        return (self.gain * jnp.exp(-self.delay * s) / slow)[:, None, None]


class Kind(NamedTuple):
    """A family of plants: its matrices of the parameters, and the library's model of them."""

    names: tuple[str, ...]
    matrices: Callable[[np.ndarray], Continuous]
    model: Callable[[np.ndarray], eqx.Module]
    free: tuple[str, ...] | None = None
    tied: dict | None = None


def _rate(theta: np.ndarray) -> Continuous:
    gain, damping, lag, delay = theta
    A = np.array([[-1 / lag, 0.0], [1.0, -damping]])
    B = np.array([[gain / lag], [0.0]])
    return Continuous(A, B, np.array([[0.0, 1.0]]), delay)


def _angle(theta: np.ndarray) -> Continuous:
    gain, lag, delay = theta
    A = np.array([[-1 / lag, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    B = np.array([[gain / lag], [0.0], [0.0]])
    gust = np.array([[0.0], [gain], [0.0]])  # a torque in units of the command, behind the lag
    return Continuous(A, B, np.array([[0.0, 0.0, 1.0]]), delay, gust)


def _mode(theta: np.ndarray) -> Continuous:
    gain, damping, frequency, delay = theta
    denominator = [1 / frequency**2, 2 * damping / frequency, 1.0]
    return from_transfer_function([gain], denominator, delay)


def _state_space(F: list, G: list, free_F: list, free_G: list) -> tuple[Kind, np.ndarray]:
    """States that are all measured; free entries, and one delay for all inputs."""
    F0, G0 = np.array(F), np.array(G)

    def parts(theta):
        F, G = F0.copy(), G0.copy()
        for place, value in zip([*free_F, *(None for _ in free_G)], theta, strict=False):
            if place is not None:
                F[place] = value
        for place, value in zip(free_G, theta[len(free_F) :], strict=False):
            G[place] = value
        return F, G, theta[-1]

    def matrices(theta):
        F, G, delay = parts(theta)
        return Continuous(F, G, np.eye(len(F)), delay)

    def model(theta):
        F, G, delay = parts(theta)
        return jq.StateSpace(F=F, G=G, H0=np.eye(len(F)), input_delay=[delay] * len(G[0]))

    names = (
        *(f"F[{i}][{j}]" for i, j in free_F),
        *(f"G[{i}][{j}]" for i, j in free_G),
        "input_delay[0]",
    )
    first = lambda model: model.input_delay[0]
    tied = {f"input_delay[{k}]": first for k in range(1, len(G[0]))}
    truth = np.array([*(F0[p] for p in free_F), *(G0[p] for p in free_G), 0.04])
    return Kind(names, matrices, model, names, tied), truth


RATE = Kind(
    ("gain", "damping", "lag", "delay"), _rate, lambda theta: Rate(*map(jnp.asarray, theta))
)
ANGLE = Kind(
    ("gain", "lag", "delay"), _angle, lambda theta: jq.LaggedIntegrator(*theta, integrators=2)
)
MODE = Kind(
    ("gain", "damping", "frequency", "delay"), _mode, lambda theta: Mode(*map(jnp.asarray, theta))
)
_SQUARE = [(0, 0), (0, 1), (1, 0), (1, 1)]
COUPLED, COUPLED_TRUTH = _state_space(
    [[-3.0, 1.2], [-2.0, -1.5]], [[8.0, 2.0], [-1.5, 5.0]], _SQUARE, _SQUARE
)
TRIPLE, TRIPLE_TRUTH = _state_space(
    [[-4.0, 1.5, 0.0], [-2.0, -2.5, 0.0], [0.0, 0.8, -1.5]],
    [[9.0, 0.0, 0.0], [0.0, 6.0, 0.0], [0.0, 0.0, 4.0]],
    [(0, 0), (0, 1), (1, 0), (1, 1), (2, 1), (2, 2)],
    [(0, 0), (1, 1), (2, 2)],
)


class Flown(NamedTuple):
    """What is logged of one run."""

    u: np.ndarray  # (samples, inputs)
    y: np.ndarray  # (samples, outputs)
    r: np.ndarray | None = None  # (samples, references)
    time: np.ndarray | None = None  # stamps in s where they are not uniform


class Bound(NamedTuple):
    """What the Cramer-Rao bound needs: noise-free outputs, and what disturbs them."""

    mean: Callable[[np.ndarray], np.ndarray]  # parameters to (samples, outputs)
    covariances: np.ndarray  # of the noise at lags 0, 1, ...
    shared: np.ndarray  # (outputs, outputs), which multiplies them
    nuisances: np.ndarray | None = None  # (samples, columns) that are unknown beside


class Plant(NamedTuple):
    """One row of the study."""

    title: str
    kind: Kind
    truth: np.ndarray
    band: tuple[float, float]  # rad/s, of the excitation
    dt: float  # s
    held: float | None  # s, what the record says of its input
    fly: Callable[[np.ndarray], list[Flown]]  # seeds to runs
    bound: Callable[[], Bound]


def _rng(title: str, seed: int) -> np.random.Generator:
    """Of one run; plants do not share their noise."""
    return np.random.default_rng([*title.encode(), int(seed)])


def _columns(wave: np.ndarray) -> np.ndarray:
    return wave[:, None] if wave.ndim == 1 else wave


def _white(rng, shape, dt):
    return rng.standard_normal(shape)


def _below(corner: float):
    """Noise that fades above a corner, in rad/s."""
    return lambda rng, shape, dt: np.stack(
        [coloured(rng, shape[0], dt, corner) for _ in range(shape[1])], axis=1
    )


def open_loop(
    title, kind, truth, *, wave: Callable[[np.ndarray], np.ndarray] | np.ndarray, seconds, sd,
    band: tuple[float, float] | None = None, dt=0.02, held=True, corner=None, shared=None,
    spoil=None, nuisances=None, lsb=0.0,
) -> Plant:  # fmt: skip
    """`wave` of time in s or an array drives the plant; noise of standard deviation `sd`.

    `lsb` is what the output is rounded to, which counts as white noise in the bound.
    """
    truth = np.asarray(truth, float)
    time = np.arange(round(seconds / dt)) * dt
    u = _columns(wave if isinstance(wave, np.ndarray) else wave(time))

    def mean(theta):
        if held:
            return respond(kind.matrices(theta), u, dt)
        assert not isinstance(wave, np.ndarray)
        drive = wave
        smooth = lambda t: _columns(drive(t))
        return respond_smoothly(kind.matrices(theta), smooth, time, dt / 20)

    clean = mean(truth)
    outputs = clean.shape[1]
    scale = np.broadcast_to(np.asarray(sd, float), (outputs,))
    mixing = np.eye(outputs) if shared is None else np.linalg.cholesky(np.asarray(shared))
    noise = _white if corner is None else _below(corner)

    def fly(seeds):
        flown = []
        for seed in seeds:
            rng = _rng(title, seed)
            e = scale * (noise(rng, clean.shape, dt) @ mixing.T)
            run = Flown(u, _rounded(clean + e, lsb))
            flown.append(run if spoil is None else spoil(rng, run, time))
        return flown

    def bound():
        lags = np.arange(len(time))
        shape = (lags == 0) * 1.0 if corner is None else np.exp(-corner * dt * lags)
        spread = scale[:, None] * (mixing @ mixing.T) * scale + lsb**2 / 12 * np.eye(outputs)
        return Bound(mean, shape, spread, None if nuisances is None else nuisances(time))

    band = (wave.low, wave.high) if isinstance(wave, Chirp) else band
    assert band is not None
    return Plant(title, kind, truth, band, dt, dt if held else 0.0, fly, bound)


class Loop(NamedTuple):
    """A sampled PID of the error, with a filtered derivative."""

    kp: float
    ki: float
    kd: float
    filter: float = 25.0  # rad/s


_STATES = 4  # integral, filter, gust, noise


def loop_step(held: Held, pid: Loop, at_input: bool, gust: float, noise: float, dt: float):
    """From (x, w) to (next x, [u, y]); w is the reference, and the white sources of both noises."""
    slow = np.exp(-1.0 * dt)  # gusts fade above 1 rad/s
    share = 1 - np.exp(-pid.filter * dt)
    n = len(held.A)

    def step(x, w):
        state, (integral, smooth, wind, _) = x[: held.size], x[held.size :]
        y = held.C @ state[:n] + noise * w[2]
        error = (0.0 if at_input else w[0]) - y[0]
        slope = share / dt * (error - smooth)
        u = pid.kp * error + pid.ki * integral + pid.kd * slope + (w[0] if at_input else 0.0)
        moved = advance(held, state, np.array([u]), np.array([wind]))
        wind_next = slow * wind + np.sqrt(1 - slow**2) * gust * w[1]
        rest = [integral + dt * error, smooth + share * (error - smooth), wind_next, 0.0]
        return np.concatenate([moved, rest]), np.array([u, y[0]])

    return step, held.size + _STATES


_SETTLE = 20.0  # s of gusts before a record of a loop begins


def closed_loop(title, kind, truth, pid, *, wave, seconds, gust, noise, at_input, dt=0.02) -> Plant:
    """A record in flight: `wave` is added to the set-point, or to the command."""
    truth = np.asarray(truth, float)
    time = np.arange(round(seconds / dt)) * dt
    r = _columns(wave(time))
    before = round(_SETTLE / dt)

    def whole(theta) -> Linear:
        return linear(
            *loop_step(sampled(kind.matrices(theta), dt), pid, at_input, gust, noise, dt), 3
        )

    flying = whole(truth)

    def fly(seeds):
        w = np.zeros((len(seeds), before + len(time), 3))
        w[:, before:, :1] = r
        for row, seed in zip(w, seeds, strict=True):
            row[:, 1:] = _rng(title, seed).standard_normal((len(row), 2))
        z = flying.run(w)[:, before:]
        return [Flown(run[:, :1], run[:, 1:], r) for run in z]

    def mean(theta):
        w = np.concatenate([r, np.zeros((len(r), 2))], axis=1)
        return whole(theta).run(w[None])[0, :, 1:]

    def bound():
        return Bound(mean, flying.covariances([1, 2], 1, len(time)), np.eye(1))

    return Plant(title, kind, truth, (wave.low, wave.high), dt, dt, fly, bound)


def _jittered(kind, truth, wave, dt, share):
    """Samples at stamps that jitter; the log has the stamps."""
    stamps = np.arange(0.0, 66.0, dt / 20)
    smooth = lambda t: _columns(wave(t))
    curve = respond_smoothly(kind.matrices(np.asarray(truth)), smooth, stamps, dt / 20)[:, 0]

    def spoil(rng, run, time):
        when = time + dt * np.clip(share * rng.standard_normal(len(time)), -0.4, 0.4)
        when[0] = max(when[0], 0.0)
        noise = run.y - np.interp(time, stamps, curve)[:, None]
        y = np.interp(when, stamps, curve)[:, None] + noise
        return Flown(_columns(wave(when)), y, time=when)

    return spoil


def _rounded(y: np.ndarray, lsb: float) -> np.ndarray:
    return lsb * np.round(y / lsb) if lsb else y


def _drifting(offset: float, slope: float):
    """An offset and a drift, of the output and of the input's trim."""
    return lambda rng, run, time: Flown(run.u + 0.3, run.y + offset + (slope * time)[:, None])


_LONG = Chirp(0.6, 20.0, 60.0)
_THETA = (10.0, 1.5, 0.08, 0.03)
_FLIES = (12.0, 0.05, 0.03)
_BUMP = (2.0, 0.4, 6.0, 0.03)
FLIES_WITH = Loop(0.7, 0.3, 0.28)


def _in_turn(first: Chirp, second: Chirp):
    return lambda time: np.stack([first(time), second(time)], axis=1)


def _three(samples: int, dt: float) -> np.ndarray:
    return np.stack([multisine(seed, 0.5, 20.0, samples, dt) for seed in (1, 2, 3)], axis=1)


MAKERS: dict[str, Callable[[], Plant]] = {
    "open-white": lambda: open_loop(
        "open loop, white noise", RATE, _THETA, wave=_LONG, seconds=66, sd=0.15
    ),
    "open-coloured": lambda: open_loop(
        "open loop, noise below 3 rad/s", RATE, _THETA, wave=_LONG, seconds=66, sd=0.3, held=False,
        corner=3.0,
    ),
    "closed-setpoint": lambda: closed_loop(
        "closed loop, swept set-point, gusts", ANGLE, _FLIES, FLIES_WITH,
        wave=Chirp(0.5, 15.0, 80.0, amplitude=0.3), seconds=86, gust=0.03, noise=0.003,
        at_input=False,
    ),
    "closed-input": lambda: closed_loop(
        "closed loop, swept command, gusts", ANGLE, _FLIES, FLIES_WITH,
        wave=Chirp(0.5, 15.0, 80.0, amplitude=0.3), seconds=86, gust=0.03, noise=0.003,
        at_input=True,
    ),
    "two-inputs": lambda: open_loop(
        "two coupled inputs, nine parameters", COUPLED, COUPLED_TRUTH,
        wave=_in_turn(Chirp(0.4, 20.0, 60.0), Chirp(0.4, 20.0, 60.0, begin=66.0)), seconds=130,
        band=(0.4, 20.0), sd=(0.15, 0.12), shared=[[1.0, 0.4], [0.4, 1.0]],
    ),
    "short-20": lambda: open_loop(
        "20 s record", RATE, _THETA, wave=Chirp(1.0, 20.0, 18.0, begin=1.0, fade=1.0), seconds=20,
        sd=0.15,
    ),
    "short-10": lambda: open_loop(
        "10 s record", RATE, _THETA, wave=Chirp(1.5, 20.0, 9.0, begin=0.5, fade=0.5), seconds=10,
        sd=0.15,
    ),
    "light-mode": lambda: open_loop(
        "mode with damping .03, 5 s of rest", MODE, (2.0, 0.03, 8.0, 0.03), wave=_LONG, seconds=68,
        sd=0.1, held=False,
    ),
    "jitter": lambda: open_loop(
        "stamps that jitter by .1 dt", RATE, _THETA, wave=_LONG, seconds=66, sd=0.15, held=False,
        spoil=_jittered(RATE, _THETA, _LONG, 0.02, 0.1),
    ),
    "quantised": lambda: open_loop(
        "quantised output", MODE, _BUMP, wave=_LONG, seconds=66, sd=0.03, held=False,
        lsb=0.1,
    ),
    "trends": lambda: open_loop(
        "offset, drift and trim", MODE, _BUMP, wave=_LONG, seconds=66, sd=0.05, held=False,
        spoil=_drifting(1.0, 0.02), nuisances=lambda time: time[:, None],
    ),
    "second-order-50-db": lambda: open_loop(
        "second order, 50 dB", MODE, (2.0, 0.3, 6.0, 0.02), wave=_LONG, seconds=66,
        sd=1.2 * 10**-2.5,
    ),
    "three-inputs": lambda: open_loop(
        "three inputs at once, 60 s", TRIPLE, TRIPLE_TRUTH, wave=_three(3000, 0.02), seconds=60,
        band=(0.5, 20.0), sd=(0.6, 0.5, 0.3),
        shared=[[1.0, 0.3, 0.0], [0.3, 1.0, 0.3], [0.0, 0.3, 1.0]],
    ),
}  # fmt: skip


def make(name: str) -> Plant:
    return MAKERS[name]()


def record(plant: Plant, flown: Flown) -> jq.Record:
    """What a user makes of a run: stamps that jitter are resampled, the rest is given as it is."""
    if flown.time is None:
        time = np.arange(len(flown.u)) * plant.dt
        return jq.Record(time, flown.u, flown.y, flown.r, hold=plant.held)
    channels = [
        jq.records.Channel(name, flown.time, values[:, 0])
        for name, values in (("u", flown.u), ("y", flown.y))
    ]
    time, values = jq.records.resample(channels, 1 / plant.dt)
    return jq.Record(time, values[:, :1], values[:, 1:], hold=plant.held)


_OFF = np.array([1.3, 0.75, 1.15, 0.8, 1.2, 0.85, 1.1, 0.9, 1.25, 0.8])


def start(plant: Plant) -> eqx.Module:
    """Starting values 10 to 30 % off."""
    return plant.kind.model(plant.truth * np.resize(_OFF, plant.truth.size))
