"""Refinement of records from a loop whose controller is known."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

import jaxquad as jq
from jaxquad.control import LinearController, PID
from jaxquad.identify import refine
from jaxquad.identify.output_error._problem import close_loop, feedback_response, invert_series


DT, SAMPLES = 0.02, 1500
TIME = DT * np.arange(SAMPLES)
TRUTH = jq.TransferFunction([12.0], [0.05, 1.0, 0.0], 0.0)
FREE = ("numerator[0]", "denominator[0]")
VALUES = np.array([12.0, 0.05])
PULSE = np.eye(1, SAMPLES)[0]
GAIN, KEEP = 0.25, 0.6  # u = -GAIN y, behind a filter that keeps so much


class Filtered(NamedTuple):
    """A gain behind a first-order filter of the measurement."""

    dt: float = DT

    def linear(self, axis: int = 0) -> LinearController:
        one, none = jnp.ones(1), jnp.zeros(())
        return LinearController(
            jnp.array([[KEEP]]), 0 * one, one, -GAIN * (1 - KEEP) * KEEP * one, none,
            none - GAIN * (1 - KEEP), self.dt,
        )  # fmt: skip


def loop_filters():
    """Numerators and the common denominator, of q^-1: of y to the reference, and of S."""
    rate, fade = DT / 0.05, np.exp(-DT / 0.05)  # of 12 / (s (0.05 s + 1)), held for DT
    B = 0.6 * np.array([0.0, rate - 1 + fade, 1 - fade - rate * fade])
    A = np.array([1.0, -1 - fade, fade])
    P, Q = np.array([GAIN * (1 - KEEP)]), np.array([1.0, -KEEP])
    loop = np.convolve(B, P)
    whole = np.convolve(A, Q)
    closed = whole + np.pad(loop, (0, len(whole) - len(loop)))
    return np.convolve(B, Q), whole, closed


def flown(seed):
    """A reference at the plant's input, and slow noise on the output that feedback returns."""
    rng = np.random.default_rng(seed)
    excite = np.repeat(rng.choice([-1.0, 1.0], SAMPLES // 25), 25)
    slow = np.asarray(lfilter([0.3], [1, -0.97], rng.standard_normal(SAMPLES)))
    through, whole, closed = loop_filters()
    y = np.asarray(lfilter(through, closed, excite)) + np.asarray(lfilter(whole, closed, slow))
    u = excite - np.asarray(lfilter([GAIN * (1 - KEEP)], [1, -KEEP], y))
    return jq.Record(TIME, u, y, hold=DT), slow


@pytest.mark.slow
def test_the_series_of_a_loop_is_its_sensitivity():
    record, slow = flown(0)
    _, whole, closed = loop_filters()
    feedback = feedback_response(Filtered(), record, "zero")
    expected = lfilter([-GAIN * (1 - KEEP)], [1, -KEEP], PULSE)
    np.testing.assert_allclose(feedback, expected, rtol=0, atol=1e-15)
    x = np.stack([PULSE, slow], axis=1)
    found = close_loop(TRUTH, jnp.asarray(x), jnp.asarray(feedback), DT)
    np.testing.assert_allclose(found, lfilter(whole, closed, x, axis=0), rtol=0, atol=1e-10)


@pytest.mark.slow
def test_a_series_times_its_inverse_is_one():
    a = np.array([1.0, *(0.3 * np.random.default_rng(1).standard_normal(299) / np.arange(1, 300))])
    product = np.convolve(a, np.asarray(invert_series(jnp.asarray(a))))[:300]
    np.testing.assert_allclose(product, np.eye(1, 300)[0], rtol=0, atol=1e-10)


def test_the_command_of_a_pid_is_that_of_its_steps():
    record, _ = flown(0)
    pid = PID([0.4], [0.2], [0.05], filter=20.0, dt=DT)
    state, found = pid.init(jnp.zeros(1)), []
    for y in [0.0, 1.0, *np.zeros(20)]:  # the derivative begins with the first measurement
        state, u = pid.step(state, jnp.zeros(1), jnp.array([y]))
        found.append(float(u[0]))
    np.testing.assert_allclose(feedback_response(pid, record, "zero")[:21], found[1:], atol=1e-12)


def test_what_does_not_go_with_a_loop_is_refused():
    record, _ = flown(0)
    refused: list[tuple[dict[str, Any], str]] = [
        ({"loop": Filtered(0.01)}, "computes every 0.01 s"),
        ({"loop": Filtered(), "hold": "first"}, "is not held"),
        ({"loop": Filtered(), "band": (1.0, 10.0)}, "a loop exclude each other"),
    ]
    for options, message in refused:
        with pytest.raises(ValueError, match=message):
            refine(TRUTH, record, free=FREE, **options)


@pytest.mark.slow
def test_the_noise_of_a_known_loop_is_modelled_by_poles_alone():
    """The loop's own poles are in it: a few zeros do not stand for them."""
    fit = refine(TRUTH, flown(1)[0], free=FREE, loop=Filtered(), noise="auto")
    [[model]] = fit.noise_models
    poles, zeros = model.order
    assert poles > 2 and zeros == 0


@pytest.mark.slow
def test_without_a_noise_model_the_estimate_in_a_known_loop_is_unbiased():
    """Slow noise that feedback returns to the input biases output error by many errors."""
    start = jq.TransferFunction([13.5], [0.06, 1.0, 0.0], 0.0)
    flights = [flown(seed)[0] for seed in range(30)]
    fits = [refine(start, flight, free=FREE, loop=Filtered()) for flight in flights]
    alone = [refine(start, flight, free=FREE) for flight in flights]
    errors = np.array([(fit.values - VALUES) / fit.standard_errors for fit in fits])
    biased = np.array([(fit.values - VALUES) / fit.standard_errors for fit in alone])
    # Of 30 draws a mean is known to 0.18, a scatter to 13 %: three times that.
    assert np.all(np.abs(errors.mean(axis=0)) < 0.55)
    assert np.all(np.abs(errors.std(axis=0) - 1) < 0.39)
    assert np.max(np.abs(biased.mean(axis=0))) > 0.9
