"""State spaces without structure or start, from responses of many pairs."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from synthetic import response_of

import jaxquad as jq


OMEGA = np.geomspace(0.3, 60.0, 40)


def random_plant(seed, states):
    """Two inputs and outputs; modes between 1 and 15 rad/s, in random coordinates."""
    rng, F, k = np.random.default_rng(seed), np.zeros((states, states)), 0
    while k < states:
        w, zeta = np.exp(rng.uniform(0.0, np.log(15.0))), rng.uniform(0.1, 0.9)
        pair = states - k > 1 and rng.random() < 0.6
        real, imag = (zeta * w, w * np.sqrt(1 - zeta**2)) if pair else (w, 0.0)
        width = 2 if pair else 1
        F[k : k + width, k : k + width] = np.array([[-real, imag], [-imag, -real]])[:width, :width]
        k += width
    T = rng.normal(size=(states, states))
    G, H = rng.normal(size=(states, 2)), rng.normal(size=(2, states))
    return jq.StateSpace(T @ F @ np.linalg.inv(T), T @ G, H @ np.linalg.inv(T))


def response(model, omega=OMEGA):
    return np.asarray(model.frequency_response(jnp.asarray(omega)))


def distance(poles, others):
    """From each pole to the nearest of the others, relative."""
    return np.min(np.abs(np.subtract.outer(poles, others)), axis=1) / np.abs(poles)


@pytest.mark.slow
@pytest.mark.parametrize("states", [2, 3, 4, 5, 6])
def test_a_response_without_noise_is_reproduced_and_its_order_found(states, compiled_quickly):
    truth = random_plant(states, states)
    fit = jq.fit_state_space(response_of(truth, error=1e-6, omega=OMEGA))
    assert len(fit.poles) == states and fit.identifiable
    assert np.max(np.abs(response(fit.model) / response(truth) - 1)) < 1e-6
    assert np.max(distance(truth.poles, fit.poles)) < 1e-6
    assert fit.singular_values[states] < 1e-4 * fit.singular_values[states - 1]


@pytest.mark.slow
def test_bands_and_poles_cover_the_truth(compiled_quickly):
    inside_bands, inside_poles = [], []
    for seed in range(100):
        truth = random_plant(100 + seed, 3)
        frf = response_of(truth, error=0.03, seed=seed, omega=OMEGA)
        fit = jq.fit_state_space(frf, 3, delay=0.0)
        band = fit.response_band(OMEGA[::4])
        ratio = response(truth, OMEGA[::4]) / band.response
        inside_bands.append(np.abs(20 * np.log10(np.abs(ratio))) <= band.decibels)
        inside_bands.append(np.abs(np.degrees(np.angle(ratio))) <= band.degrees)
        poles, reach = fit.poles, fit.pole_reach
        off = truth.poles[np.argmin(np.abs(np.subtract.outer(poles, truth.poles)), axis=1)] - poles
        inside_poles += [*(np.abs(np.real(off)) <= np.real(reach))]
        inside_poles += [*(np.abs(np.imag(off)) <= np.imag(reach))[np.imag(poles) != 0]]
    assert 0.93 < np.mean(inside_bands) < 0.97
    assert 0.93 < np.mean(inside_poles) < 0.97


LOOP_RATE = 50.0  # Hz


def closed_loop_record(plant, gain, noise, seed, samples=3000):
    """u = r - gain y, held for a sample; white noise on what is measured."""
    dt, states = 1 / LOOP_RATE, len(plant.F)
    both = np.zeros((states + 2, states + 2))
    both[:states] = np.concatenate([plant.F, plant.G], axis=1)
    step = expm(both * dt)
    rng, x = np.random.default_rng(seed), np.zeros(states)
    r, y, u = 5 * rng.normal(size=(samples, 2)), np.zeros((samples, 2)), np.zeros((samples, 2))
    for k in range(samples):
        y[k] = plant.H0 @ x + noise * rng.normal(size=2)
        u[k] = r[k] - gain @ y[k]
        x = step[:states, :states] @ x + step[:states, states:] @ u[k]
    return jq.Record(dt * np.arange(samples), u, y, r if np.any(gain) else None, hold=dt)


# Two coupled axes, the first of which diverges with a time constant of 0.8 s.
DIVERGING = jq.StateSpace(
    F=[[0.0, 1.0, 0.0, 0.0], [4.0, -2.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0], [0.5, 0.0, -6.0, -3.0]],
    G=[[0.0, 0.0], [3.0, 0.5], [0.0, 0.0], [-1.0, 4.0]],
    H0=[[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
)


@pytest.mark.slow
def test_an_unstable_plant_is_identified_in_its_loop(compiled_quickly):
    record = closed_loop_record(DIVERGING, np.diag([6.0, 3.0]), 0.005, seed=0)
    fit = jq.fit_state_space(jq.frequency_response(record, np.geomspace(0.5, 40.0, 30)))
    assert len(fit.poles) == 4 and fit.chi_squared < 1.5
    k, reach = int(np.argmax(np.real(fit.poles))), np.real(fit.pole_reach)
    assert abs(fit.poles[k] - DIVERGING.poles[np.argmax(np.real(DIVERGING.poles))]) < 1.5 * reach[k]
    assert reach[k] < 0.01
    assert "black-box state space of order 4" in str(fit)


def subspace_model(record, order, rows=20):
    """A, B, C, D of a sampled state space by PO-MOESP, and least squares for B and D.

    Source: Verhaegen and Verdult, "Filtering and System Identification", sec. 9.6.
    """
    u, y = record.inputs, record.outputs
    columns = len(u) - 2 * rows + 1
    hankel = lambda x, first: np.vstack([x[first + k : first + k + columns].T for k in range(rows)])
    stacked = [hankel(u, rows), hankel(u, 0), hankel(y, 0), hankel(y, rows)]
    lower = np.transpose(np.linalg.qr(np.vstack(stacked).T)[1])
    inputs, outputs = u.shape[1], y.shape[1]
    past, first = rows * (2 * inputs + outputs), rows * inputs
    seen = np.linalg.svd(lower[past:, first:past])[0][:, :order]
    A = np.linalg.lstsq(seen[:-outputs], seen[outputs:], rcond=None)[0]
    C, power = seen[:outputs], np.zeros((inputs * order, order))
    state = np.zeros((len(u), inputs * order, order))
    for k in range(1, len(u)):  # the state that each entry of B alone would cause
        power = power @ A.T + np.kron(u[k - 1][:, None], np.eye(order))
        state[k] = power
    driven = np.moveaxis(state @ C.T, 1, 2).reshape(-1, inputs * order)
    direct = np.kron(u[:, None, :], np.eye(outputs)[:, :, None]).reshape(len(u) * outputs, -1)
    parts = np.linalg.lstsq(np.concatenate([driven, direct], axis=1), y.reshape(-1), rcond=None)[0]
    B = parts[: inputs * order].reshape(inputs, order).T
    return A, B, C, parts[inputs * order :].reshape(outputs, inputs)


@pytest.mark.slow
def test_it_is_as_exact_as_a_subspace_method_that_knows_the_order(compiled_quickly):
    omega, errors = np.geomspace(0.5, 40.0, 30), []
    plant = random_plant(3, 3)
    for seed in range(3):
        record = closed_loop_record(plant, np.zeros((2, 2)), 0.05, seed)
        frf = jq.frequency_response(record, omega)
        truth = response(jq.identify.as_sampled(plant, frf), omega)
        A, B, C, D = subspace_model(record, 3)
        z = np.exp(1j * omega / LOOP_RATE)[:, None, None]
        others = C @ np.linalg.solve(z * np.eye(3) - A, B) + D
        fit = jq.fit_state_space(frf)
        mine = response(jq.identify.as_sampled(fit.model, frf), omega)
        errors.append([np.sqrt(np.mean(np.abs(x / truth - 1) ** 2)) for x in (mine, others)])
    ours, theirs = np.mean(errors, axis=0)
    assert ours < 1.1 * theirs and ours < 0.01


def test_what_cannot_be_fitted_is_refused_with_a_way_out():
    truth = random_plant(2, 2)
    frf = response_of(truth, omega=OMEGA)
    for order in (0, -1, True):
        with pytest.raises(ValueError, match="whole number of states"):
            jq.fit_state_space(frf, order)
    with pytest.raises(ValueError, match='give "free", or 0 or more in s'):
        jq.fit_state_space(frf, delay=-0.1)
    with pytest.raises(jq.identify.UndeterminedError, match="ask for a lower order"):
        jq.fit_state_space(response_of(truth, omega=OMEGA[::4]), 12)
    silent = response_of(truth, omega=OMEGA)
    error = np.array(silent.random_error)
    error[:, 1, 0] = 2.0
    silent = dataclasses.replace(silent, random_error=jnp.asarray(error))
    with pytest.raises(jq.identify.UndeterminedError, match="y1 answers to u0 at no usable"):
        jq.fit_state_space(silent)


@pytest.mark.slow
def test_a_response_that_shows_fewer_states_says_so(compiled_quickly):
    frf = response_of(random_plant(2, 2), seed=0, omega=OMEGA)
    fit = jq.fit_state_space(frf, 3, delay=0.0)
    assert any("2 states explain the response as well as 3" in remark for remark in fit.remarks)
