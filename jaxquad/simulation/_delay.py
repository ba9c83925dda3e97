import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad._compile import Queue
from jaxquad._core import per_member
from jaxquad.loops import Loop


class DelayLine(eqx.Module):
    """The inputs on their way to the plant, for a delay of any number of samples, whole or not.

    During a sample interval the plant first feels an `early` input, for the share of the interval
    by which the delay exceeds whole samples, then a `late` one. All inputs first wait in a `Queue`
    for the samples that every member waits at least; only the further ones differ by member.
    """

    samples: Float[Array, "*members"] = per_member(rank=0)  # the delay, in sample intervals
    fewest: int = eqx.field(static=True)  # whole samples that every member waits
    further: int = eqx.field(static=True)  # how many inputs are kept beyond the queue
    splits: bool = eqx.field(static=True)  # whether there are early inputs at all

    def queue(self, inputs: Float[Array, " inputs *ensemble"]) -> Queue | None:
        """Before the first sample the plant feels `inputs`."""
        if self.fewest == 0:
            return None
        return Queue(_repeated(inputs, self.fewest - 1), inputs)

    def init(self, inputs: Float[Array, " inputs *ensemble"]) -> Float[Array, "past ..."] | None:
        """The inputs that have left the queue."""
        return _repeated(inputs, self.further)

    def share(self, like: Array) -> Float[Array, "*members"]:
        """Of a sample interval that belongs to the early inputs."""
        samples = self.samples.astype(like.dtype)
        return samples - jnp.floor(samples)

    def step(
        self, past: Float[Array, "past ..."] | None, inputs: Float[Array, " inputs *ensemble"]
    ) -> tuple[Array | None, Array, Array]:
        """The past of the next sample, and the early and late inputs of this one.

        `inputs` are those that leave the queue; without a queue, the newest.
        """
        if past is None:
            return None, inputs, inputs
        waiting = jnp.concatenate([inputs[None], past])
        if self.further == 1 and self.splits:  # all members' delays have the same whole samples
            return waiting[:-1], waiting[1], waiting[0]
        whole = jnp.floor(self.samples).astype(int) - self.fewest
        late = _of_age(waiting, whole)
        return waiting[:-1], _of_age(waiting, whole + 1) if self.splits else late, late


def _repeated(inputs: Float[Array, " inputs *ensemble"], count: int) -> Array | None:
    return jnp.broadcast_to(inputs, (count, *inputs.shape)) if count else None


def _of_age(queue: Float[Array, "ages ..."], age: Array) -> Array:
    # A mask, not a gather, whose reverse would be a scatter.
    ages = jnp.arange(len(queue)).reshape((-1,) + (1,) * (queue.ndim - 1))
    age = age.reshape((1,) * (queue.ndim - age.ndim) + age.shape)
    return _sum_of_rows(jnp.where(ages == age, queue, 0))


def _sum_of_rows(rows: Float[Array, "rows ..."]) -> Array:
    """By halves: a kernel cannot hold a reduction of many numbers."""
    while len(rows) > 1:
        half = len(rows) // 2
        total, odd = rows[:half] + rows[half : 2 * half], rows[2 * half :]
        rows = jnp.concatenate([total, odd]) if len(odd) else total
    return rows[0]


def delay_line(loop: Loop) -> DelayLine | None:
    """That of a loop; None without a delay."""
    length, splits, traced, fewest = loop.queue
    if length == 0:
        return None
    delay, longest = loop.delay, loop.longest_delay or 0.0
    if traced:
        wrong = (delay < 0) | (delay > longest * (1 + 1e-9)) | ~jnp.isfinite(delay)
        message = f"delay is outside 0 to longest_delay = {longest} s: raise longest_delay"
        delay = eqx.error_if(delay, wrong, message)
    samples = delay / loop.dt
    samples = samples if splits else jnp.round(samples)
    return DelayLine(samples, fewest, length - fewest, splits)
