"""Estimates of frequency responses by scipy, as one writes them by hand, and by jaxquad.

Six records of a known plant in open loop, then twelve of the same plant in a loop u = r - y with
noise in y: rms errors over 0.7 to 18 rad/s, and those of the mean of the records, which are bias.
Prints the lines of docs/comparison.md.
"""

import functools as ft
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from scipy import signal
from scipy.linalg import expm

import jaxquad as jq


jq.enable_x64()

RATE = 100.0  # Hz
OMEGA = np.geomspace(0.7, 18.0, 60)
PLANT = jq.TransferFunction([8.0, 9.6], [1.0, 4.0, 16.0], delay=0.05)
SWEEP = jq.sweep(0.5, 20.0, duration=60.0, sample_rate=RATE, amplitude=1.0)
HELD = np.exp(-0.005j * OMEGA)  # the input is held: half a sample
TRUTH = np.asarray(PLANT.frequency_response(jnp.asarray(OMEGA)))[:, 0, 0] * HELD


_HELD = expm(np.array([[-4.0, -16.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]) / RATE)
SAMPLED = _HELD[:2, :2], _HELD[:2, 2:], np.array([[8.0, 9.6]])  # A, B and C, u held


def by_scipy(window: int, u: np.ndarray, y: np.ndarray) -> np.ndarray:
    """H1 by Welch's method, at OMEGA."""
    overlap = window * 4 // 5
    f, cross = signal.csd(u, y, fs=RATE, nperseg=window, noverlap=overlap)
    power = signal.welch(u, fs=RATE, nperseg=window, noverlap=overlap)[1]
    return np.interp(OMEGA, 2 * np.pi * f, cross / power)


def by_jaxquad(record: jq.Record, estimator: jq.spectra.Estimator | None = None) -> np.ndarray:
    response = jq.frequency_response(record, OMEGA, estimator=estimator).response
    return np.asarray(response)[:, 0, 0]


def report(name: str, responses: Sequence[np.ndarray]) -> None:
    """The rms error of the records, and of their mean."""
    error = np.log(np.stack(responses) / TRUTH)

    def rms(x: np.ndarray) -> tuple[float, float]:
        return 8.686 * np.sqrt(np.mean(np.real(x) ** 2)), np.degrees(
            np.sqrt(np.mean(np.imag(x) ** 2))
        )

    (db, degrees), (bias_db, bias_degrees) = rms(error), rms(error.mean(axis=0))
    spread = f"{db:.2f} dB, {degrees:.1f} deg"
    print(f"{name:38}{spread}; of their mean {bias_db:.2f} dB, {bias_degrees:.1f} deg")


def open_loop() -> None:
    clean = np.asarray(jq.models.simulate_linear(PLANT, SWEEP.signal, 1 / RATE))
    flown = [clean + np.random.default_rng(k).normal(0.0, 0.1, clean.size) for k in range(6)]
    for window in (500, 1000, 2000):
        name = f"scipy, windows of {window // 100} s"
        report(name, [by_scipy(window, SWEEP.signal, y) for y in flown])
    records = [jq.Record(SWEEP.time, SWEEP.signal, y) for y in flown]
    estimators = {
        "jq.spectra.Composite": jq.spectra.Composite(),
        "jq.spectra.LocalPolynomial (default)": jq.spectra.LocalPolynomial(),
    }
    for name, estimator in estimators.items():
        report(name, [by_jaxquad(record, estimator) for record in records])


def fly_closed(seed: int) -> jq.Record:
    """u = r - y with the sweep as r, and noise of 0.2 rms below 5 rad/s in y."""
    A, B, C = SAMPLED
    fade, samples = np.exp(-5.0 / RATE), SWEEP.samples
    noise = np.random.default_rng(seed).normal(0.0, 0.2 * np.sqrt(1 - fade**2), samples)
    noise, x = np.asarray(signal.lfilter([1.0], [1.0, -fade], noise)), np.zeros((2, 1))
    u, y = np.zeros(samples + 5), np.zeros(samples)  # five samples late
    for k in range(samples):
        y[k] = (C @ x).item() + noise[k]
        u[k + 5] = SWEEP.signal[k] - y[k]
        x = A @ x + B * u[k]
    return jq.Record(
        SWEEP.time, u[5:], y, references=SWEEP.signal,
        input_names="u", output_names="y", reference_names="r",
    )  # fmt: skip


def closed_loop() -> None:
    flown = [fly_closed(seed) for seed in range(12)]
    direct: Callable[[jq.Record], jq.Record] = ft.partial(
        jq.records.select, inputs="u", outputs="y"
    )
    pairs = [(record.inputs[:, 0], record.outputs[:, 0]) for record in flown]
    report("scipy, u to y", [by_scipy(1000, u, y) for u, y in pairs])
    report("jaxquad, direct", [by_jaxquad(direct(record)) for record in flown])
    report("jaxquad, joint (default)", [by_jaxquad(record) for record in flown])


if __name__ == "__main__":
    open_loop()
    closed_loop()
