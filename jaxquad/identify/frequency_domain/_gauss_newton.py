"""The default solver of fits for optimistix, whose import takes long: import this file late."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, PyTree

from jaxquad._core import (
    advance,
    begin,
    Descent,
    Normal,
    normal_equations,
    RUNNING,
    settle,
    STALLED,
)


class DampedGaussNewton(optx.AbstractLeastSquaresSolver):
    """Gauss-Newton on the normal equations, damped as far as its steps fail.

    For `optimistix.least_squares` over a vector of parameters of like size, with one vector of
    residuals and nothing beside it. A step that meets NaN is shortened like any that fails.
    `result` is `nonlinear_divergence` where no shorter step helps either; the last point is then
    the best. Without LAPACK, so `vmap` over solves is safe on few cores.
    Source: Nielsen (1999), Damping parameter in Marquardt's method, IMM-REP-1999-05.
    """

    rtol: float
    atol: float
    norm: Callable[[PyTree], Float[Array, ""]]
    normal: Callable[[Array, PyTree], Normal] | None

    def __init__(self, tolerance: float, normal: Callable[[Array, PyTree], Normal] | None = None):
        """`tolerance` of a step relative to 1 + |y|, and of the root of the cost it would save.

        `normal(y, args)` gives the normal equations of the same residuals, where there is a faster
        way than to differentiate them.
        """
        self.rtol = self.atol = tolerance
        self.norm = optx.max_norm
        self.normal = normal

    def init(self, fn, y, args, options, f_struct, aux_struct, tags) -> Descent:
        return begin(y)

    def step(self, fn, y, args, options, state, tags) -> tuple[Array, Descent, PyTree]:
        state = advance(self._evaluation(fn, args), state, jnp.iinfo(jnp.int32).max, self.rtol)
        state = jax.lax.cond(state.status == STALLED, settle, lambda same: same, state)
        return state.z, state, None  # to ask `fn` for it would trace the residuals once more

    def terminate(self, fn, y, args, options, state, tags) -> tuple[Bool[Array, ""], optx.RESULTS]:
        failed = optx.RESULTS.nonlinear_divergence
        result = optx.RESULTS.where(state.status == STALLED, failed, optx.RESULTS.successful)
        return state.status != RUNNING, result

    def postprocess(
        self, fn, y, aux, args, options, state, tags, result
    ) -> tuple[Array, PyTree, dict]:
        return y, aux, {}

    def _evaluation(self, fn: Callable[..., PyTree], args: PyTree) -> Callable[[Array], Normal]:
        normal = self.normal
        if normal is not None:
            return lambda z: normal(z, args)
        return lambda z: normal_equations(lambda z, args: fn(z, args)[0], z, args)
