"""Output-error estimates in the time domain."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from scipy.optimize import least_squares
from scipy.signal import dlsim, lfilter

import jaxquad as jq
from jaxquad.identify import integrate_plant, refine
from jaxquad.models import StateSpace


DT, SAMPLES = 0.02, 1000
TIME = DT * np.arange(SAMPLES)
TRUTH = jq.TransferFunction([8.0], [1.0, 3.0, 20.0], 0.03)
START = jq.TransferFunction([10.0], [1.0, 2.0, 26.0], 0.02)
FREE = ("numerator[0]", "denominator[1]", "denominator[2]", "delay")
VALUES = np.array([8.0, 3.0, 20.0, 0.03])
U = np.repeat(np.random.default_rng(0).choice([-1.0, 1.0], SAMPLES // 25), 25)


def noise(seed, pole=0.0):
    """First-order coloured, of standard deviation 1."""
    white = np.random.default_rng(seed).standard_normal(SAMPLES + 500)
    return np.asarray(lfilter([np.sqrt(1 - pole**2)], [1, -pole], white))[500:]


def refined(y, u=U, start=START, **options):
    return refine(start, jq.Record(TIME, u, y, **options), free=FREE, hold="zero")


def late_by_scipy(x, u):
    """A held input that is 1 to 2 samples late, by matrix exponentials; any start."""
    gain, damping, stiffness, delay = x[:4]
    system = np.zeros((3, 3))
    system[:2] = [[0, 1, 0], [-stiffness, -damping, gain]]
    part = delay / DT - 1
    old, new = (expm(system * DT * share) for share in (part, 1 - part))
    B = np.stack([new[:2, 2], new[:2, :2] @ old[:2, 2]], axis=1)
    before = np.concatenate([np.full(2, u[0]), u])
    held = np.stack([before[1:-1], before[:-2]], axis=1) - u[0]
    C, D = np.array([[1.0, 0]]), np.zeros((1, 2))
    return dlsim((new[:2, :2] @ old[:2, :2], B, C, D, DT), held, x0=x[4:6])[1][:, 0] + x[6]


CLEAN = late_by_scipy([*VALUES, 0.0, 0.0, 0.0], U)


def lagged_angle(u, gain=8.0, lag=0.1, late=3):
    """K / (s (lag s + 1)) of a held input that is some samples late, with little noise."""
    held = np.concatenate([np.full(late, u[0]), u])[: u.size]
    a = np.exp(-DT / lag)
    rate = lfilter([0.0, gain * (1 - a)], [1.0, -a], held)
    y = lfilter([0.0, DT / 2, DT / 2], [1.0, -1.0], np.append(rate[1:], rate[-1]))
    return y + 0.02 * np.std(y) * noise(4)


@pytest.mark.slow
@pytest.mark.parametrize("start", [(-8.0, 0.1, 0.05), (-4.0, 0.2, 0.02)])
def test_from_the_wrong_sign_nothing_is_called_determined(start):
    fit = refine(jq.LaggedIntegrator(*start), jq.Record(TIME, U, lagged_angle(U)))
    assert fit.verdict.kind in ("no minimum", "no model") and not fit.determined.any()
    table = [line for line in str(fit).splitlines() if line.startswith(fit.names)]
    assert len(table) == 3 and all("not determined" in line for line in table)


@pytest.mark.slow
def test_a_refinement_that_stops_early_says_so_and_keeps_its_numbers_apart():
    fit = refined(CLEAN + 0.05 * noise(1))
    short = refine(START, jq.Record(TIME, U, CLEAN + 0.05 * noise(1)), free=FREE, max_steps=1)
    assert fit.identifiable and not short.determined.any() and np.isfinite(short.values).all()
    assert "has not converged: the maximum of 1" in str(short)
    assert "max_steps=" in short.verdict.remedies[0]


@pytest.mark.slow
def test_the_estimate_is_that_of_scipy_over_all_unknowns():
    y = late_by_scipy([*VALUES, 0.1, -0.5, 0.3], U) + 0.05 * noise(1)
    start = [8.5, 2.8, 21.0, 0.028, 0, 0, 0]
    expected = least_squares(lambda x: y - late_by_scipy(x, U), start, x_scale="jac", xtol=1e-12)
    fit = refined(y)
    # Where scipy's finite differences stop; the standard errors are 1e-2 of the values.
    np.testing.assert_allclose(fit.values, expected.x[:4], rtol=1e-4)
    assert fit.newton_decrement < 1e-6
    assert fit.cost == pytest.approx(SAMPLES, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("pole", [0.0, 0.9])
def test_standard_errors_are_the_scatter_under_white_and_coloured_noise(pole):
    fits = [refined(CLEAN + 0.05 * noise(seed, pole), start=TRUTH) for seed in range(60)]
    errors = np.array([fit.values for fit in fits]) - VALUES
    predicted = np.array([fit.standard_errors for fit in fits])
    # Of 60 draws: a scatter is known to 9 %, a coverage of 95 % to 2.8 %; three times that.
    ratio = errors.std(axis=0) / np.sqrt(np.mean(predicted**2, axis=0))
    np.testing.assert_array_less(np.abs(ratio - 1), 0.27)
    covered = np.mean(np.abs(errors) < 1.96 * predicted, axis=0)
    assert np.all(covered > 0.86) and np.mean(covered) > 0.90
    coloured = [any("coloured" in remark for remark in fit.remarks) for fit in fits]
    assert all(coloured) if pole else np.mean(coloured) < 0.1


def both_domains(seed):
    record = jq.Record(TIME, U, CLEAN + 0.05 * noise(seed))
    frf = jq.frequency_response(record, np.geomspace(1.5, 15.0, 40))
    by_frequency = jq.fit(START, frf, free=FREE)
    return refine(by_frequency.model, record, free=FREE, hold="zero"), by_frequency


@pytest.mark.slow
def test_time_and_frequency_domain_agree_within_their_errors():
    by_time, by_frequency = both_domains(2)
    assert by_time.names == by_frequency.names and by_time.identifiable
    late = np.array([0, 0, 0, DT / 2])  # of the held input, which a response includes
    apart = by_time.values + late - by_frequency.values
    errors = np.hypot(by_time.standard_errors, by_frequency.standard_errors)
    np.testing.assert_array_less(np.abs(apart), 3 * errors)
    settling = by_time.derived(lambda m: 2 / m.denominator[1], "time constant")
    assert settling.value == pytest.approx(2 / 3, abs=3 * settling.standard_error)
    assert "numerator[0]" in str(by_time)


@pytest.mark.slow
def test_the_time_domain_is_the_sharper_one():
    # Each error is itself known to some per cent: their mean over draws is compared.
    pairs = [[fit.standard_errors for fit in both_domains(seed)] for seed in range(2, 7)]
    by_time, by_frequency = np.mean(pairs, axis=0)
    np.testing.assert_array_less(by_time, by_frequency)


@pytest.mark.slow
def test_a_loop_that_may_be_closed_is_spoken_of():
    fit = refined(CLEAN + 0.05 * noise(3), references=U)
    assert any("output error is biased where feedback" in remark for remark in fit.remarks)
    assert fit.chi_squared == pytest.approx(1, abs=0.02)
    assert not any("any model" in remark for remark in fit.remarks)  # of every fit: no remark


@pytest.mark.slow
@pytest.mark.parametrize("hold", ["zero", "first"])
def test_a_transfer_function_and_its_state_space_give_one_estimate(hold):
    # The one is fitted by filters, the other by differentiating its simulation.
    y = late_by_scipy([*VALUES, 0.1, -0.5, 0.3], U) + 0.05 * noise(2, 0.8)
    record = jq.Record(TIME, U, y)
    fit = refine(START, record, free=FREE, hold=hold)
    plant = StateSpace(
        F=[[0.0, 1.0], [-26.0, -2.0]], G=[[0.0], [10.0]], H0=[[1.0, 0.0]], input_delay=[0.02]
    )
    free = ("G[1][0]", "F[1][1]", "F[1][0]", "input_delay[0]")
    other = refine(plant, record, free=free, hold=hold)
    signs = np.array([1.0, -1.0, -1.0, 1.0])
    np.testing.assert_allclose(fit.values, signs * other.values, rtol=1e-8)
    rest = signs[:, None] * other.covariance * signs
    np.testing.assert_allclose(fit.covariance, rest, rtol=1e-5, atol=1e-12)
    assert fit.cost == pytest.approx(other.cost, rel=1e-9)


def test_an_exact_record_gives_exact_values():
    fit = refined(CLEAN)
    np.testing.assert_allclose(fit.values, VALUES, rtol=1e-6)
    assert np.all(fit.standard_errors < 1e-5 * VALUES)


class Cubic(eqx.Module):
    """A pendulum with damping that grows with the cube of the rate."""

    stiffness: jax.Array
    damping: jax.Array
    cubic: jax.Array
    gain: jax.Array

    def init(self):
        return {"angle": jnp.zeros(()), "rate": jnp.zeros(())}

    def derivative(self, state, inputs, disturbance):
        angle, rate = state["angle"], state["rate"]
        drag = self.damping * rate + self.cubic * rate**3
        torque = self.gain * inputs[0] + disturbance
        return {"angle": rate, "rate": torque - self.stiffness * jnp.sin(angle) - drag}

    def measure(self, state):
        return state["angle"]


def cubic(*values):
    return Cubic(*(jnp.asarray(float(value)) for value in values))


@pytest.mark.slow
def test_a_pendulum_with_cubic_damping_is_recovered_from_any_initial_state():
    truth, count = np.array([20.0, 0.5, 0.8, 10.0]), 400
    u = U[:count]

    def slope(t, x, held):
        pull = truth[0] * np.sin(x[0]) + truth[1] * x[1] + truth[2] * x[1] ** 3
        return [x[1], truth[3] * held - pull]

    x, y = np.array([0.4, -1.0]), []
    for held in u:  # by scipy, sample by sample
        y.append(x[0])
        solved = solve_ivp(slope, (0, DT), x, args=(held,), rtol=1e-9, atol=1e-11)
        x = solved.y[:, -1]
    measured = np.array(y) + 0.01 * noise(4)[:count]
    record = jq.Record(TIME[:count], u, measured)
    fit = refine(cubic(23.0, 0.8, 0.5, 11.0), record, hold="zero")
    assert fit.identifiable and fit.newton_decrement < 1e-4
    np.testing.assert_array_less(np.abs(fit.values - truth), 3.5 * fit.standard_errors)
    np.testing.assert_array_less(fit.standard_errors / truth, 0.2)
    with pytest.raises(ValueError, match="measures 1 outputs, the record has y1"):
        refine(cubic(*truth), jq.Record(TIME[:count], u, np.stack([y, u], axis=1)))
    with pytest.raises(ValueError, match="cannot be integrated"):
        refine(cubic(20.0, 0.5, -5.0, 10.0), record)  # the rate runs away in finite time


@pytest.mark.slow
def test_a_linear_plant_integrates_to_its_exact_discretisation():
    @jax.jit
    def both(values):
        stiffness, damping, gain = values
        plant = Oscillator(stiffness, damping, gain)
        solved = integrate_plant(plant, jnp.asarray(U[:300, None]), jnp.zeros(2), DT, "first")[:, 0]
        one = jnp.ones(())
        exact = jq.TransferFunction(gain[None], jnp.stack([one, damping, stiffness]))
        return solved, jq.models.simulate_linear(exact, U[:300], DT, hold="first")

    at, way = jnp.array([20.0, 3.0, 8.0]), jnp.array([1.0, 1.0, 1.0])
    (solved, exact), (slope, expected) = jax.jvp(both, (at,), (way,))
    np.testing.assert_allclose(solved, exact, rtol=0, atol=1e-6 * np.max(np.abs(exact)))
    assert np.all(np.isfinite(slope))
    np.testing.assert_allclose(slope, expected, rtol=0, atol=1e-6 * np.max(np.abs(expected)))


class Oscillator(eqx.Module):
    stiffness: jax.Array
    damping: jax.Array
    gain: jax.Array

    def init(self):
        return jnp.zeros(2)

    def derivative(self, state, inputs, disturbance):
        pull = self.gain * inputs[0] - self.stiffness * state[0] - self.damping * state[1]
        return jnp.stack([state[1], pull + disturbance])

    def measure(self, state):
        return state[0]


@pytest.mark.slow
def test_twelve_parameters_of_two_inputs_and_three_outputs_are_recovered():
    F = np.array([[-1.0, 2.0, 0.3], [-4.0, -1.5, 0.8], [0.2, -0.6, -0.7]])
    G = np.array([[1.0, 0.0], [0.5, 2.0], [0.0, 1.5]])
    truth = StateSpace(F=F, G=G, H0=np.eye(3))
    rng = np.random.default_rng(5)
    u = np.repeat(rng.choice([-1.0, 1.0], (SAMPLES // 20, 2)), 20, axis=0)
    clean = np.asarray(jq.models.simulate_linear(truth, u - u[0], DT))
    size = np.array([0.02, 0.1, 0.04])
    y = clean + size * rng.standard_normal(clean.shape) + [1.0, -2.0, 0.5]
    record = jq.Record(TIME, u, y, output_names=("u", "q", "w"))
    free = [f"F[{i}][{j}]" for i in range(3) for j in range(3)] + ["G[0][0]", "G[1][1]", "G[2][1]"]
    start = StateSpace(F=1.15 * F, G=0.85 * G, H0=np.eye(3))
    fit = refine(start, record, free=free, hold="zero", tied={"G[1][0]": lambda m: m.G[0, 0] / 2})
    expected = np.concatenate([F.reshape(-1), [1.0, 2.0, 1.5]])
    assert fit.identifiable
    np.testing.assert_array_less(np.abs(fit.values - expected), 3.5 * fit.standard_errors)
    # Each output under its own noise: the cost has one unit for each sample of each.
    assert fit.cost == pytest.approx(3 * SAMPLES, rel=0.02)
    check = jq.verify(fit.model, record, hold="zero")
    np.testing.assert_allclose([one.rms for one in check.outputs], size, rtol=0.1)
    np.testing.assert_allclose(check.shift, [1.0, -2.0, 0.5], atol=0.2)


@pytest.mark.slow
def test_what_two_records_cannot_tell_apart_is_said_and_resolved_by_a_prior():
    """Within a band that leaves the drift of the integrators out."""
    truth = jq.models.AttitudeAxis(L=0.2, K_t=0.12, J_x=0.05, lag=0.05)
    clean = np.asarray(jq.models.simulate_linear(truth.transfer_function(), U - U[0], DT))
    drift = np.sin(0.3 * TIME)
    records = [jq.Record(TIME, U, clean + 0.01 * noise(k) + 0.1 * drift) for k in (6, 7)]
    start = jq.models.AttitudeAxis(L=0.2, K_t=0.15, J_x=0.07, lag=0.05)
    known = jq.identify.Prior("K_t", 0.12, 0.003)
    options = {"free": ("J_x", "K_t"), "hold": "zero", "band": (1.0, 40.0)}
    fit = refine(start, records, **options, priors=[known])
    [told] = [remark for remark in fit.remarks if "by the prior alone" in remark]
    assert "by the prior alone; the record by itself determines only L K_t / J_x" in told
    assert fit.identifiable
    np.testing.assert_array_less(np.abs(fit.values - [0.05, 0.12]), 3 * fit.standard_errors)
    assert fit.standard_errors[1] == pytest.approx(0.003, rel=0.05)
    ratio = fit.derived(lambda m: m.gain)
    assert ratio.value == pytest.approx(0.48, abs=4 * ratio.standard_error)
    assert ratio.standard_error < 0.003


def test_what_cannot_be_refined_is_refused():
    record = jq.Record(TIME, U, CLEAN)
    with pytest.raises(ValueError, match="unstable .*within 19.98 s"):
        refine(jq.TransferFunction([1.0], [1.0, -9.0]), record, free="numerator[0]")
    with pytest.raises(ValueError, match="needs a jq.Record or a list of them, not nothing"):
        refine(START, [])
    with pytest.raises(ValueError, match="hold is .cubic.: give .first."):
        refine(START, record, hold="cubic")
    with pytest.raises(ValueError, match="one input and one output"):
        refine(START, jq.Record(TIME, U, np.stack([CLEAN, U], axis=1)))
    with pytest.raises(ValueError, match="Nyquist frequency 157.1"):
        refine(START, record, band=(1.0, 200.0))
    with pytest.raises(ValueError, match="has no transfer_function"):
        refine(jq.models.Attitude((0.05, 0.05, 0.1)), record, free="inertia")
    with pytest.raises(ValueError, match="no parameter 'mass' for a prior"):
        refine(START, record, priors=[jq.identify.Prior("mass", 1.0, 0.1)])
