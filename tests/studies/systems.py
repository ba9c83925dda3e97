"""Linear plants simulated exactly, without the library: NumPy and scipy alone."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy import signal
from scipy.linalg import expm, solve_discrete_lyapunov


class Continuous(NamedTuple):
    """x' = A x + B u(t - delay) + E d, y = C x."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    delay: float  # s
    E: np.ndarray | None = None  # where a gust enters

    def response(self, omega: np.ndarray) -> np.ndarray:
        """(frequencies, outputs, inputs)."""
        s = 1j * omega[:, None, None]
        states = np.linalg.solve(s * np.eye(len(self.A)) - self.A, self.B[None].astype(complex))
        return self.C @ states * np.exp(-self.delay * s)


def from_transfer_function(numerator, denominator, delay: float) -> Continuous:
    A, B, C, _ = signal.tf2ss(numerator, denominator)
    return Continuous(A, B, C, delay)


def hold(A: np.ndarray, B: np.ndarray, time: float) -> tuple[np.ndarray, np.ndarray]:
    """exp(A t) and the integral of exp(A s) B over 0..t."""
    n, inputs = B.shape
    block = np.zeros((n + inputs, n + inputs))
    block[:n, :n], block[:n, n:] = A, B
    both = expm(block * time)
    return both[:n, :n], both[:n, n:]


class Held(NamedTuple):
    """One sample of a plant whose input is held: exact for any delay.

    x[k+1] = A x[k] + old u[k-m] + new u[k-m+1] + E d[k].
    """

    A: np.ndarray
    old: np.ndarray
    new: np.ndarray
    E: np.ndarray
    C: np.ndarray
    samples: int  # m

    @property
    def size(self) -> int:
        """Of the state with the inputs that are still under way."""
        return len(self.A) + self.samples * self.old.shape[1]


def sampled(plant: Continuous, dt: float) -> Held:
    samples = int(np.ceil(plant.delay / dt - 1e-9))
    early = samples * dt - plant.delay  # the newer input acts for this long
    whole, _ = hold(plant.A, plant.B, dt)
    first = hold(plant.A, plant.B, dt - early)[1]
    later, new = hold(plant.A, plant.B, early)
    gust = np.zeros((len(plant.A), 1)) if plant.E is None else plant.E
    return Held(whole, later @ first, new, hold(plant.A, gust, dt)[1], plant.C, samples)


def advance(held: Held, state: np.ndarray, u: np.ndarray, d: np.ndarray) -> np.ndarray:
    """The next state, of states (..., size), inputs (..., inputs) and gusts (..., gusts)."""
    n, inputs = held.old.shape
    x, waiting = state[..., :n], state[..., n:]
    line = np.concatenate([u, waiting], axis=-1)  # the newest first
    oldest = line[..., held.samples * inputs :]
    newer = line[..., (held.samples - 1) * inputs :][..., :inputs] if held.samples else u
    moved = x @ held.A.T + oldest @ held.old.T + newer @ held.new.T + d @ held.E.T
    return np.concatenate([moved, line[..., : held.samples * inputs]], axis=-1)


def respond(plant: Continuous, u: np.ndarray, dt: float) -> np.ndarray:
    """y (samples, outputs) to a held input u (samples, inputs), at rest before it."""
    held, still = sampled(plant, dt), np.zeros(1)
    state, n = np.zeros(held.size), len(held.A)
    y = np.empty((len(u), len(held.C)))
    for k, value in enumerate(u):
        y[k] = held.C @ state[:n]
        state = advance(held, state, value, still)
    return y


def respond_smoothly(
    plant: Continuous, u: Callable[[np.ndarray], np.ndarray], time: np.ndarray, fine: float
) -> np.ndarray:
    """y (samples, outputs) at `time` to a smooth input of time, at rest before it.

    The input is taken at the middles of steps of `fine`, which is short against its periods.
    """
    steps = int(np.ceil(time[-1] / fine)) + 1
    middles = (np.arange(steps) + 0.5) * fine
    A, B = hold(plant.A, plant.B, fine)
    delayed = u(middles - plant.delay) @ B.T
    states = np.zeros((steps + 1, len(A)))
    for k in range(steps):
        states[k + 1] = A @ states[k] + delayed[k]
    grid = np.arange(steps + 1) * fine
    return np.stack([np.interp(time, grid, row) for row in plant.C @ states.T], axis=1)


class Linear(NamedTuple):
    """x[k+1] = A x[k] + B w[k], z[k] = C x[k] + D w[k]."""

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray

    def run(self, w: np.ndarray) -> np.ndarray:
        """z (runs, samples, outputs) of w (runs, samples, inputs), at rest before."""
        x = np.zeros((len(w), len(self.A)))
        z = np.empty((*w.shape[:2], len(self.C)))
        A, B, C, D = self.A.T, self.B.T, self.C.T, self.D.T
        for k in range(w.shape[1]):
            z[:, k] = x @ C + w[:, k] @ D
            x = x @ A + w[:, k] @ B
        return z

    def covariances(self, inputs: list[int], output: int, lags: int) -> np.ndarray:
        """Of one output at lags 0, 1, ... in the steady state, with white unit inputs."""
        B, D = self.B[:, inputs], self.D[output, inputs]
        spread = solve_discrete_lyapunov(self.A, B @ B.T)
        row = self.C[output]
        found = np.empty(lags)
        found[0] = row @ spread @ row + D @ D
        ahead = self.A @ spread @ row + B @ D
        for k in range(1, lags):
            found[k] = row @ ahead
            ahead = self.A @ ahead
        return found


def linear(
    step: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], n: int, inputs: int
) -> Linear:
    """The matrices of a linear step from (x, w) to (next x, z), by its columns."""
    along_x = [step(row, np.zeros(inputs)) for row in np.eye(n)]
    along_w = [step(np.zeros(n), row) for row in np.eye(inputs)]
    stack = lambda rows, part: np.stack([row[part] for row in rows], axis=1)
    return Linear(stack(along_x, 0), stack(along_w, 0), stack(along_x, 1), stack(along_w, 1))


def coloured(rng: np.random.Generator, samples: int, dt: float, corner: float) -> np.ndarray:
    """First-order noise of unit variance below `corner` rad/s."""
    fade = np.exp(-corner * dt)
    white = rng.standard_normal(samples) * np.sqrt(1 - fade**2)
    white[0] /= np.sqrt(1 - fade**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -fade], white))


class Chirp(NamedTuple):
    """A logarithmic sweep between two rests, with raised-cosine fades."""

    low: float  # rad/s
    high: float
    length: float  # s
    begin: float = 3.0
    amplitude: float = 1.0
    fade: float = 2.0  # s, in and out

    def __call__(self, time: np.ndarray) -> np.ndarray:
        clock = np.clip(time - self.begin, 0.0, self.length)
        growth = np.log(self.high / self.low) / self.length
        phase = self.low * np.expm1(growth * clock) / growth
        edge = np.minimum(np.minimum(clock, self.length - clock) / self.fade, 1.0)
        return self.amplitude * (0.5 - 0.5 * np.cos(np.pi * edge)) * np.sin(phase)


def multisine(seed: int, low: float, high: float, samples: int, dt: float) -> np.ndarray:
    """Random phases over all lines of the record in the band; unit variance."""
    rng = np.random.default_rng(seed)
    omega = 2 * np.pi * np.fft.rfftfreq(samples, dt)
    inside = (omega >= low) & (omega <= high)
    wave = np.fft.irfft(inside * np.exp(2j * np.pi * rng.uniform(size=omega.size)), samples)
    return wave / wave.std()
