"""Bandwidths, margins and rejection against closed forms, python-control and simulation."""

import control
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from ratios import delayed_integrator, Ratio, ratio

import jaxquad as jq
from jaxquad.loops import attitude_bandwidth, disturbance_rejection, margins


pytestmark = pytest.mark.usefixtures("compiled_quickly")
LOOPS = {
    "servo": ([10.0], [1.0, 3.0, 2.0, 0.0]),
    "conditionally stable": ([2.0, 4.0, 2.0], [1.0, 0.0, 0.0, 0.0]),
    "several crossovers": (
        4 * np.polymul([1.0, 0.2, 4.0], [1.0]),
        np.polymul([1.0, 0.05, 1.0], np.polymul([1.0, 0.1, 9.0], [1.0, 0.0])),
    ),
    "unstable plant": ([6.0, 12.0], np.polymul([1.0, -1.0], [0.1, 1.0])),
    "unstable loop": ([30.0], [1.0, 3.0, 2.0, 0.0]),
}


@pytest.mark.slow
def test_bandwidth_of_a_delayed_integrator_is_the_closed_form():
    found = attitude_bandwidth(delayed_integrator(3.0, 0.2))
    w180 = np.pi / 2 / 0.2
    assert found.omega_180 == pytest.approx(w180, rel=1e-14)
    assert found.phase_bandwidth == pytest.approx(w180 / 2, rel=1e-14)
    assert found.gain_bandwidth == pytest.approx(w180 / 10**0.3, rel=1e-14)
    assert found.bandwidth == found.gain_bandwidth or found.bandwidth == found.phase_bandwidth
    assert found.bandwidth == pytest.approx(w180 / 2, rel=1e-14)
    assert found.phase_delay == pytest.approx(0.1, rel=1e-12)
    assert found.phase_delay_fit == pytest.approx(0.1, rel=1e-12)
    assert found.remarks == ()


@pytest.mark.slow
def test_a_rate_response_gives_the_bandwidth_of_its_attitude():
    rate = ratio([2.0], [0.05, 1.0], 0.15)
    attitude = ratio([2.0], [0.05, 1.0, 0.0], 0.15)
    for name in ("bandwidth", "omega_180", "phase_delay", "phase_delay_fit"):
        by_rate = getattr(attitude_bandwidth(rate, quantity="rate"), name)
        assert by_rate == pytest.approx(
            float(getattr(attitude_bandwidth(attitude), name)), rel=1e-12
        )


