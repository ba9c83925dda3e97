import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.control import certainty_equivalence, FuzzyMap, InertiaMap, printed_map


TORQUE_GAIN, INERTIA = 0.0468, 0.0552
run = eqx.filter_jit(lambda function, *args: function(*args))
SPREAD = INERTIA * jnp.array([[0.05, 0.21, 0.7, 1.0], [1.3, 2.9, 4.9, 30.0]])  # axes, members


def test_certainty_equivalence_is_torque_gain_over_inertia_within_its_span_and_level_beyond():
    b0 = np.asarray(run(certainty_equivalence(TORQUE_GAIN, INERTIA), SPREAD))
    held = np.clip(np.asarray(SPREAD), 0.2 * INERTIA, 5 * INERTIA)
    np.testing.assert_allclose(b0, TORQUE_GAIN / held, rtol=1e-13)


def test_a_map_may_differ_by_axis_and_member():
    gain = np.array([[0.04, 0.05, 0.06, 0.07], [0.01, 0.02, 0.03, 0.04]])
    chart = certainty_equivalence(jnp.asarray(gain), INERTIA, factor=1.8)
    at = INERTIA * np.array([[0.5, 1.0, 2.0, 3.0], [0.5, 1.0, 2.0, 3.0]])
    assert chart.ensemble == (4,)
    np.testing.assert_allclose(run(chart, jnp.asarray(at)), 1.8 * gain / at, rtol=1e-13)


def test_any_map_is_the_straight_line_between_its_knots():
    knots, values = [-1.0, -0.2, 0.1, 1.4], [1.0, 0.3, 0.2, -1.0]
    x = np.linspace(-2, 2, 81)
    b0 = run(InertiaMap(INERTIA, knots, values), jnp.asarray(INERTIA * np.exp(x)))
    np.testing.assert_allclose(np.log(b0), np.interp(x, knots, values), atol=1e-14)


def test_the_gradient_to_the_values_is_the_share_of_each_knot():
    chart = InertiaMap(INERTIA, [-1.0, 0.0, 1.0], [0.5, 0.0, -0.5])
    at = jnp.array([INERTIA * np.exp(0.25)])
    log_b0 = lambda values: jnp.log(InertiaMap(INERTIA, chart.knots, values)(at))[0]
    np.testing.assert_allclose(run(jax.grad(log_b0), chart.values), [0.0, 0.75, 0.25], atol=1e-14)


def test_an_estimate_that_is_negative_or_zero_gives_the_first_knot_and_finite_gradients():
    chart = certainty_equivalence(TORQUE_GAIN, INERTIA)
    b0, slope = run(
        jax.vmap(jax.value_and_grad(lambda J: chart(J[None])[0])), jnp.array([-1.0, 0.0])
    )
    np.testing.assert_allclose(b0, TORQUE_GAIN / (0.2 * INERTIA), rtol=1e-13)
    np.testing.assert_array_equal(slope, 0.0)


def test_a_map_tells_whether_it_falls():
    assert certainty_equivalence(TORQUE_GAIN, INERTIA).falls
    assert not InertiaMap(INERTIA, [-1.0, 0.0, 1.0], [0.5, 0.0, 0.1]).falls


def test_triangular_sets_with_averaged_outputs_are_a_piecewise_linear_map():
    """Partition of unity: so a fuzzy controller of one input is an interpolation table."""
    centres, increments = np.array([0.5, 0.8, 1.0, 1.7, 3.0]), np.array([2.0, 1.0, 0.5, 0.2, -0.3])
    fuzzy = FuzzyMap(INERTIA, 1.0, centres, increments)
    delta = np.linspace(0.2, 4.0, 200)
    straight = 1.0 + np.interp(delta, centres, increments)
    np.testing.assert_allclose(run(fuzzy, jnp.asarray(delta * INERTIA)), straight, atol=1e-14)


def test_the_printed_map_is_one_straight_line_that_only_raises_b0():
    delta = np.array([0.3, 1.0, 1.875, 7.5, 22.0, 40.0])
    b0 = np.asarray(run(printed_map(INERTIA), jnp.asarray(delta * INERTIA)))
    np.testing.assert_allclose(b0, 3 + 24 / 21 * (np.clip(delta, 1, 22) - 1), atol=1e-13)
    assert b0[2] == pytest.approx(4.0) and b0[-1] == pytest.approx(27.0) and np.all(b0 >= 3)


def test_maps_follow_the_precision_of_their_input():
    at = jnp.array([0.05], jnp.float32)
    for chart in (certainty_equivalence(TORQUE_GAIN, INERTIA), printed_map(INERTIA)):
        assert run(chart, at).dtype == jnp.float32


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: InertiaMap(INERTIA, [0.0, 0.0], [1.0, 1.0]), "two or more that rise"),
        (lambda: InertiaMap(INERTIA, [0.0, 1.0], [1.0, 1.0, 1.0]), "2 knots"),
        (lambda: InertiaMap(0.0, [0.0, 1.0], [1.0, 1.0]), "nominal is 0.0"),
        (lambda: certainty_equivalence(TORQUE_GAIN, INERTIA, span=(2.0, 1.0)), "low < high"),
        (lambda: FuzzyMap(INERTIA, 1.0, [0.0, 1.0], [0.0, -1.0]), "lowest increment"),
        (lambda: FuzzyMap(INERTIA, 1.0, [0.0, 1.0], [0.0]), "2 sets"),
    ],
)  # fmt: skip
def test_bad_maps_are_refused(make, text):
    with pytest.raises(ValueError, match=text):
        make()
