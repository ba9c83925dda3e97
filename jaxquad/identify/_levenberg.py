"""Levenberg-Marquardt on the normal equations, one problem or a batch on trailing axes.

Built without LAPACK: `vmap` over LAPACK calls inside a loop can hang on few cores.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


TOLERANCE = 1e-8  # of a step, relative to 1 + |z|, and of the root of the cost it would save
RUNNING, CONVERGED, STALLED = 0, 1, 2
_DAMPING = 1e-2  # of the first step, in units of the largest diagonal element of the Hessian


class Normal(NamedTuple):
    """Half the sum of squares r'r / 2, its gradient J'r and its Gauss-Newton Hessian J'J."""

    cost: Float[Array, " *batch"]
    gradient: Float[Array, " parameters *batch"]
    hessian: Float[Array, "parameters parameters *batch"]


class Descent(NamedTuple):
    """Where each member of the batch stands, and how damped its next step is."""

    z: Float[Array, " parameters *batch"]
    normal: Normal
    damping: Float[Array, " *batch"]  # in units of the largest diagonal element of the Hessian
    growth: Float[Array, " *batch"]  # of the damping, should the next step fail
    steps: Int[Array, " *batch"]
    status: Int[Array, " *batch"]


Evaluate = Callable[[Float[Array, " parameters *batch"]], Normal]


def minimise(
    evaluate: Evaluate,
    z0: Float[Array, " parameters *batch"],
    max_steps: int,
    tolerance: float = TOLERANCE,
) -> Descent:
    """Lower half the sum of squares of every member until all have stopped.

    Damping is by the identity: `z` is a vector of logarithms or of relative values, so that one
    unit means the same for all. A trial point that is not finite counts as a failed step.
    Damping follows Nielsen (1999), Damping parameter in Marquardt's method, IMM-REP-1999-05.
    """
    start = begin(evaluate, z0)

    def running(state: Descent) -> Bool[Array, ""]:
        return jnp.any((state.status == RUNNING) & (state.steps < max_steps))

    def body(state: Descent) -> Descent:
        return advance(evaluate, state, max_steps, tolerance)

    return settle(jax.lax.while_loop(running, body, start))


def begin(evaluate: Evaluate, z0: Float[Array, " parameters *batch"]) -> Descent:
    """Every member at its start; one whose start is not finite has stopped there."""
    batch = z0.shape[1:]
    counter = jnp.zeros(batch, int)
    normal = evaluate(z0)
    status = jnp.where(_finite(normal), RUNNING, STALLED)
    damping, growth = jnp.full(batch, _DAMPING), jnp.full(batch, 2.0)
    return Descent(z0, normal, damping, growth, counter, counter + status)


def settle(state: Descent) -> Descent:
    """Rounding can stop the descent at a minimum: what is left to save tells it from a wall."""
    level = decrement(state.normal) <= 1e-9 * state.normal.cost
    status = jnp.where((state.status == STALLED) & level, CONVERGED, state.status)
    return state._replace(status=status)


