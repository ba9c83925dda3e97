"""Least squares on the tracking errors themselves, through optimistix."""

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad.simulation import SampleResult, scan_loop

from ._cost import SMOOTHING
from ._objective import (
    is_gated,
    Limit,
    Mean,
    Objective,
    Penalty,
    risk_text,
    stability_gate,
)
from ._parameters import Coordinates
from ._problem import Problem
from ._quantities import QUANTITIES, split_quantities


_LEAST = 1e-12


class GaussNewton(eqx.Module):
    """Least squares on the tracking errors of all members, by Levenberg-Marquardt.

    Residuals are sqrt(t) times the errors, so tracking counts as ITSE, the integral of t error^2;
    ITAE itself is no sum of squares. Each member's errors are in units of their size at the start,
    which stands for the logarithm, and penalties enter by their square roots.

    **Arguments:**

    - `steps`: the most steps.
    - `tolerance`: relative, of cost and parameters.
    - `stride`: samples that share a residual.

    **Raises:**

    - `ValueError`: `steps` or `stride` is below 1. A tune raises it for terms other than ITAE, for
        risks other than the mean and for limits, none of which are sums of squares.
    """

    steps: int = 30
    tolerance: float = 1e-4
    stride: int = 10

    def __check_init__(self):
        if self.steps < 1 or self.stride < 1:
            raise ValueError(f"steps is {self.steps} and stride {self.stride}: give 1 or more")


class _Squares(eqx.Module):
    coordinates: Coordinates
    problem: Problem
    penalties: Sequence[Penalty]
    scale: Float[Array, "axes members"]  # of the squared errors' sums
    stride: int = eqx.field(static=True)


def require_squares(objective: Objective, limits: Sequence[Limit]) -> None:
    """Raise ValueError for what is no sum of squares."""
    odd = [name for name in objective.terms if name != "itae"]
    odd += [f"limit on {limit.quantity}" for limit in limits]
    if not isinstance(objective.risk, Mean):
        odd.append(f"risk {risk_text(objective.risk)}")
    if odd:
        raise ValueError(
            f"GaussNewton cannot minimise {', '.join(odd)}: no sum of squares. Take LBFGS(), "
            "or the term itae with penalties and the mean risk"
        )


def minimise_squares(
    coordinates: Coordinates,
    problem: Problem,
    objective: Objective,
    start: Float[np.ndarray, " n"],
    method: GaussNewton,
) -> tuple[Float[np.ndarray, " n"], int, bool]:
    """Where the descent ended, its steps, and whether it converged."""
    import lineax as lx
    import optimistix as optx

    units = jnp.ones((problem.linear.assumed_inertia.shape[0], problem.members))
    squares = _Squares(coordinates, problem, objective.penalties, units, method.stride)
    size = jnp.sum(_errors(jnp.asarray(start), squares) ** 2, axis=0)
    squares = eqx.tree_at(
        lambda s: s.scale, squares, jnp.sum(size, axis=0, keepdims=True) + 0 * size
    )
    solver = optx.LevenbergMarquardt(
        rtol=method.tolerance, atol=method.tolerance, linear_solver=lx.Normal(lx.Cholesky())
    )
    with jax.numpy_dtype_promotion("standard"):
        solution = optx.least_squares(
            _linearised, solver, jnp.asarray(start), squares, max_steps=method.steps, throw=False
        )
    done = bool(solution.result == optx.RESULTS.successful)
    return np.asarray(solution.value), int(solution.stats["num_steps"]), done


def _residuals(z: Float[Array, " n"], squares: _Squares) -> tuple[Array, Array]:
    members = squares.problem.members
    tracking = _errors(z, squares) / jnp.sqrt(squares.scale + _LEAST)[None]
    controller = squares.coordinates.controller_at(z)
    flights, linear = split_quantities({p.quantity for p in squares.penalties} | {"abscissa"})
    numbers = squares.problem.linear.numbers(controller, linear, SMOOTHING)
    if flights:
        numbers |= squares.problem.in_time(controller, flights)
    gate = stability_gate(numbers["abscissa"])
    costs = [
        p(
            QUANTITIES[p.quantity].combine_axes(numbers[p.quantity]),
            gate if is_gated(p.quantity) else gate + 1,
        )
        for p in squares.penalties
    ]
    bounds = jnp.sqrt(jnp.stack(costs) + _LEAST) if costs else jnp.zeros((0, members))
    # ITSE goes as the square of ITAE: half of it, for the same change of the cost.
    return tracking / np.sqrt(2 * members), bounds / np.sqrt(members)


@eqx.filter_custom_jvp
def _linearised(z: Float[Array, " n"], squares: _Squares) -> tuple[Array, Array]:
    return _residuals(z, squares)


@_linearised.def_jvp
def _with_columns(primals: PyTree, tangents: PyTree) -> PyTree:
    # A column for each parameter, one flight after the other: linearised, the loop would store all.
    (z, _), run = primals, lambda z: _residuals(z, primals[1])
    column = lambda unit: jax.jvp(run, (z,), (unit,))[1]
    columns = jax.lax.map(column, jnp.eye(z.size, dtype=z.dtype))
    return run(z), jax.tree.map(lambda c: jnp.tensordot(tangents[0], c, 1), columns)


class _Errors(eqx.Module):
    """Stores the error of every sample, rad."""

    def begin(self, like: Array) -> None:
        return None

    def update(self, total: None, now: SampleResult) -> tuple[None, Array]:
        return total, now.reference - now.angle


def _errors(z: Float[Array, " n"], squares: _Squares) -> Float[Array, "points axes members"]:
    """sqrt(t) error every few samples, t from the last event."""
    problem, stride = squares.problem, squares.stride
    loop = problem.loop_around(squares.coordinates.controller_at(z))
    stored = scan_loop(loop, problem.flight, _Errors())[1]
    index = np.arange(int(problem.window.first), int(problem.window.last) + 1, stride)
    since = np.min([np.where(index >= a, index - a, np.inf) for a, _ in problem.parts], axis=0)
    weight = np.sqrt(since * loop.dt * loop.dt * stride)
    return stored[index] * weight[:, None, None]
