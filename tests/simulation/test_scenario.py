"""What happens to a loop: signals against closed forms."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.excitation import sweep
from jaxquad.simulation import (
    ceti_gust,
    Gust,
    Motion,
    Pulse,
    Ramp,
    Scenario,
    scenario,
    Signal,
    Sine,
    SmoothStep,
    Step,
    WhiteNoise,
)


DT, DURATION = 0.002, 10.0
TIME = DT * np.arange(5000)
KEY = jax.random.key(7)


def roll(signal, *, part="reference", axes=1, **options):
    """The first axis of a scenario in which only that axis has a signal."""
    made = scenario(duration=DURATION, dt=DT, axes=axes, **{part: {0: signal}}, **options)
    return np.asarray(getattr(made, part))[:, 0]


def test_a_step_is_what_it_was_before_until_its_sample_and_what_it_becomes_from_it():
    values = roll(Step(0.07, before=0.02, at=1.0))
    assert np.array_equal(values, np.where(np.arange(5000) < 500, 0.02, 0.07))


def test_a_pulse_train_is_on_for_its_share_of_every_period():
    values = roll(Pulse(0.2, period=5.0, share=0.5), part="disturbance")
    assert np.array_equal(values, 0.2 * np.tile(np.repeat([1.0, 0.0], 1250), 2))
    short = roll(Pulse(0.2, period=2.5, width=0.5, at=2.0), part="disturbance")
    assert np.flatnonzero(np.diff(short) > 0).tolist() == [999, 2249, 3499, 4749]
    assert np.count_nonzero(short) == 3 * 250 + 250


def test_a_payload_is_picked_up_and_set_down():
    values = roll(Pulse(0.0552, at=3.0, width=4.0), part="payload")
    inside = (TIME >= 3.0 - 1e-9) & (TIME < 7.0 - 1e-9)
    assert np.array_equal(values, 0.0552 * inside)


def test_waveforms_in_float32_are_those_in_float64_rounded():
    def signals():
        return [
            Step(0.07, at=0.5) + Pulse(0.2, period=0.3, share=0.5),
            Sine(0.3, period=0.7) + Ramp(1.0, within=3.3),
            SmoothStep(0.1, within=1.7, at=0.2),
        ]

    doubles = [roll(signal) for signal in signals()]
    with jax.enable_x64(False):
        singles = [roll(signal) for signal in signals()]
    for double, single in zip(doubles, singles, strict=True):
        assert single.dtype == np.float32
        np.testing.assert_allclose(single, double, rtol=0, atol=1e-7 * np.abs(double).max())
        one, other = (np.flatnonzero(np.abs(np.diff(x)) > 0.05) for x in (double, single))
        assert np.array_equal(one, other)


@pytest.mark.parametrize(
    "signal",
    [
        Sine(0.3, period=1.7, phase=0.4),
        SmoothStep(0.4, before=-0.1, within=1.5, at=0.5),
        Ramp(0.4, before=0.1, within=20.0),
    ],
)
def test_rate_and_acceleration_are_the_derivatives_of_the_reference(signal):
    made = scenario(duration=DURATION, axes=1, reference={0: signal}, feed_forward=True)
    assert made.rate is not None and made.acceleration is not None
    angle, rate, acceleration = (
        np.asarray(x)[:, 0] for x in (made.reference, made.rate, made.acceleration)
    )
    # Central differences of second order: the error is T^2/6 times the third derivative.
    scale = 10 * DT**2
    np.testing.assert_allclose(
        (angle[2:] - angle[:-2]) / (2 * DT), rate[1:-1], atol=20 * scale, rtol=0
    )
    smooth = np.abs(np.diff(acceleration, prepend=0)) < 0.1
    difference = (angle[2:] - 2 * angle[1:-1] + angle[:-2]) / DT**2
    np.testing.assert_allclose(
        difference[smooth[1:-1]], acceleration[1:-1][smooth[1:-1]], atol=400 * scale, rtol=0
    )


def test_a_smooth_step_has_the_rate_of_the_least_jerk_and_comes_to_rest():
    made = scenario(
        duration=DURATION, axes=1, reference={0: SmoothStep(0.3, within=2.0)}, feed_forward=True
    )
    assert made.rate is not None and made.acceleration is not None
    assert np.max(made.rate) == pytest.approx(15 / 8 * 0.3 / 2.0, rel=1e-12)
    assert made.reference[-1, 0] == 0.3 and made.rate[-1, 0] == made.acceleration[-1, 0] == 0


def test_signals_add():
    both = roll(Step(0.1) + Sine(0.2, period=2.0))
    np.testing.assert_allclose(both, roll(Step(0.1)) + roll(Sine(0.2, period=2.0)), atol=1e-16)


def test_an_excitation_is_followed_by_zeros_and_must_fit():
    wave = sweep(6.0, 20.0, duration=4.0, sample_rate=500, amplitude=2.0, trim=0.0)
    values = roll(wave, part="injection")
    assert np.array_equal(values[: wave.samples], wave.signal) and not values[wave.samples :].any()
    with pytest.raises(ValueError, match="sample_rate=500"):
        roll(sweep(6.0, 20.0, duration=4.0, sample_rate=250, amplitude=2.0), part="injection")
    with pytest.raises(ValueError, match="lengthen the duration"):
        scenario(duration=2.0, injection={"roll": wave})


def test_parts_are_as_wide_as_they_need_and_zero_where_nothing_is_said():
    made = scenario(
        duration=1.0,
        reference={"pitch": Step([0.1, 0.2, 0.3])},
        noise=WhiteNoise(1e-3),
        ensemble=3,
        key=KEY,
    )
    assert made.reference.shape == (500, 3, 3) and made.disturbance.shape == (500, 3)
    assert made.ensemble == (3,) and made.rate is None and made.payload is None
    assert not np.any(made.reference[:, 0]) and not np.any(made.disturbance)
    assert np.array_equal(made.reference[0, 1], [0.1, 0.2, 0.3])


def test_every_axis_and_member_draws_its_own_noise_and_draws_it_again():
    def noise(axes, **more):
        made = scenario(duration=DURATION, noise=axes, ensemble=2, key=KEY, **more)
        return np.asarray(made.noise)

    white = noise(WhiteNoise(2.0))
    together = np.corrcoef(white.reshape(5000, -1).T)
    # Standard error of a correlation over 5000 samples: 0.014.
    assert np.abs(together - np.eye(6)).max() < 0.07
    assert white.std() == pytest.approx(2.0, rel=0.02)
    assert np.array_equal(noise({"yaw": WhiteNoise(2.0)})[:, 2], white[:, 2])
    assert np.array_equal(noise(WhiteNoise(2.0), disturbance=Gust(0.1)), white)


@pytest.fixture(scope="module")
def gusts():
    """200 draws of a control-equivalent gust: K = 0.05 V/sqrt(s), a = 3 rad/s, 0.0234 N m/V."""
    gust = ceti_gust(0.05, 3.0, torque_gain=0.0234)
    made = scenario(duration=DURATION, axes=1, disturbance=gust, ensemble=200, key=KEY)
    return np.asarray(made.disturbance)[:, 0]


def test_a_gust_is_stationary_from_its_first_sample(gusts):
    variance = (0.05 * 0.0234) ** 2 / (2 * 3.0)
    # chi-squared with 200 degrees of freedom: a standard error of 10 %.
    for sample in (0, 100, 4999):
        assert gusts[sample].var() == pytest.approx(variance, rel=0.3)
    assert gusts.var() == pytest.approx(variance, rel=0.05)


def test_the_spectrum_of_a_gust_is_that_of_white_noise_through_a_lag(gusts):
    window = np.hanning(5000)[:, None]
    spectra = np.abs(np.fft.rfft(gusts * window, axis=0)) ** 2 * DT / np.sum(window**2)
    omega = 2 * np.pi * np.fft.rfftfreq(5000, DT)
    band = (omega > 1.0) & (omega < 100.0)
    exact = (0.05 * 0.0234) ** 2 / (omega**2 + 3.0**2)
    ratio = spectra.mean(axis=1)[band] / exact[band]
    # 200 draws leave 7 % at each of 157 lines; sampling folds 1 % back at 100 rad/s.
    assert np.abs(ratio - 1).max() < 0.3 and ratio.mean() == pytest.approx(1, abs=0.02)


def test_amplitudes_have_gradients():
    def total(amplitude):
        made = scenario(
            duration=1.0, reference={"roll": Step(amplitude, at=0.5) + Sine(amplitude, period=2.0)}
        )
        return jnp.sum(made.reference)

    expected = 250 + np.sin(np.pi * TIME[:500]).sum()
    assert jax.grad(total)(0.3) == pytest.approx(expected, rel=1e-12)
    assert jax.jit(total)(0.3) == pytest.approx(0.3 * expected, rel=1e-12)


def test_a_user_adds_a_signal_in_a_few_lines():
    class Decay(Signal):
        amplitude: float

        def sample(self, clock, key):
            return Motion(self.amplitude * jnp.exp(-jnp.asarray(clock.time)))

    np.testing.assert_allclose(roll(Decay(0.2) + Step(0.1)), 0.1 + 0.2 * np.exp(-TIME), rtol=1e-14)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: scenario(duration=-1.0), "duration is -1.0"),
        (lambda: scenario(duration=0.0333), "not a whole number"),
        (lambda: scenario(duration=1.0, axes=0), "axes is 0"),
        (lambda: roll(1.0), r"jq.Step\(1.0\)"),
        (lambda: roll(np.zeros(3)), "3 samples does not fit the scenario's 5000"),
        (lambda: roll(Step(1.0, at=10.0)), "the scenario ends before 10 s"),
        (lambda: roll(Step(1.0, at=0.0011)), "at of 0.0011 s is 0.55 samples"),
        (lambda: roll(Step(np.nan)), "after is nan"),
        (lambda: roll(Sine(1.0, period=0.003)), "more than two samples a period"),
        (lambda: roll(WhiteNoise(1.0)), "key=jax.random.key"),
        (lambda: Pulse(1.0, width=3.0, period=2.0), "longer than its period"),
        (lambda: Pulse(1.0), "either a width in s or a share"),
        (lambda: Pulse(1.0, share=0.5), "give the period"),
        (lambda: Pulse(1.0, share=1.5, period=1.0), "between 0 and 1"),
        (lambda: Gust(-1.0), "deviation is -1.0"),
        (lambda: ceti_gust(1.0, 0.0), "pole is 0.0"),
        (lambda: Ramp(1.0, within=0.0), "within is 0.0"),
        (
            lambda: scenario(duration=1.0, reference={"rol": Step(1.0)}),
            "choose one of roll, pitch, yaw",
        ),
        (
            lambda: scenario(duration=1.0, reference={"roll": Step(1.0), 0: Step(1.0)}),
            "given twice",
        ),
        (
            lambda: scenario(
                duration=1.0, reference={"roll": Step([1.0, 2.0]), "yaw": Step([1.0, 2.0, 3.0])}
            ),
            r"reference: .* \(2,\), \(3,\)",
        ),
        (
            lambda: Scenario(*(jnp.zeros(s) for s in [(5, 3, 2), (5, 3), (5, 3, 4), (5, 3)])),
            "different shapes",
        ),
    ],
)
def test_what_makes_no_sense_is_refused_with_the_value_and_the_way_out(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_scenario_prints_its_shapes():
    assert "reference=f64[500,3]" in eqx.tree_pformat(scenario(duration=1.0))
