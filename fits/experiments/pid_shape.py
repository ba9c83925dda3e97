"""The two freedoms of a PID that Ms and activity leave: the most ki without overshoot of a step.

Under a step of load the error integrates to 1/ki, which MIGO minimises at a given Ms (Astrom &
Hagglund, Advanced PID Control, ch. 6).
"""

import functools as ft
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad.loops import LoopResponse

from .designs import Design
from .nominal import loops_at


_STEP = 1e-4  # of ln gains
_GAINS: tuple[str, ...] = ("pole", "filter", "damping", "ratio")
_STARTS = ((0.5, 0.8), (0.7, 1.0))  # damping and ratio
_LOG_KI = np.array([3.0, 0.0, 0.0, 1.0])  # ki = ratio pole^3: slopes of ln ki
_HORIZON, _FASTEST = 8.0, 100.0  # s, in which a step settles; rad/s, beyond which it has nothing

# ln gains to what is missing of the goals and left of the overshoot [3], and its slopes [3, 4].
Around = Callable[[tuple[float, ...]], tuple[np.ndarray, np.ndarray]]


def shaped(design: Design, level: dict[str, Any], dt: float, goal: np.ndarray) -> Design:
    """The PID with the largest ki that keeps ln Ms and ln activity at their `goal`.

    The step of its nominal loop overshoots by no more than the shape's `overshoot`. Starts at the
    gains of `design`, which meet the goal with a triple pole, in the shapes of `_STARTS`.
    Raises ValueError if no search ends.
    """
    shape, free = design.data["shape"], design.data["free"]
    bounds = np.log([(free | shape)[name] for name in _GAINS])
    around = _around(design, level, dt, goal)
    solved = [design.gains[name] for name in _GAINS[:2]]
    searches = [_most(around, np.log([*solved, *start]), bounds) for start in _STARTS]
    ends = [logs for logs in searches if logs is not None]
    if not ends:
        raise ValueError(f"{design.name}: no shape was found within {shape}; widen the bounds")
    best = max(ends, key=lambda logs: _LOG_KI @ logs)
    return design._replace(gains=dict(zip(_GAINS, np.exp(best).tolist(), strict=True)))


def _around(design: Design, level: dict[str, Any], dt: float, goal: np.ndarray) -> Around:
    aside = _STEP * np.hstack([np.zeros((4, 1)), np.eye(4), -np.eye(4)])
    allowed = design.data["shape"]["overshoot"]

    @ft.cache
    def around(logs: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
        gains = dict(zip(_GAINS, np.exp(np.array(logs)[:, None] + aside), strict=True))
        loops, reached = loops_at(design, level, dt, gains)
        left = allowed - overshoot(loops.reference)[: aside.shape[1]]
        found = np.vstack([reached - goal[:, None], left])
        return found[:, 0], (found[:, 1:5] - found[:, 5:]) / (2 * _STEP)

    return around


def _most(around: Around, start: np.ndarray, bounds: np.ndarray) -> np.ndarray | None:
    from scipy.optimize import minimize

    def limits(kind: str, rows: slice) -> dict[str, Any]:
        value, slopes = (lambda x, k=k: around(tuple(x))[k][rows] for k in (0, 1))
        return {"type": kind, "fun": value, "jac": slopes}

    search = minimize(
        lambda x: -_LOG_KI @ x, start, jac=lambda x: -_LOG_KI, bounds=bounds, method="SLSQP",
        constraints=[limits("eq", slice(2)), limits("ineq", slice(2, 3))],
        options={"maxiter": 40, "ftol": 1e-6},
    )  # fmt: skip
    return search.x if search.success else None


def overshoot(reference: LoopResponse) -> np.ndarray:
    """By which share the step of each stable loop [members] overshoots."""
    omega = np.arange(np.pi, _FASTEST * _HORIZON, 2 * np.pi) / _HORIZON
    waves = np.exp(1j * omega[:, None] * np.linspace(0.0, _HORIZON, 1000, endpoint=False))
    # The positive half of a square wave, which the harmonics of the loop's answer add up to.
    half = np.asarray(_responses(reference, jnp.asarray(omega))) * 2 / (omega * _HORIZON)
    return (0.5 + (half @ waves).imag).max(axis=1) - 1.0


@eqx.filter_jit
def _responses(
    reference: LoopResponse, omega: Float[Array, " frequencies"]
) -> Complex[Array, "members frequencies"]:
    return jax.vmap(lambda one: one.frequency_response(omega)[:, 0, 0])(reference)
