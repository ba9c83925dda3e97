import control
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.models import (
    free_responses,
    simulate_linear,
    state_space,
    StateSpace,
    TransferFunction,
)


DT, SAMPLES, PARTS = 0.05, 200, 20
TIME = DT * np.arange(SAMPLES)
U = np.random.default_rng(0).standard_normal((SAMPLES, 2))


def plant(input_delay=(0.0, 0.0), output_delay=None, growth=0.0):
    """Four states, two inputs, three outputs, an acceleration among them; in samples of delay."""
    rng = np.random.default_rng(1)
    F = np.array([[-0.5, 3, 0, 0], [-3, -0.5, 1, 0], [0, 0, -6, 0], [0, 1, 0, 0.0]])
    H1 = np.zeros((3, 4))
    H1[2, :2] = 0.7, -0.4
    return StateSpace(
        F=F + growth * np.eye(4),
        G=rng.standard_normal((4, 2)),
        H0=rng.standard_normal((3, 4)),
        H1=H1,
        M=np.eye(4) + 0.1 * rng.standard_normal((4, 4)),
        input_delay=DT * np.array(input_delay),
        output_delay=None if output_delay is None else DT * np.array(output_delay),
    )


def explicit(model):
    F, G, H0, H1, M = (np.asarray(x) for x in (model.F, model.G, model.H0, model.H1, model.M))
    A, B = np.linalg.solve(M, F), np.linalg.solve(M, G)
    return A, B, H0 + H1 @ A, H1 @ B


def by_control(model, u, dt, hold):
    """(samples, outputs) without delays: held inputs by a discrete system, straight by lsim."""
    system = control.ss(*explicit(model))
    if hold == "zero":
        system = control.c2d(system, dt, "zoh")
    response = control.forced_response(system, dt * np.arange(len(u)), u.T)
    return np.transpose(response.outputs)  # pyright: ignore


def by_fine_steps(model, hold, input_delay, output_delay):
    """The same at steps so short that every delay is whole, moved by whole steps."""
    fine = np.arange(PARTS * SAMPLES) / PARTS
    at = np.floor(fine + 1e-9).astype(int)
    if hold == "zero":
        dense = U[at]
    else:
        dense = np.stack([np.interp(fine, np.arange(SAMPLES), u) for u in U.T], axis=1)
    late = lambda x, by: np.concatenate([np.zeros(round(by * PARTS)), x])[: len(x)]
    dense = np.stack([late(u, by) for u, by in zip(dense.T, input_delay, strict=True)], axis=1)
    # Straight pieces of a late input start with a jump from zero that no interpolation shows.
    alone = [by_control_alone(model, dense, k, input_delay[k], hold) for k in range(2)]
    found = np.sum(alone, axis=0)
    return np.stack([late(y, by) for y, by in zip(found.T, output_delay, strict=True)], 1)[::PARTS]


def by_control_alone(model, dense, k, delay, hold):
    start = round(delay * PARTS)
    only = np.zeros_like(dense)
    only[:, k] = dense[:, k]
    found = by_control(model, only[start:], DT / PARTS, hold)
    return np.concatenate([np.zeros((start, found.shape[1])), found])


def assert_close(found, expected):
    scale = np.abs(expected).max(axis=0)
    found = np.asarray(found)
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0, atol=1e-9)


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize("growth", [0.0, 1.0])
def test_outputs_without_delays_are_those_of_python_control(hold, growth):
    model = plant(growth=growth)
    assert_close(simulate_linear(model, U, DT, hold=hold), by_control(model, U, DT, hold))


@pytest.mark.parametrize("hold", ["zero", "first"])
@pytest.mark.parametrize(
    ("input_delay", "output_delay"),
    [
        ((2.0, 1.0), (0.0, 3.0, 1.0)),
        ((0.3, 2.75), (0.0, 0.0, 0.0)),
        ((0.3, 2.75), (0.85, 1.0, 0.7)),
        ((0.0, 1.4), (0.6, 2.6, 1.95)),
    ],
)
def test_late_inputs_and_outputs_are_exact_within_a_sample(hold, input_delay, output_delay):
    found = simulate_linear(plant(input_delay, output_delay), U, DT, hold=hold)
    assert_close(found, by_fine_steps(plant(), hold, input_delay, output_delay))


def test_a_single_channel_is_the_transfer_function_it_came_from():
    model = TransferFunction([2.0, 1.0, 5.0], [4.0, 1.0, 9.0], 0.37 * DT)
    found = simulate_linear(state_space(model), U[:, :1], DT)
    expected = simulate_linear(model, U[:, 0], DT)
    np.testing.assert_allclose(found[:, 0], expected, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_the_output_changes_with_every_delay_as_finite_differences_say():
    none = lambda x: x is None

    def total(late):
        model = eqx.tree_at(
            lambda m: (m.input_delay, m.output_delay), plant(), (late[:2], late[2:]), is_leaf=none
        )
        return jnp.sum(simulate_linear(model, U, DT, hold="first")[20:] ** 2)

    at, way, h = DT * jnp.array([0.3, 1.6, 0.2, 0.45, 2.55]), jnp.array([1, -2, 3, 4, -5.0]), 1e-7
    along = jax.jit(lambda at: jax.jvp(total, (at,), (way,)))
    difference = (along(at + h * way)[0] - along(at - h * way)[0]) / (2 * h)
    assert float(along(at)[1]) == pytest.approx(float(difference), rel=1e-5)  # rounding over h


def test_free_responses_continue_a_state_and_add_a_bias_to_its_derivative():
    late = (0.5, 0.0, 2.0)
    start, bias = free_responses(plant(output_delay=late), SAMPLES, DT)
    assert start.shape == bias.shape == (SAMPLES, 3, 4)
    A, _, C, _ = explicit(plant())
    H1, x0 = np.asarray(plant().H1), np.array([1.0, -2.0, 0.5, 3.0])
    values, vectors = np.linalg.eig(A)
    for output, delay in enumerate(late):
        # By the modes of A, which has an eigenvalue of 0: its integral is time.
        t = TIME[:, None] - delay * DT
        motion = np.exp(values * t) * np.linalg.solve(vectors, x0)
        expected = np.real(motion @ vectors.T @ C[output])
        np.testing.assert_allclose(start[:, output] @ x0, expected, atol=1e-10)
        zero = np.abs(values) < 1e-12
        grown = np.where(zero, t, np.expm1(values * t) / np.where(zero, 1, values))
        pushed = (grown * np.linalg.solve(vectors, x0)) @ vectors.T
        expected = np.real(pushed @ C[output]) + H1[output] @ x0
        np.testing.assert_allclose(bias[:, output] @ x0, expected, atol=1e-10)


def test_inputs_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"u has the shape \(200, 1\).*\(samples, 2\)"):
        simulate_linear(plant(), U[:, :1], DT)
    with pytest.raises(ValueError, match=r"u has the shape \(200, 2\).*\(samples,\)"):
        simulate_linear(TransferFunction([1.0], [1.0, 1.0]), U, DT)
