"""Exact simulation of a linear model with delayed inputs and outputs."""

import functools as ft
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, Int

from jaxquad._compile import brief_options, Jit
from jaxquad._core import require_all_positive

from ._connect import realise
from ._exponential import dot, matrix_exponential, small_dot
from ._state_space import explicit, StateSpace
from ._transfer_function import TransferFunction


Number = float | Float[Array, ""]

_WHOLE = 1e-9  # samples; a delay this close to whole samples is whole, whatever the rounding


def split_delay(
    delay: Float[Array, "*n"], dt: Number
) -> tuple[Int[Array, "*n"], Float[Array, "*n"]]:
    """Whole samples of a delay in s, and the rest in samples; differentiable through the rest."""
    shift = jax.lax.stop_gradient(jnp.floor(delay / dt + _WHOLE))
    return shift.astype(int), delay / dt - shift


def propagation(
    A: Float[Array, "states states"],
    B: Float[Array, "states inputs"],
    late: Float[Array, " inputs"],
    span: Float[Array, ""],
    dt: Number,
) -> tuple[Float[Array, "states states"], Float[Array, "segments states"]]:
    """What the first `span` samples of a sample `dt` s long make of the state and of the inputs.

    Each input goes over from one straight segment to the next after `late` samples. The second
    result acts on value and change over a whole sample of the old and of the new segment, input by
    input. A may be singular.
    """
    over = lambda b, late: _crossing(A, b[:, None], late, span, dt)
    transition, drive = jax.vmap(over, in_axes=(1, 0))(B, late)
    return transition[0], jnp.swapaxes(drive, 1, 2).reshape(4 * len(late), len(A))


def _crossing(A, b, late, span, dt):
    old = jnp.minimum(late, span)
    new = span - old
    zero, one = jnp.zeros_like(late), jnp.ones_like(late)
    # From value and change of a segment to those over the part of it that acts.
    last = jnp.stack([jnp.stack([one, 1 - late]), jnp.stack([zero, old])])
    first = jnp.stack([jnp.stack([one, zero]), jnp.stack([zero, new])])
    both = jax.vmap(lambda time: _propagate(A, b, time))(jnp.stack([old, new]) * dt)
    (before, of_old), (after, of_new) = (jax.tree.map(lambda x, k=k: x[k], both) for k in (0, 1))
    drive = [small_dot(after, small_dot(of_old, last)), small_dot(of_new, first)]
    return small_dot(after, before), jnp.concatenate(drive, axis=1)


def _propagate(
    A: Float[Array, "states states"], B: Float[Array, "states 1"], time: Float[Array, ""]
) -> tuple[Float[Array, "states states"], Float[Array, "states 2"]]:
    # Van Loan's augmented exponential; the second part acts on value and change over `time`.
    states = len(A)
    plant = jnp.pad(jnp.concatenate([A, B], axis=1) * time, ((0, 0), (0, 1)))
    line = jnp.eye(2, states + 2, k=states + 1, dtype=A.dtype)
    step = matrix_exponential(jnp.concatenate([plant, line]), small_dot)[:states]
    return step[:, :states], step[:, states:]


def delay_input(
    segments: Float[Array, "samples 2"], delay: Float[Array, ""], dt: Number
) -> Float[Array, " samples"]:
    """The input itself, `delay` s late, at the samples; where it jumps, the value just after."""
    shift, late = split_delay(delay, dt)
    old, new = shift_samples(segments, shift + 1), shift_samples(segments, shift)
    # At whole samples the slope by the delay is that of a longer one.
    now = new[:, 0] - late * old[:, 1]
    return jnp.where(late <= _WHOLE, now, old[:, 0] + (1 - late) * old[:, 1])


def shift_samples(
    x: Float[Array, "samples columns"], shift: Int[Array, ""]
) -> Float[Array, "samples columns"]:
    """`x` so many samples later, and zero before."""
    index = jnp.arange(len(x)) - shift
    return jnp.where(index[:, None] >= 0, x[jnp.maximum(index, 0)], 0)


