"""The Fourier estimator on a flight of Betaflight's firmware at three levels of throttle."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq
from jaxquad.control import FourierInertia


CHANNELS = {"outputs": ["gyroADC[0]", "setpoint[3]"], "references": "setpoint[0]"}


@eqx.filter_jit
def gains(estimator, command, rate):
    """K and its standard deviation after every sample."""

    def sample(state, now):
        state = estimator.update(state, *now)
        values, deviations = estimator.parameters(state)
        return state, (values["gain"], deviations["gain"])

    return jax.lax.scan(sample, estimator.init(rate[0]), (command, rate))[1]


@pytest.mark.slow
def test_the_gain_follows_the_throttle_as_the_fit_of_the_flight_does(data):
    """Random sticks at throttles .25, .40 and .60; each level from 6 s after the throttle moved."""
    path = data / "betaflight_firmware" / "A_throttle.BFL"
    if not path.is_file():
        pytest.skip(f"{path} is not there")
    record = jq.read(path, inputs="axisSum[0]", start=8.5, **CHANNELS)
    options = {"throttle": "setpoint[3]", "throttle_range": (0.0, 1000.0)}
    fitted = jq.identify.gain_over_throttle(record, **options)
    lag, delay = (float(getattr(fitted.fit.model, name)) for name in ("lag", "delay"))
    estimator = FourierInertia(
        1.0, 1 / 40, np.arange(1.0, 8.1, 0.5), measured="rate", lag=lag, delay=delay, dt=record.dt
    )
    command = np.concatenate([record.inputs[:1], record.inputs[:-1]])  # held before the sample
    rate = record.channel("gyroADC[0]")[:, None]
    over_time = gains(estimator, jnp.asarray(command), jnp.asarray(rate))
    gain, deviation = (np.asarray(x)[:, 0] for x in over_time)
    levels = zip(fitted.stretches, fitted.gain, fitted.gain_errors, strict=True)
    for [(begin, end)], expected, error in levels:
        settled = (record.time > begin + 6.0) & (record.time <= end)
        both = np.hypot(deviation[settled], error)
        assert np.mean(np.abs(gain[settled] - expected) < 1.96 * both) > 0.95
        assert gain[settled].mean() == pytest.approx(expected, rel=0.02)
    assert np.all(fitted.gain[1:] > 1.1 * fitted.gain[:-1])
