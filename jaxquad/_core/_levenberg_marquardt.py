"""Levenberg-Marquardt on the normal equations, one problem or a batch on trailing axes.

Built without LAPACK: `vmap` over LAPACK calls can hang on few cores.
"""

from collections.abc import Callable
from typing import NamedTuple, Protocol, runtime_checkable, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PyTree


TOLERANCE = 1e-8  # of a step, relative to 1 + |z|, and of the root of the cost it would save
RUNNING, CONVERGED, STALLED = 0, 1, 2
_DAMPING = 3e-2  # of the first step, in units of the largest diagonal element of the Hessian
_SHRINKING = 0.1  # the least factor from one step to the next that is believed


class Normal(NamedTuple):
    """Half the sum of squares r'r / 2, its gradient J'r and its Gauss-Newton Hessian J'J."""

    cost: Float[Array, " *batch"]
    gradient: Float[Array, " parameters *batch"]
    hessian: Float[Array, "parameters parameters *batch"]


class Descent(NamedTuple):
    """Where each member of the batch stands, and the step that it will try next."""

    z: Float[Array, " parameters *batch"]
    normal: Normal
    damping: Float[Array, " *batch"]  # in units of the largest diagonal element of the Hessian
    growth: Float[Array, " *batch"]  # of the damping, should the next step fail
    change: Float[Array, " parameters *batch"]  # the next step
    predicted: Float[Array, " *batch"]  # what it would save of the cost; 0 where it is undefined
    size: Float[Array, " *batch"]  # of the last step taken, relative to 1 + |z|
    steps: Int[Array, " *batch"]
    status: Int[Array, " *batch"]


Evaluate = Callable[[Float[Array, " parameters *batch"]], Normal]


def minimise(
    evaluate: Evaluate, z0: Float[Array, " parameters *batch"], max_steps: int | Int[Array, ""],
    tolerance: float = TOLERANCE,
) -> Descent:  # fmt: skip
    """Lower half the sum of squares of every member until all have stopped.

    Damping is by the identity: `z` is a vector of logarithms or of relative values, so that one
    unit means the same for all. A trial point that is not finite counts as a failed step.
    Damping follows Nielsen (1999), Damping parameter in Marquardt's method, IMM-REP-1999-05.
    """
    start = begin(z0)

    def running(state: Descent) -> Bool[Array, ""]:
        return jnp.any((state.status == RUNNING) & (state.steps < max_steps))

    def body(state: Descent) -> Descent:
        return advance(evaluate, state, max_steps, tolerance)

    return settle(jax.lax.while_loop(running, body, start))


def begin(z0: Float[Array, " parameters *batch"]) -> Descent:
    """Every member before its start: the first step of `advance` is none, and evaluates it."""
    zero, none = jnp.zeros(z0.shape[1:], z0.dtype), jnp.zeros_like(z0)
    hessian = jnp.zeros((len(z0), *z0.shape), z0.dtype)
    normal, counter = Normal(zero + jnp.inf, none, hessian), jnp.zeros(zero.shape, int)
    levels = zero + _DAMPING, zero + 2.0
    return Descent(z0, normal, *levels, none, zero, zero + jnp.inf, counter, counter + RUNNING)


def settle(state: Descent) -> Descent:
    """Rounding can stop the descent at a minimum: what is left to save tells it from a wall."""
    cost = state.normal.cost
    level = jnp.isfinite(cost) & (decrement(state.normal) <= 1e-9 * cost)
    status = jnp.where((state.status == STALLED) & level, CONVERGED, state.status)
    return state._replace(status=status)


def advance(
    evaluate: Evaluate, state: Descent, max_steps: int | Int[Array, ""], tolerance: float
) -> Descent:
    """One step of every member that is still running."""
    trial = state.z + state.change
    normal = evaluate(trial)
    first, finite = jnp.isinf(state.normal.cost), jnp.isfinite(normal.cost)
    finite &= jnp.all(jnp.isfinite(normal.gradient), axis=0)
    saved = state.normal.cost - normal.cost
    ratio = jnp.where(first, 0.5, saved / jnp.where(state.predicted > 0, state.predicted, 1e-300))
    accepted = finite & (first | ((state.predicted > 0) & (ratio > 1e-3)))
    active = (state.status == RUNNING) & (state.steps < max_steps)
    factor = jnp.where(accepted, jnp.clip(1 - (2 * ratio - 1) ** 3, 0.1, 2.0), state.growth)
    damping = jnp.maximum(state.damping * factor, 1e-14)
    stalled = active & ((damping > 1e16) | (first & ~finite))
    taken = active & accepted
    size = jnp.where(taken & ~first, _relative(state.change, state.z), state.size)
    state = state._replace(
        z=_select(taken, trial, state.z),
        normal=Normal(*(_select(taken, *both) for both in zip(normal, state.normal, strict=True))),
        damping=jnp.where(active, damping, state.damping),
        growth=jnp.where(accepted, 2.0, 2 * state.growth),
        size=size,
        steps=state.steps + (active & ~first).astype(int),
        status=jnp.where(stalled, STALLED, state.status),
    )
    # The next step, damped; the last one is taken at once, without a trial evaluation.
    damping = state.damping * _size(state.normal.hessian)
    hessian, gradient = _damped(state.normal.hessian, damping), state.normal.gradient
    change, definite = solve_definite(hessian, -gradient)
    predicted = jnp.where(
        definite, 0.5 * jnp.sum(change * (damping[None] * change - gradient), 0), 0
    )
    size = _relative(change, state.z)
    # Near a minimum each step shrinks as the one before: what is left after the next is known.
    left = size * jnp.clip(size / state.size, _SHRINKING, 1.0)
    # Steps along weak directions start short, because of their damping, and grow with less of it.
    shrinks = jnp.isfinite(state.size) & (size < state.size)
    enough = ((left <= tolerance) & shrinks) | (predicted <= tolerance**2 * state.normal.cost)
    # A step that damping has shortened says nothing about the distance to the minimum.
    last = (state.status == RUNNING) & definite & (state.damping <= _DAMPING) & enough
    return state._replace(
        z=_select(last, state.z + change, state.z), change=change, predicted=predicted,
        status=jnp.where(last, CONVERGED, state.status),
    )  # fmt: skip