def advance(evaluate: Evaluate, state: Descent, max_steps: int, tolerance: float) -> Descent:
    """One step of every member that is still running."""
    damping = state.damping * _size(state.normal.hessian)
    change, definite = solve_definite(
        _damped(state.normal.hessian, damping), -state.normal.gradient
    )
    predicted = 0.5 * jnp.sum(change * (damping[None] * change - state.normal.gradient), axis=0)
    trial = state.z + change
    normal = evaluate(trial)
    saved = state.normal.cost - normal.cost
    ratio = saved / jnp.where(predicted > 0, predicted, 1e-300)
    moved = jnp.max(jnp.abs(change) / (1 + jnp.abs(state.z)), axis=0)
    # A step that damping has shortened says nothing about the distance to the minimum.
    small = (moved <= tolerance) | (predicted <= tolerance**2 * state.normal.cost)
    small = small & definite & (state.damping <= 1e-2)
    # The last steps save less than the rounding of the cost.
    equal = small & (saved >= -1e-12 * state.normal.cost)
    accepted = definite & _finite(normal) & ((ratio > 1e-3) | equal)
    active = (state.status == RUNNING) & (state.steps < max_steps)
    factor = jnp.where(accepted, jnp.clip(1 - (2 * ratio - 1) ** 3, 0.1, 2.0), state.growth)
    damping = jnp.maximum(state.damping * factor, 1e-14)
    status = jnp.where(small, CONVERGED, jnp.where(damping > 1e16, STALLED, RUNNING))
    taken = active & accepted
    return Descent(
        _select(taken, trial, state.z),
        Normal(*(_select(taken, *pair) for pair in zip(normal, state.normal, strict=True))),
        jnp.where(active, damping, state.damping),
        jnp.where(accepted, 2.0, 2 * state.growth),
        state.steps + active.astype(int),
        jnp.where(active, status, state.status),
    )


def normal_equations(
    residual: Callable[..., Any], z: Float[Array, " parameters"], args: Any
) -> Normal:
    """Cost, gradient and Gauss-Newton Hessian, by one forward derivative for each parameter."""
    along = lambda change: jax.jvp(lambda z: residual(z, args), (z,), (change,))
    # One row for each parameter: columns would have to be gathered.
    r, rows = jax.vmap(along, out_axes=(None, 0))(jnp.eye(z.size, dtype=z.dtype))
    return Normal(0.5 * jnp.sum(r**2), rows @ r, rows @ rows.T)


def _select(
    which: Bool[Array, " *batch"], yes: Float[Array, "..."], no: Float[Array, "..."]
) -> Float[Array, "..."]:
    return jnp.where(which.reshape((1,) * (yes.ndim - which.ndim) + which.shape), yes, no)


def decrement(normal: Normal) -> Float[Array, " *batch"]:
    """Newton decrement g' H^-1 g / 2: what one more Gauss-Newton step would save."""
    hessian = _damped(normal.hessian, 1e-12 * _size(normal.hessian))
    change, definite = solve_definite(hessian, normal.gradient)
    saving = 0.5 * jnp.sum(change * normal.gradient, axis=0)
    return jnp.where(definite, saving, jnp.inf)


def solve_definite(
    matrix: Float[Array, "parameters parameters *batch"],
    vector: Float[Array, " parameters *batch"],
) -> tuple[Float[Array, " parameters *batch"], Bool[Array, " *batch"]]:
    """Gauss-Jordan elimination of a symmetric matrix, and whether it is positive definite."""
    count = vector.shape[0]
    rows = np.arange(count).reshape((count,) + (1,) * vector.ndim)

    def eliminate(k, state):
        system, definite = state
        pivot = system[k, k]
        row = system[k] / pivot[None]
        others = system - system[:, k][:, None] * row[None]
        return jnp.where(rows == k, row[None], others), definite & (pivot > 0)

    system = jnp.concatenate([matrix, vector[:, None]], axis=1)
    start = (system, jnp.ones(vector.shape[1:], bool))
    system, definite = jax.lax.fori_loop(0, count, eliminate, start)
    return system[:, count], definite


def _size(hessian: Float[Array, "parameters parameters *batch"]) -> Float[Array, " *batch"]:
    largest = jnp.max(jnp.einsum("ii...->i...", hessian), axis=0)
    return jnp.where(largest > 0, largest, 1.0)


def _damped(
    hessian: Float[Array, "parameters parameters *batch"], damping: Float[Array, " *batch"]
) -> Float[Array, "parameters parameters *batch"]:
    count = hessian.shape[0]
    identity = np.eye(count).reshape((count, count) + (1,) * damping.ndim)
    return hessian + damping[None, None] * identity


def _finite(normal: Normal) -> Bool[Array, " *batch"]:
    return jnp.isfinite(normal.cost) & jnp.all(jnp.isfinite(normal.gradient), axis=0)
