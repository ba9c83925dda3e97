import functools as ft
import math

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, ArrayLike, Float

from ._hardware import Encoder
from ._protocols import Drive


class DelayLine(eqx.Module):
    """The inputs on their way to the plant, for a delay of any number of samples, whole or not.

    During a sample interval the plant first feels an `early` input, for the share of the interval
    by which the delay exceeds whole samples, then a `late` one.
    """

    samples: Float[Array, "*members"]  # the delay, in sample intervals
    length: int = eqx.field(static=True)  # how many past inputs are kept
    splits: bool = eqx.field(static=True)  # whether there are early inputs at all

    def init(self, inputs: Float[Array, " inputs *ensemble"]) -> Float[Array, "past ..."]:
        """Before the first sample the plant feels `inputs`."""
        return jnp.broadcast_to(inputs, (self.length, *inputs.shape))

    def share(self, like: Array) -> Float[Array, "*members"]:
        """Of a sample interval that belongs to the early inputs."""
        samples = self.samples.astype(like.dtype)
        return samples - jnp.floor(samples)

    def step(
        self, past: Float[Array, "past ..."], inputs: Float[Array, " inputs *ensemble"]
    ) -> tuple[Array, Array, Array]:
        """The past of the next sample, and the early and late inputs of this one."""
        queue = jnp.concatenate([inputs[None], past])
        whole = jnp.floor(self.samples).astype(int)
        late = _of_age(queue, whole)
        return queue[:-1], _of_age(queue, whole + 1) if self.splits else late, late


def _of_age(queue: Float[Array, "ages ..."], age: Array) -> Array:
    # Masks, not a gather, whose reverse would be a scatter; and sums that are no reductions.
    age = age.reshape((1,) * (queue.ndim - 1 - age.ndim) + age.shape)
    chosen = [jnp.where(age == k, inputs, 0) for k, inputs in enumerate(queue)]
    return ft.reduce(jnp.add, chosen)


def delay_line(
    delay: Float[ArrayLike, "*members"], dt: float, longest: float | None
) -> DelayLine | None:
    """None for no delay. Raises ValueError for a delay that is negative, not finite or untold."""
    if isinstance(delay, Tracer):
        return _traced(delay, dt, longest)
    samples = np.asarray(delay, dtype=float) / dt
    if not np.all(np.isfinite(samples) & (samples >= 0)):
        raise ValueError(f"delay is {delay} s: it is 0 or above and finite")
    if longest is not None and np.any(samples > longest / dt * (1 + 1e-9)):
        raise ValueError(f"delay is {delay} s, above longest_delay = {longest} s: raise that")
    nearest = np.round(samples)
    whole = bool(np.all(np.abs(samples - nearest) < 1e-9 * np.maximum(nearest, 1)))
    if not np.any(nearest if whole else samples):
        return None
    samples = nearest if whole else samples
    length = int(np.max(nearest)) if whole else int(np.floor(np.max(samples))) + 1
    return DelayLine(jnp.asarray(samples, dtype=float), length, not whole)


def _traced(delay: Array, dt: float, longest: float | None) -> DelayLine:
    if longest is None or not 0 < longest < np.inf:
        raise ValueError(
            "the delay is traced by jit, vmap or grad, so how many inputs to keep is not known: "
            f"longest_delay is {longest}; give the longest delay in s that can occur"
        )
    wrong = (delay < 0) | (delay > longest * (1 + 1e-9)) | ~jnp.isfinite(delay)
    message = f"delay is outside 0 to longest_delay = {longest} s: raise longest_delay"
    delay = eqx.error_if(delay, wrong, message)
    return DelayLine(delay / dt, int(np.floor(longest / dt * (1 + 1e-9))) + 1, True)


class Settings(eqx.Module):
    """How a loop is run."""

    dt: float = eqx.field(static=True)  # s
    drive: Drive | None
    encoder: Encoder | None
    line: DelayLine | None
    substeps: int = eqx.field(static=True)
    bound: float = eqx.field(static=True)  # rad


def loop_settings(
    *,
    dt: float = 0.002,
    drive: Drive | None = None,
    encoder: Encoder | None = None,
    delay: Float[ArrayLike, "*ensemble"] = 0.0,
    longest_delay: float | None = None,
    substeps: int = 1,
    bound: float = 100.0,
) -> Settings:
    """The options of `simulate`, checked. Raises ValueError for what makes no sense."""
    if not (dt > 0 and math.isfinite(dt)):
        raise ValueError(f"dt is {dt} s: give a positive sample interval")
    if not (isinstance(substeps, int | np.integer) and substeps >= 1):
        raise ValueError(f"substeps is {substeps}: give a whole number of steps, 1 or more")
    if not (bound > 0 and math.isfinite(bound)):
        raise ValueError(f"bound is {bound} rad: give the largest angle that still counts as flown")
    line = delay_line(delay, dt, longest_delay)
    return Settings(dt, drive, encoder, line, int(substeps), float(bound))
