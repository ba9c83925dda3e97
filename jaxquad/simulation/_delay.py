import functools as ft

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.loops import Loop


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


def delay_line(loop: Loop) -> DelayLine | None:
    """That of a loop; None without a delay."""
    length, splits, traced = loop.queue
    if length == 0:
        return None
    delay, longest = loop.delay, loop.longest_delay
    if traced:
        wrong = (delay < 0) | (delay > longest * (1 + 1e-9)) | ~jnp.isfinite(delay)
        message = f"delay is outside 0 to longest_delay = {longest} s: raise longest_delay"
        delay = eqx.error_if(delay, wrong, message)
    samples = delay / loop.dt
    return DelayLine(samples if splits else jnp.round(samples), length, splits)