@runtime_checkable
class Point(Protocol):
    """Where a descent on the host stands: a cost and its slopes."""

    @property
    def z(self) -> Float[np.ndarray, " parameters"]:
        """What steps are relative to, as 1 + |z|."""
        ...

    @property
    def cost(self) -> float:
        """Half the sum of squares; infinite where something is not finite."""
        ...

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        """Gradient J'r and Gauss-Newton Hessian J'J, asked for only where a step has led."""
        ...


P = TypeVar("P", bound=Point)


def minimise_on_host(
    start: P, move: Callable[[P, Float[np.ndarray, " parameters"]], P], max_steps: int, *,
    tolerance: float = 1e-6, saving: float = 1e-12, damping: float = 1e-3,
) -> tuple[P, int, int]:  # fmt: skip
    """The descent of `minimise` for one problem, as a loop of Python; also its status and steps.

    `move` makes the next point from a point and a step, whose coordinates may be those of that
    point alone. For a few steps whose evaluation is compiled already, or is NumPy: compiling the
    loop would take longer than running it. It ends at a step below `tolerance` relative to
    1 + |z|, or one that would save less than `saving` of the cost. `damping` is that of the first
    step. RUNNING means that the steps are used up.
    """
    if not np.isfinite(start.cost):
        return start, STALLED, 0
    here, growth, undamped = start, 2.0, max(1e-2, damping)
    gradient, hessian = here.slopes()
    for step in range(max_steps):
        extra = damping * max(np.max(np.diagonal(hessian)), 1e-300)
        damped = hessian + extra * np.eye(gradient.size)
        try:
            change = -np.linalg.solve(damped, gradient)
        except np.linalg.LinAlgError:
            change = -np.linalg.lstsq(damped, gradient, rcond=None)[0]
        predicted = 0.5 * change @ (extra * change - gradient)
        short = np.max(np.abs(change) / (1 + np.abs(here.z))) <= tolerance
        last = damping <= undamped and (short or predicted <= saving * here.cost)
        there = move(here, change)
        saved = here.cost - there.cost
        # The last step may lose what rounding makes of it.
        better = saved > 1e-3 * predicted or last and saved >= -1e-12 * here.cost
        ratio = saved / max(predicted, 1e-300)
        if better:
            here = there
            gradient, hessian = here.slopes()
        if last:
            return here, CONVERGED, step + 1
        damping *= float(np.clip(1 - (2 * ratio - 1) ** 3, 0.1, 2.0)) if better else growth
        damping, growth = max(damping, 1e-14), 2.0 if better else 2 * growth
        if damping > 1e16:
            return here, STALLED, step + 1
    return here, RUNNING, max_steps


def _relative(
    change: Float[Array, " parameters *batch"], z: Float[Array, " parameters *batch"]
) -> Float[Array, " *batch"]:
    return jnp.max(jnp.abs(change) / (1 + jnp.abs(z)), axis=0)


def normal_equations(
    residual: Callable[..., Array], z: Float[Array, " parameters"], args: PyTree
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
    matrix: Float[Array, "parameters parameters *batch"], vector: Float[Array, " parameters *batch"]
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


def invert_definite(
    matrix: Float[Array, "*batch rows rows"],
) -> tuple[Float[Array, "*batch rows rows"], Float[Array, " *batch"]]:
    """Inverse of a symmetric positive definite matrix by Gauss-Jordan elimination, and the
    logarithm of its determinant."""
    count = matrix.shape[-1]
    identity = jnp.broadcast_to(jnp.eye(count, dtype=matrix.dtype), matrix.shape)

    def eliminate(state, k):
        system, volume = state
        pivot = system[..., k, k]
        row = system[..., k, :] / pivot[..., None]
        others = system - system[..., k][..., None] * row[..., None, :]
        system = jnp.where((np.arange(count) == k)[:, None], row[..., None, :], others)
        return (system, volume + jnp.log(jnp.abs(pivot))), None

    start = jnp.concatenate([matrix, identity], axis=-1), jnp.zeros_like(matrix[..., 0, 0])
    (system, volume), _ = jax.lax.scan(eliminate, start, np.arange(count))
    return system[..., count:], volume


def _size(hessian: Float[Array, "parameters parameters *batch"]) -> Float[Array, " *batch"]:
    largest = jnp.max(jnp.einsum("ii...->i...", hessian), axis=0)
    return jnp.where(largest > 0, largest, 1.0)


def _damped(
    hessian: Float[Array, "parameters parameters *batch"], damping: Float[Array, " *batch"]
) -> Float[Array, "parameters parameters *batch"]:
    count = hessian.shape[0]
    identity = np.eye(count).reshape((count, count) + (1,) * damping.ndim)
    return hessian + damping[None, None] * identity