def test_phase_delay_fit_is_the_least_squares_line():
    found = attitude_bandwidth(ratio([2.0], [0.05, 1.0, 0.0], 0.15))
    omega = float(found.omega_180) * np.linspace(1, 2, 64)
    phase = -np.pi / 2 - np.arctan(0.05 * omega) - 0.15 * omega
    assert found.phase_delay_fit == pytest.approx(-np.polyfit(omega, phase, 1)[0] / 2, rel=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", LOOPS)
def test_margins_are_those_of_python_control(name):
    b, a = LOOPS[name]
    found = margins(ratio(b, a), unstable_poles=int(np.sum(np.roots(a).real > 1e-9)))
    gains, phases, distances, w180, crossovers, _ = control.stability_margins(
        control.tf(b, a), returnall=True
    )
    # Its roots of a polynomial of twice the degree are good to about 1e-8.
    listed = [np.asarray(x)[np.isfinite(x)] for x in (found.phase_crossovers, found.crossovers)]
    assert listed[0] == pytest.approx(np.sort(w180), rel=1e-7, abs=1e-9)
    assert listed[1] == pytest.approx(np.sort(crossovers), rel=1e-7)
    order = np.argsort(w180)
    assert np.asarray(found.gain_margins)[: order.size] == pytest.approx(gains[order], rel=1e-6)
    measured = np.degrees(np.asarray(found.phase_margins)[: crossovers.size])
    assert measured == pytest.approx(phases[np.argsort(crossovers)], abs=1e-5)
    peak = disturbance_rejection(ratio(b, a), unstable_poles=found.unstable_poles)
    if distances.size and np.min(distances) < 1 / float(peak.start):
        assert 1 / float(peak.peak) == pytest.approx(np.min(distances), rel=1e-6)


@pytest.mark.parametrize("name", LOOPS)
def test_unstable_roots_are_counted_by_nyquist(name):
    b, a = LOOPS[name]
    closed = np.roots(np.polyadd(a, b))
    found = margins(ratio(b, a), unstable_poles=int(np.sum(np.roots(a).real > 1e-9)))
    assert found.unstable_roots == float(np.sum(closed.real > 0))
    assert ("closed loop is unstable" in str(found)) == (found.unstable_roots > 0)


def test_wrong_number_of_unstable_poles_is_noticed():
    found = margins(ratio(*LOOPS["unstable plant"]), unstable_poles=0)
    assert "1 more unstable poles" in str(found)


@pytest.mark.slow
def test_the_gain_margin_of_an_unstable_plant_is_at_frequency_0():
    """10 / (s - 1) with unit feedback is stable for a gain above 0.1."""
    plant = lambda k: jq.TransferFunction(jnp.array([k]), [1.0, -1.0])
    result = margins(plant(10.0))
    assert result.gain_reduction == pytest.approx(0.1, rel=1e-12)
    assert result.reduction_crossover == 0 and np.isnan(result.gain_margin)
    assert result.unstable_poles == 1 and result.unstable_roots == 0
    assert "gain reduction         -20 dB at 0 rad/s" in str(result)
    slope = jax.grad(lambda k: margins(plant(k)).gain_reduction)(10.0)
    assert slope == pytest.approx(-0.01, rel=1e-12)


@pytest.mark.slow
def test_a_model_knows_its_unstable_poles():
    plant = jq.models.AttitudeAxis(0.2, 0.12, 0.05, lag=0.05, K_af=-0.01)
    assert margins(plant).unstable_poles == 1
    assert disturbance_rejection(plant).unstable_poles == 1
    assert margins(plant.transfer_function(), unstable_poles=0).unstable_poles == 0
    assert margins(jq.LaggedIntegrator(3.0, 0.1, integrators=2)).unstable_poles == 0
    growing = jq.StateSpace([[2.0, 0.0], [0.0, -1.0]], [[1.0], [1.0]], [[1.0, 1.0]])
    assert margins(growing).unstable_poles == 1


def test_margins_of_a_delayed_integrator_are_the_closed_form():
    found = margins(delayed_integrator(3.0, 0.2))
    margin = np.pi / 2 - 3.0 * 0.2
    assert found.crossover == pytest.approx(3.0, rel=1e-14)
    assert found.phase_margin == pytest.approx(margin, rel=1e-13)
    assert found.delay_margin == pytest.approx(margin / 3.0, rel=1e-13)
    assert found.gain_margin == pytest.approx(np.pi / 2 / 0.2 / 3.0, rel=1e-13)
    assert found.left_out > 0 and "farther from -1" in str(found)


def test_a_conditionally_stable_loop_has_a_lower_gain_margin_only():
    found = margins(ratio(*LOOPS["conditionally stable"]))
    assert found.gain_reduction == pytest.approx(0.25, rel=1e-12)  # stable for gains above 0.5
    assert np.isnan(found.gain_margin) and "no gain margin upwards" in str(found)


def test_delay_margin_brings_the_loop_to_the_verge():
    b, a = LOOPS["several crossovers"]
    found = margins(ratio(b, a))
    loop = ratio(b, a, found.delay_margin).frequency_response(found.delay_crossover[None])
    assert complex(loop[0, 0, 0]) == pytest.approx(-1, abs=1e-11)


def test_second_order_loop_has_the_textbook_peak_and_margin():
    zeta, wn = 0.3, 5.0
    loop = ratio([wn**2], [1.0, 2 * zeta * wn, 0.0])
    peak = disturbance_rejection(loop)
    assert peak.complementary_peak == pytest.approx(
        1 / (2 * zeta * np.sqrt(1 - zeta**2)), rel=1e-13
    )
    place = wn * np.sqrt(1 - 2 * zeta**2)
    assert peak.complementary_peak_frequency == pytest.approx(place, rel=1e-12)
    margin = np.arctan(2 * zeta / np.sqrt(np.sqrt(1 + 4 * zeta**4) - 2 * zeta**2))
    assert margins(loop).phase_margin == pytest.approx(margin, rel=1e-13)


def test_rejection_bandwidth_of_an_integrator_is_the_closed_form():
    level = 10 ** (-3 / 20)
    found = disturbance_rejection(delayed_integrator(4.0, 0.0))
    assert found.bandwidth == pytest.approx(4.0 * level / np.sqrt(1 - level**2), rel=1e-13)
    assert "edge of the band" in str(found)  # |S| rises to 1 at infinity


def test_rejection_from_the_sensitivity_is_that_from_the_loop():
    b, a = LOOPS["servo"]
    from_loop = disturbance_rejection(ratio(b, a))
    closed = ratio(a, np.polyadd(a, b))
    from_sensitivity = disturbance_rejection(closed, quantity="sensitivity")
    for name in ("bandwidth", "peak", "complementary_peak"):
        expected = float(getattr(from_loop, name))
        assert getattr(from_sensitivity, name) == pytest.approx(expected, rel=1e-11)


def qualities(model):
    found, margin, rejection = (
        attitude_bandwidth(model),
        margins(model),
        disturbance_rejection(model),
    )
    return {
        "bandwidth": found.bandwidth,
        "phase delay": found.phase_delay_fit,
        "phase margin": margin.phase_margin,
        "delay margin": margin.delay_margin,
        "gain margin": margin.gain_margin,
        "DRB": rejection.bandwidth,
        "DRP": rejection.peak,
        "peak frequency": rejection.peak_frequency,
    }


@pytest.mark.slow
def test_gradients_under_jit_are_the_central_differences():
    model, step = ratio([2.0], [0.05, 1.0, 0.3], 0.1), 1e-5

    def along(change):
        b, a = model.b + 2 * change * model.b, model.a + change * model.a**2
        return Ratio(b, a, model.delay + change)

    exact = jax.jit(jax.jacfwd(lambda change: qualities(along(change))))(jnp.asarray(0.0))
    above, below = qualities(along(step)), qualities(along(-step))
    for name, value in exact.items():
        difference = (float(above[name]) - float(below[name])) / (2 * step)
        assert value == pytest.approx(difference, rel=1e-6), name


@pytest.mark.slow
def test_reverse_gradients_do_not_suffer_from_what_does_not_exist():
    def lag(delay):
        return attitude_bandwidth(
            ratio([1.0], [0.3, 1.0, 0.0], 0.0 * delay + delay)
        ).phase_bandwidth

    def margin(delay):
        return margins(delayed_integrator(3.0, delay)).phase_margin

    assert jax.grad(margin)(jnp.asarray(0.2)) == pytest.approx(-3.0, rel=1e-12)
    assert np.isfinite(jax.grad(lag)(jnp.asarray(0.0)))


@pytest.mark.slow
def test_second_derivatives_of_a_crossing_are_right():
    cubic = ratio([1.0], [1.0, 0.0, 0.0, 0.0])

    def place(a):  # where a / w**3 is 1
        return margins(Ratio(a * cubic.b, cubic.a, cubic.delay)).crossover

    exact = -2 / 9 * 5.0 ** (-5 / 3)
    assert jax.jit(jax.hessian(place))(5.0) == pytest.approx(exact, rel=1e-12)


@pytest.mark.slow
def test_what_is_not_in_the_band_is_nan_with_a_reason():
    found = attitude_bandwidth(ratio([1.0], [1.0, 0.0]))
    assert np.isnan(found.bandwidth) and np.isnan(found.phase_delay)
    assert "no omega_180: the phase does not fall to -180 deg within 0.01..1000" in str(found)
    found = margins(ratio([0.5], [1.0, 1.0]))
    assert np.isnan(found.phase_margin) and np.isnan(found.gain_margin)
    assert "|L| does not pass 1" in str(found) and "L does not cross -180 deg" in str(found)
    found = disturbance_rejection(ratio([0.3], [1.0, 1.0]))
    assert np.isnan(found.bandwidth) and "above -3 dB" in str(found)


def test_rounding_around_minus_180_deg_is_no_crossing():
    found = margins(ratio([2.0], [0.7, 0.0, 0.0]))
    assert np.isnan(found.gain_margin)
    assert found.phase_margin == pytest.approx(0, abs=1e-12)
    assert found.delay_margin == pytest.approx(0, abs=1e-12)


def test_the_branch_of_the_phase_is_said_or_told():
    double = ratio([1.0], [1.0, 0.0, 0.0], 0.05)
    assert "phase_at_start" in str(attitude_bandwidth(double))  # 180 deg instead of -180
    turned = attitude_bandwidth(double, phase_at_start=-np.pi)
    assert np.isnan(turned.bandwidth) and "starts at -180 deg already" in str(turned)


def test_no_number_beyond_an_ambiguous_turn_of_the_phase():
    gap = np.append(np.geomspace(0.01, 1.0, 1995), [30.0, 60.0, 90.0, 120.0, 150.0])
    found = attitude_bandwidth(delayed_integrator(1.0, 0.1), omega=gap)
    assert np.isnan(found.bandwidth) and "below 1 rad/s, from where it turns" in str(found)
