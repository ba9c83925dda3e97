"""Nonlinear plants over a record, by an adaptive solver that stops at every sample."""

from typing import Any

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float


_RELATIVE, _ABSOLUTE = 1e-8, 1e-10  # tolerances of the states within one sample
_STEPS = 64  # within one sample at most


def is_plant(model: Any) -> bool:
    """Whether a model is given by its differential equation."""
    return all(callable(getattr(model, name, None)) for name in ("init", "derivative", "measure"))


def states_of(plant: Any) -> int:
    """How many numbers the state has."""
    return ravel_pytree(plant.init())[0].size


def integrated(
    plant: Any,
    u: Float[Array, "samples inputs"],
    start: Float[Array, " states"],
    dt: float,
    hold: str,
) -> Float[Array, "samples outputs"]:
    """The outputs from `start` beyond `plant.init()`, without disturbance.

    Tsit5 within each sample, so that steps end where a held input jumps or a straight one bends.
    Not finite where a sample takes too many steps.
    """
    # Imported late: diffrax triples the time of `import jaxquad`.
    import diffrax as dfx

    origin, rebuild = ravel_pytree(plant.init())
    calm = jnp.zeros_like(plant.measure(rebuild(origin)))
    controller = dfx.PIDController(rtol=_RELATIVE, atol=_ABSOLUTE)

    def slope(t, state, line):
        value, change = line
        inputs = value + (t / dt) * change
        return ravel_pytree(plant.derivative(rebuild(state), inputs, calm))[0]

    def sample(state, line):
        found = dfx.diffeqsolve(
            dfx.ODETerm(slope), dfx.Tsit5(), 0.0, dt, dt, state, line,
            stepsize_controller=controller, adjoint=dfx.ForwardMode(),
            max_steps=_STEPS, throw=False,
        )  # fmt: skip
        assert found.ys is not None
        after = jnp.where(found.result == dfx.RESULTS.successful, found.ys[0], jnp.nan)
        return after, jnp.atleast_1d(plant.measure(rebuild(state)))

    change = jnp.diff(u, axis=0, append=u[-1:]) if hold == "first" else jnp.zeros_like(u)
    return jax.lax.scan(sample, origin + start, (u, change))[1]
