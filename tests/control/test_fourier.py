"""The recursive Fourier estimator: exact, honest over plants, differentiable, in a loop."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inertia_runs import exact, GAIN, gusty, heard, lock_in, recursive, RIG, swung
from rig_records import fly, INERTIA
from scipy.signal import lfilter

from jaxquad.control import (
    AdaptiveLADRC,
    certainty_equivalence,
    FourierInertia,
    LADRC,
    ProbeTones,
)
from jaxquad.loops import Loop
from jaxquad.models import DecoupledAxes
from jaxquad.simulation import Scenario, simulate


DT = 0.004
LINES = 1.3 * 1.2 ** np.arange(10)  # Hz
ROUND = np.arange(1.0, 4.6, 0.5)  # Hz, about the rig's tone of 2 Hz


def fourier(**options):
    return FourierInertia(GAIN, 0.08, ROUND, **options)


def drawn_plants(noise, measured, *, members=400, samples=4000, late=0):
    """P' = K u - d P + torque under multisines, stepped exactly: K, d, command, measurement.

    K from 1 to 4, damping from 0 to 1 and the phases are drawn for each member.
    """
    rng = np.random.default_rng(11)
    gain, damping = np.geomspace(1, 4, members), rng.uniform(0.01, 1.0, members)
    time, tones = DT * np.arange(samples)[:, None], 1.3 * 1.2 ** np.arange(1, 9)
    phase = rng.uniform(0, 2 * np.pi, (8, members))
    waves = [np.sin(2 * np.pi * f * time + p) for f, p in zip(tones, phase, strict=True)]
    command = 0.3 * np.sum(waves, axis=0)
    white = rng.standard_normal((2, samples, members))
    torque = {"white": 0.8 * white[0], "red": lfilter([0.4], [1, -0.99], white[0], axis=0)}
    push = gain * np.roll(command, late, axis=0) + torque.get(noise, 0)
    keep = np.exp(-damping * DT)
    share = -np.expm1(-damping * DT) / damping
    rate, angle = np.zeros((2, samples + 1, members))
    for k in range(samples):
        rate[k + 1] = keep * rate[k] + share * push[k]
        angle[k + 1] = angle[k] + share * rate[k] + (DT - share) / damping * push[k]
    y = (rate if measured == "rate" else angle)[1:]
    y = y + {"sensor": {"angle": 1e-3, "rate": 0.05}[measured]}.get(noise, 0) * white[1]
    return gain, damping, *(jnp.asarray(x[:, None]) for x in (command, y))


@eqx.filter_jit
def last_state(estimator, command, measurement):
    step = lambda state, now: (estimator.update(state, *now), None)
    start = estimator.init(jnp.zeros_like(measurement[0]))
    return jax.lax.scan(step, start, (command, measurement))[0]


def test_exact_data_give_the_exact_inertia_and_it_knows():
    """Under a constant load, from rest: windows and filters approximate nothing."""
    inertia, deviation, trusted = heard(fourier(), exact(), since=9.0)
    np.testing.assert_allclose(inertia, 1.0, rtol=1e-9)
    assert np.all(deviation < 1e-6) and np.all(trusted == 1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("measured", "noise"),
    [
        ("angle", "sensor"),
        ("angle", "white"),
        ("angle", "red"),
        ("rate", "sensor"),
        ("rate", "red"),
    ],
)
def test_deviations_cover_the_scatter_of_400_plants(measured, noise):
    gain, damping, *record = drawn_plants(noise, measured)
    estimator = FourierInertia(2.0, 1.0, LINES, measured=measured, dt=DT)
    state = last_state(estimator, *record)
    values, deviations = estimator.parameters(state)
    z = (np.asarray(values["gain"][0]) - gain) / np.asarray(deviations["gain"][0])
    assert 0.93 <= np.mean(np.abs(z) < 1.96) <= 0.97 and abs(z.mean()) < 0.15
    z = (np.asarray(values["damping"][0]) - damping) / np.asarray(deviations["damping"][0])
    assert 0.92 <= np.mean(np.abs(z) < 1.96) <= 0.98
    estimate = estimator.estimate(state)
    error = np.abs(np.asarray(estimate.inertia[0]) - 2 / gain)
    assert 0.93 <= np.mean(error < 1.96 * np.asarray(estimate.deviation[0])) <= 0.97


@pytest.mark.slow
def test_a_delay_is_estimated_or_given():
    """3 samples: to first order as a nuisance, exactly at the tones where it is given."""
    gain, damping, *record = drawn_plants("none", "rate", members=40, late=3)
    options: dict[str, Any] = {"measured": "rate", "dt": DT}
    terms = ("offset", "damping", "lag")
    asked = FourierInertia(2.0, 1.0, LINES, nuisance=terms, **options)
    values, deviations = asked.parameters(last_state(asked, *record))
    np.testing.assert_allclose(values["lag"][0], 3 * DT, rtol=0.1)
    given = FourierInertia(2.0, 1.0, LINES, delay=3 * DT, **options)
    values, _ = given.parameters(last_state(given, *record))
    np.testing.assert_allclose(values["gain"][0], gain, rtol=5e-3)
    np.testing.assert_allclose(values["damping"][0], damping, atol=0.03)
    assert set(deviations) == {*terms, "gain"}


@pytest.mark.slow
def test_beside_the_papers_regression_in_gusts_and_under_its_sine():
    """Encoder, 0.02 deg, lag 20 ms, 0.3 V at 2 Hz: least squares, lock-in and Fourier transform."""
    estimator = fourier(lag=0.02)
    scatter = {}
    for name, one in (("fourier", estimator), ("recursive", recursive()), ("lock-in", lock_in())):
        inertia, deviation, trusted = heard(one, gusty(), since=14.0)
        scatter[name] = inertia.std(axis=1).mean()
        assert abs(inertia.mean() - 1) < (0.005 if name == "fourier" else 0.03)
        if name == "fourier":
            assert 0.93 < np.mean(np.abs(inertia - 1) < 1.96 * deviation) < 0.99
            assert trusted.mean() == 1.0
    assert scatter["fourier"] < 0.8 * min(scatter["recursive"], scatter["lock-in"])
    inertia, deviation, trusted = heard(estimator, swung(), since=14.0)
    assert np.all(np.abs(inertia - 1) < 0.02) and trusted.mean() == 1.0
    assert np.mean(np.abs(inertia - 1) < 1.96 * deviation) > 0.95


@pytest.mark.slow
def test_without_excitation_it_says_that_it_knows_nothing():
    """Open loop; and closed, where the controller's answer to noise or a sine is no plant's."""
    still: dict[str, Any] = {"duration": 15.02, "members": 64, "tones": (), "seed": 4}
    record = fly(**still, noise=np.radians(0.02), closed=False)
    inertia, deviation, trusted = heard(fourier(lag=0.02), record)
    assert not np.any(trusted) and np.all(deviation > 0.3 * inertia)
    torques: list[dict[str, Any]] = [{}, {"sine": 0.3}, {"gust": 0.02}]
    for torque in torques:
        trusted = heard(fourier(lag=0.02), fly(**still, **RIG, **torque), since=6.0)[2]
        assert trusted.mean() < 0.02


@pytest.mark.slow
def test_gradients_to_its_settings_agree_with_differences():
    _, _, *record = drawn_plants("sensor", "angle", members=2, samples=2500)
    options: dict[str, Any] = {"lag": 0.01, "delay": 0.002, "dt": DT}
    start = FourierInertia(2.0, 1.0, LINES, forgetting=3.001, **options)  # starts between samples
    place = lambda e: (e.frequencies, e.forgetting, e.lag, e.delay)

    def cost(settings):
        state = last_state(eqx.tree_at(place, start, settings), *record)
        values, deviations = start.parameters(state)
        return jnp.sum(values["gain"] + 3 * deviations["gain"] + values["damping"])

    evaluate, settings = eqx.filter_jit(cost), place(start)
    slope = eqx.filter_jit(jax.grad(cost))(settings)
    assert all(np.all(np.isfinite(x)) for x in slope)
    for k, scale in enumerate((1e-5, 1e-5, 1e-6, 1e-6)):
        nudge = lambda sign, k=k, scale=scale: tuple(
            x + sign * scale if j == k else x for j, x in enumerate(settings)
        )
        expected = (float(evaluate(nudge(1))) - float(evaluate(nudge(-1)))) / (2 * scale)
        assert np.sum(slope[k]) == pytest.approx(expected, rel=1e-4)


@pytest.mark.slow
def test_b0_of_an_adaptive_ladrc_follows_it_and_a_payload():
    """Of three inertias; after 25 s each doubles, which the estimate shows within two memories."""
    spread, samples = np.array([0.6, 1.0, 2.0]), 20001
    estimator = fourier(tones=ProbeTones(above=0.0))
    chart = certainty_equivalence(GAIN, INERTIA)
    law = AdaptiveLADRC(LADRC(10.0, 30.0, 1.2), estimator, chart)
    payload = np.where(0.002 * np.arange(samples) >= 25.0, INERTIA, 0.0)
    zero = jnp.zeros((samples, 1))
    happening = Scenario(zero, zero, zero, zero, payload=jnp.asarray(payload)[:, None])
    plant = DecoupledAxes(GAIN, INERTIA * spread[None])
    run = simulate(Loop(plant, law), happening)
    b0, trusted = np.asarray(run.signals["b0"])[:, 0], round(4.0 / 0.002)
    np.testing.assert_array_equal(b0[: round(3.0 / 0.002)], 1.2)
    assert np.all(b0[trusted:].std(axis=0) > 0.1)
    np.testing.assert_allclose(b0[round(24.9 / 0.002)], GAIN / (INERTIA * spread), rtol=1e-4)
    np.testing.assert_allclose(b0[-1], GAIN / (INERTIA * (spread + 1)), rtol=0.01)


def test_it_begins_anew_when_its_tones_start():
    estimator = fourier(tones=ProbeTones())
    state = last_state(estimator, *(jnp.ones((900, 1)) * x for x in (0.1, 0.2)))
    quiet = eqx.tree_at(lambda s: s.probe.exciting, state, jnp.zeros(1))
    again = eqx.filter_jit(estimator.update)(estimator.excite(quiet), jnp.ones(1), jnp.ones(1))
    assert float(again.elapsed[0]) == 0 and not any(np.any(x) for x in again.stages)
    assert float(again.probe.exciting[0]) == 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"frequencies": [1.0, 2.0, 3.0, 4.0]}, "give 5 or more"),
        ({"frequencies": [1.0, 1.1, 2.0, 3.0, 4.0]}, "by 0.239 Hz or more"),
        ({"frequencies": [1.0, 2.0, 3.0, 4.0, 200.0]}, "to below 125 Hz"),
        ({"nuisance": ("angle",)}, "choose each of 'offset', 'damping' and 'lag'"),
        ({"measured": "speed"}, "give 'angle' or 'rate'"),
        ({"lag": -0.1}, "lag is"),
    ],
)
def test_settings_that_cannot_work_are_refused(options, message):
    settings: dict[str, Any] = {"frequencies": ROUND, **options}
    with pytest.raises((ValueError, TypeError), match=message):
        FourierInertia(GAIN, 0.08, **settings)
