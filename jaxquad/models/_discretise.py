import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import expm
from jaxtyping import Array, ArrayLike, Float, Int

from ._realise import realise
from ._transfer_function import TransferFunction


_HOLDS = ("zero", "first")
_WHOLE = 1e-9  # samples; a delay this close to whole samples is whole, whatever the rounding


class Sampled(eqx.Module):
    """x[k+1] = A x[k] + B w[k], y[k] = C x[k] + D w[k]: a delayed linear model between samples.

    The drive w[k] stacks value and change over one sample of the input's segments k - shift - 1 and
    k - shift, the two that act during sample k.
    """

    A: Float[Array, "states states"]
    B: Float[Array, "states segments"]
    C: Float[Array, "outputs states"]
    D: Float[Array, "outputs segments"]
    shift: Int[Array, ""]  # whole samples of delay


def sampled(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    C: Float[Array, "outputs states"],
    D: Float[Array, "outputs inputs"],
    delay: Float[Array, ""],
    dt: float,
) -> Sampled:
    """Discretise exactly, for an input that is straight within each `dt` and a `delay`, both in s.

    The fraction of a sample in the delay splits each sample in two, with one input segment in each;
    A may be singular. The result is differentiable in the delay.
    """
    shift = jax.lax.stop_gradient(jnp.floor(delay / dt + _WHOLE))
    late = delay / dt - shift
    old, new = _parts(late, B.shape[1])
    spans = jnp.stack([late, 1 - late]) * dt
    (first, second), (effect_of_old, effect_of_new) = jax.vmap(_propagate, in_axes=(None, None, 0))(
        A, B, spans
    )
    drive = [_dot(second, _dot(effect_of_old, old)), _dot(effect_of_new, new)]
    whole, values = late <= _WHOLE, slice(B.shape[1])
    at_sample = [jnp.where(whole, 0, old[values]), jnp.where(whole, new[values], 0)]
    return Sampled(
        _dot(second, first),
        jnp.concatenate(drive, axis=1),
        C,
        _dot(D, jnp.concatenate(at_sample, axis=1)),
        shift.astype(int),
    )


def simulate_linear(
    model: TransferFunction, u: Float[ArrayLike, " samples"], dt: float, *, hold: str = "zero"
) -> Float[Array, " samples"]:
    """The output at the samples of an input `u`, which was 0 before the first: exact, from rest.

    Between samples `dt` seconds apart the input stays at the last one (`hold="zero"`) or runs
    straight to the next (`hold="first"`). Raises ValueError for another hold, and for a `dt` that
    is not positive.
    """
    if not dt > 0:
        raise ValueError(f"dt is {dt} s: give a positive sample interval")
    return _respond(model, _segments(jnp.asarray(u), hold), dt)


@eqx.filter_jit
def free_responses(
    model: TransferFunction, samples: int, dt: float
) -> tuple[Float[Array, "samples states"], Float[Array, "samples states"]]:
    """The outputs, `dt` seconds apart, of each unit initial state, and of each unit constant bias.

    A bias adds to the derivative of a state. The states are those of `realise`, so only the span
    of the columns has a meaning: they are regressors for the unknown start and trim of a record.
    """
    A, _, C, _ = realise(model)
    one = jnp.eye(len(A), dtype=A.dtype)
    block = jnp.block([[A, one], [jnp.zeros_like(A), jnp.zeros_like(A)]])
    step = expm(block * dt)
    output = jnp.concatenate([C[0], jnp.zeros_like(C[0])])
    rows = jax.lax.scan(lambda y, _: (_dot(y, step), y), output, length=samples)[1]
    return rows[:, : len(A)], rows[:, len(A) :]


def _parts(
    late: Float[Array, ""], inputs: int
) -> tuple[Float[Array, "segments segments"], Float[Array, "segments segments"]]:
    # From value and change of a segment to those of its last part, `late`, and of its first part.
    one = jnp.eye(inputs, dtype=late.dtype)
    none, early = jnp.zeros_like(one), (1 - late) * one
    return jnp.block([[one, early], [none, late * one]]), jnp.block([[one, none], [none, early]])


def _propagate(
    A: Float[Array, "states states"], B: Float[Array, "states inputs"], time: Float[Array, ""]
) -> tuple[Float[Array, "states states"], Float[Array, "states segments"]]:
    # Van Loan's augmented exponential; `effect` acts on the input's value and change over `time`.
    states, inputs = B.shape
    plant = jnp.pad(jnp.concatenate([A, B], axis=1) * time, ((0, 0), (0, inputs)))
    line = jnp.eye(2 * inputs, states + 2 * inputs, k=states + inputs, dtype=A.dtype)
    step = expm(jnp.concatenate([plant, line]))[:states]
    return step[:, :states], step[:, states:]


@eqx.filter_jit
def _respond(
    model: TransferFunction, segments: Float[Array, "samples 2"], dt: float
) -> Float[Array, " samples"]:
    system = sampled(*realise(model), model.delay, dt)
    old, new = (_shifted(segments, system.shift + n) for n in (1, 0))
    drive = jnp.concatenate([old, new], axis=1)

    def sample(x, w):
        return _dot(system.A, x) + w, x

    rest = jnp.zeros(len(system.A), segments.dtype)
    states = jax.lax.scan(sample, rest, _dot(drive, system.B.T))[1]
    return (_dot(states, system.C.T) + _dot(drive, system.D.T))[:, 0]


def _segments(u: Float[Array, " samples"], hold: str) -> Float[Array, "samples 2"]:
    if hold not in _HOLDS:
        raise ValueError(f"hold is {hold!r}, which does not exist: use one of {_HOLDS}.")
    change = jnp.diff(u, append=u[-1:]) if hold == "first" else jnp.zeros_like(u)
    return jnp.stack([u, change], axis=1)


def _shifted(x: Float[Array, "samples 2"], shift: Int[Array, ""]) -> Float[Array, "samples 2"]:
    index = jnp.arange(len(x)) - shift
    return jnp.where(index[:, None] >= 0, x[jnp.maximum(index, 0)], 0)


def _dot(a: Array, b: Array) -> Array:
    return jnp.dot(a, b, precision="highest")  # a GPU would round float32 products to 10 bits