def recursion(
    A: Float[Array, "states states"], drive: Float[Array, "samples states"]
) -> Float[Array, "samples states"]:
    """x[k] of x[k+1] = A x[k] + drive[k], from x[0] = 0."""
    samples, states = drive.shape
    length = _chunk(samples)
    chunks = -(-samples // length)
    padded = jnp.pad(drive, ((0, chunks * length - samples), (0, 0)))
    by_place = jnp.swapaxes(padded.reshape(chunks, length, states), 0, 1)

    def sample(x, w):
        return dot(x, A.T) + w, x

    ends, within = jax.lax.scan(sample, jnp.zeros((chunks, states), drive.dtype), by_place)
    steps, over = powers(A, length)
    starts = jax.lax.scan(lambda x, w: (dot(over, x) + w, x), jnp.zeros_like(ends[0]), ends)[1]
    carried = jnp.einsum("lij,cj->lci", steps, starts, precision="highest")
    return jnp.swapaxes(within + carried, 0, 1).reshape(chunks * length, states)[:samples]


def free_motion(
    rows: Float[Array, "outputs states"], A: Float[Array, "states states"], samples: int
) -> Float[Array, "samples outputs states"]:
    """`rows` A^k for each sample k."""
    length = _chunk(samples)
    steps, over = powers(A, length)
    chunks = powers(over, -(-samples // length))[0]
    starts = jnp.einsum("oi,cij->coj", rows, chunks, precision="highest")
    found = jnp.einsum("coi,lij->cloj", starts, steps, precision="highest")
    return found.reshape(len(chunks) * length, *rows.shape)[:samples]


def powers(
    A: Float[Array, "states states"], count: int
) -> tuple[Float[Array, "count states states"], Float[Array, "states states"]]:
    """A^0 to A^(count - 1), and A^count."""
    one = jnp.eye(len(A), dtype=A.dtype)
    last, found = jax.lax.scan(lambda P, _: (dot(A, P), P), one, length=count)
    return found, last


def _chunk(samples: int) -> int:
    return max(1, round(samples**0.5))


_HOLDS = ("zero", "first")


def simulate_linear(
    model: TransferFunction | StateSpace,
    u: Float[ArrayLike, " samples"] | Float[ArrayLike, "samples inputs"],
    dt: Number,
    *,
    hold: str = "zero",
) -> Float[Array, " samples"] | Float[Array, "samples outputs"]:
    """Simulate a linear model from rest, exactly at the samples.

    Delays may be any fraction of a sample. Where a held input jumps, x' jumps: H1 x' is the value
    just after.

    **Arguments:**

    - `model`: a `TransferFunction`, or a `StateSpace`.
    - `u`: the input, (samples,) for a `TransferFunction`, (samples, inputs) for a `StateSpace`; it
        was 0 before the first sample.
    - `dt`: the sample interval in s.
    - `hold`: between samples the input stays at the last one ("zero") or is straight ("first").

    **Returns:**

    The outputs, (samples,) or (samples, outputs).

    **Raises:**

    - `ValueError`: `hold` is unknown, `dt` is not positive, or `u` has another shape.
    """
    require_all_positive(dt=dt)
    if hold not in _HOLDS:
        raise ValueError(f"hold is {hold!r}, but it must be one of {_HOLDS}.")
    inputs = _inputs(model, jnp.asarray(u))
    found = _simulate(_plant(model), _segments(inputs, hold), dt)
    return found[:, 0] if isinstance(model, TransferFunction) else found


def free_responses(
    model: TransferFunction | StateSpace, samples: int, dt: Number
) -> tuple[Float[Array, "samples *outputs states"], Float[Array, "samples *outputs states"]]:
    """The outputs due to each unit initial state, and due to each unit constant bias.

    They are regressors for the start and the trim of a record. A bias adds to the derivative of a
    state, and so to H1 x'. A delayed output shows the same motion, continued to before the first
    sample.

    **Arguments:**

    - `model`: a `TransferFunction`, or a `StateSpace`.
    - `samples`: how many, `dt` seconds apart.

    **Returns:**

    Two arrays, (samples, outputs, states) of a `StateSpace`, (samples, states) of a
    `TransferFunction`. The states of the latter are those of `realise`, so that only the span of
    the columns has a meaning.
    """
    start, bias = _free_outputs(_plant(model), samples, dt)
    if isinstance(model, TransferFunction):
        return start[:, 0], bias[:, 0]
    return start, bias


class SampledRational(NamedTuple):
    """A model at its samples: y = B(q) u / A(q), `shift` samples late, and its free motions."""

    above: Float[Array, " zeros"]  # B, of u[k], u[k-1], ...
    below: Float[Array, " poles"]  # A without its leading 1, of y[k-1], y[k-2], ...
    shift: Int[Array, ""]
    step: Float[Array, "both both"]  # of state and constant bias over one sample
    rows: Float[Array, "1 both"]  # from these to the output


def sample_rational(model: TransferFunction, dt: Number, hold: str) -> SampledRational:
    """The difference equation that `simulate_linear` solves, and what `free_responses` shows.

    **Arguments:**

    - `model`: with a numerator of no higher degree than its denominator.
    - `dt`: the sample interval in s.
    - `hold`: as in `simulate_linear`.

    **Returns:**

    A `SampledRational`, differentiable by all of the model but whole samples of its delay.

    Source: Faddeev and LeVerrier's recursion for C adj(qI - A); Astrom & Wittenmark,
    Computer-Controlled Systems, sec. 2.3.
    """
    plant = _plant(model)
    states, one = len(plant.A), jnp.ones((), plant.A.dtype)
    shift, late = split_delay(plant.input_delay, dt)
    step, drive = propagation(plant.A, plant.B, late, one, dt)
    old, old_change, new, new_change = drive
    if hold == "first":  # by samples of u itself, the next one first
        drive = jnp.stack([new_change, old_change + new - new_change, old - old_change])
    else:
        drive = jnp.stack([jnp.zeros_like(new), new, old])
    below, row, above = [], plant.C[0], jnp.zeros(states + 2, plant.A.dtype)
    power = jnp.eye(states, dtype=plant.A.dtype)
    for k in range(states):
        above = above + jnp.pad(small_dot(drive, small_dot(row, power)), (k, states - 1 - k))
        power = small_dot(step, power)
        below.append(-jnp.trace(power) / (k + 1))
        power = power + below[-1] * jnp.eye(states, dtype=plant.A.dtype)
    poles = jnp.stack(below) if below else jnp.zeros(0, plant.A.dtype)
    if plant.D is not None:
        now, before = plant.D[0, 0] * _direct(late[0], hold)
        whole = jnp.concatenate([jnp.ones(1, poles.dtype), poles])
        above = above.at[:-1].add(now * whole).at[1:].add(before * whole)
    block = _with_bias(plant.A)
    rows = jnp.concatenate([plant.C, jnp.zeros_like(plant.C)], axis=1)
    exponential = matrix_exponential(block * dt, small_dot)
    return SampledRational(above, poles, shift[0], exponential, rows)


def _direct(late: Float[Array, ""], hold: str) -> Float[Array, "2"]:
    """What `delay_input` makes of u[k] and u[k-1]."""
    whole = jnp.where(late <= _WHOLE, jnp.ones_like(late), 0)
    share = 1 - late if hold == "first" else whole
    return jnp.stack([share, 1 - share])


class _Plant(NamedTuple):
    A: Float[Array, "states states"]
    B: Float[Array, "states inputs"]
    C: Float[Array, "outputs states"]
    D: Float[Array, "outputs inputs"] | None
    bias: Float[Array, "outputs states"] | None  # H1, through which a bias on x' passes
    input_delay: Float[Array, " inputs"]
    output_delay: Float[Array, " outputs"] | None


def _plant(model: TransferFunction | StateSpace) -> _Plant:
    if isinstance(model, TransferFunction):
        return _Plant(*realise(model), None, jnp.atleast_1d(model.delay), None)
    A, B, C, D = explicit(model)
    late = jnp.zeros(B.shape[1], B.dtype) if model.input_delay is None else model.input_delay
    passing = None if model.H1 is None else D
    return _Plant(A, B, C, passing, model.H1, late, model.output_delay)


def _inputs(model: TransferFunction | StateSpace, u: Array) -> Float[Array, "samples inputs"]:
    if isinstance(model, TransferFunction):
        wanted, right = "(samples,)", u.ndim == 1
    else:
        columns = model.G.shape[1]
        wanted, right = f"(samples, {columns})", u.ndim == 2 and u.shape[1] == columns
    if not right:
        raise ValueError(f"u has the shape {u.shape}, but this model takes {wanted}: reshape it.")
    return u[:, None] if u.ndim == 1 else u


def _segments(u: Float[Array, "samples inputs"], hold: str) -> Float[Array, "inputs samples 2"]:
    change = jnp.diff(u, axis=0, append=u[-1:]) if hold == "first" else jnp.zeros_like(u)
    return jnp.stack([u.T, change.T], axis=2)


@ft.partial(Jit, options=brief_options)
def _simulate(
    plant: _Plant, segments: Float[Array, "inputs samples 2"], dt: Number
) -> Float[Array, "samples outputs"]:
    shift, late = split_delay(plant.input_delay, dt)
    parts = [jax.vmap(shift_samples)(segments, shift + n) for n in (1, 0)]
    acting = jnp.swapaxes(jnp.concatenate(parts, axis=2), 0, 1)
    acting = acting.reshape(segments.shape[1], 4 * len(segments))
    step, drive = propagation(plant.A, plant.B, late, jnp.ones((), late.dtype), dt)
    states = recursion(step, dot(acting, drive))
    if plant.output_delay is None:
        found = dot(states, plant.C.T)
    else:
        found = _late_outputs(plant, states, acting, late, dt)
    return found if plant.D is None else found + _direct_outputs(plant, plant.D, segments, dt)


def _late_outputs(
    plant: _Plant,
    states: Float[Array, "samples states"],
    acting: Float[Array, "samples segments"],
    late: Float[Array, " inputs"],
    dt: Number,
) -> Float[Array, "samples outputs"]:
    # An output that is late shows the state somewhere within an earlier sample.
    def output(row, delay):
        shift, wait = split_delay(delay, dt)
        step, drive = propagation(plant.A, plant.B, late, 1 - wait, dt)
        within = dot(states, dot(row, step)) + dot(acting, dot(drive, row))
        return shift_samples(within[:, None], shift + 1)[:, 0]

    return jax.vmap(output, out_axes=1)(plant.C, plant.output_delay)


def _direct_outputs(
    plant: _Plant, D: Array, segments: Float[Array, "inputs samples 2"], dt: Number
) -> Float[Array, "samples outputs"]:
    wait = jnp.zeros(len(D), D.dtype) if plant.output_delay is None else plant.output_delay
    one = lambda wait, late, segments: delay_input(segments, wait + late, dt)
    by_input = jax.vmap(one, in_axes=(None, 0, 0))
    by_both = jax.vmap(by_input, in_axes=(0, None, None))(wait, plant.input_delay, segments)
    return jnp.einsum("oi,oik->ko", D, by_both, precision="highest")


@ft.partial(Jit, options=brief_options)
def _free_outputs(
    plant: _Plant, samples: int, dt: Number
) -> tuple[Float[Array, "samples outputs states"], Float[Array, "samples outputs states"]]:
    states, block = len(plant.A), _with_bias(plant.A)
    bias = jnp.zeros_like(plant.C) if plant.bias is None else plant.bias
    rows = jnp.concatenate([plant.C, bias], axis=1)
    if plant.output_delay is not None:
        back = jax.vmap(lambda delay: matrix_exponential(-delay * block))(plant.output_delay)
        rows = jnp.einsum("oi,oij->oj", rows, back, precision="highest")
    found = free_motion(rows, matrix_exponential(block * dt), samples)
    return found[:, :, :states], found[:, :, states:]


def _with_bias(A: Float[Array, "states states"]) -> Float[Array, "both both"]:
    """Of x' = A x + bias, for state and bias."""
    both = jnp.concatenate([A, jnp.eye(len(A), dtype=A.dtype)], axis=1)
    return jnp.concatenate([both, jnp.zeros_like(both)])
