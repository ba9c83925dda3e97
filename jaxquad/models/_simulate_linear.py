"""Exact simulation of a linear model with delayed inputs and outputs."""

import functools as ft
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int

from jaxquad._compile import brief_options, Jit
from jaxquad._core import is_concrete, require_all_positive

from ._convert import realise
from ._difference import (
    free_motion,
    free_samples,
    run_states,
    shift_samples,
    simulate_samples,
    step_with_bias,
)
from ._discrete import DiscreteTransferFunction, require_sampled
from ._state_space import dot, explicit, StateSpace
from ._transfer_function import TransferFunction


Number = float | Float[Array, ""]
Square = Float[Array, "states states"]

_TERMS = 18  # of the series at a norm of 1: 1 / 19! is below the last bit
_SQUARINGS = 30
_FEW = 8  # rows or columns


def _small_dot(a: Array, b: Array) -> Array:
    """`dot` as a sum, if all sides are short: XLA calls a library, which takes longer than that.

    Derivatives in reverse keep every term of it.
    """
    if max(*a.shape, *b.shape) > _FEW:
        return dot(a, b)
    if a.ndim == 1:
        return jnp.sum(a.reshape(-1, *(1,) * (b.ndim - 1)) * b, axis=0)
    if b.ndim == 1:
        return jnp.sum(a * b[None], axis=1)
    return jnp.sum(a[:, :, None] * b[None], axis=1)


def matrix_exponential(matrix: Square, dot: Callable[[Array, Array], Array] = dot) -> Square:
    """e to the `matrix`, by its series with scaling and squaring, and by products of `dot`.

    It compiles in a fraction of the time of `jax.scipy.linalg.expm`, and without LAPACK under vmap.
    """
    size = jnp.max(jnp.sum(jnp.abs(matrix), axis=0), initial=1.0)
    halvings = jax.lax.stop_gradient(jnp.clip(jnp.ceil(jnp.log2(size)), 0, _SQUARINGS))
    small = matrix * jnp.exp2(-halvings)
    unit = jnp.eye(len(matrix), dtype=matrix.dtype)

    def nest(power: Array, k: Array) -> tuple[Array, None]:
        return unit + dot(small, power) / k, None

    terms = jnp.arange(_TERMS, 0, -1, dtype=matrix.dtype)
    series = jax.lax.scan(nest, unit, terms)[0]
    return _squared(series, halvings, dot)


@ft.partial(jax.custom_jvp, nondiff_argnums=(2,))
def _squared(
    power: Square, times: Float[Array, ""], dot: Callable[[Array, Array], Array]
) -> Square:
    """`power` squared so many times: of most matrices hardly one, of an ensemble's as the most."""
    more = lambda state: state[1] < times
    square = lambda state: (dot(state[0], state[0]), state[1] + 1)
    return jax.lax.while_loop(more, square, (power, jnp.zeros_like(times)))[0]


@_squared.defjvp
def _squared_jvp(
    dot: Callable[[Array, Array], Array], primals: tuple[Array, Array], tangents: tuple[Array, ...]
) -> tuple[Array, Array]:
    # A loop whose length is not known has no derivative in reverse.
    power, times = primals

    def square(power: Array, k: Array) -> tuple[Array, None]:
        return jnp.where(k < times, dot(power, power), power), None

    steps = jnp.arange(_SQUARINGS, dtype=power.dtype)
    run = lambda power: jax.lax.scan(square, power, steps)[0]
    return jax.jvp(run, (power,), (tangents[0],))


_WHOLE = 1e-9  # samples; a delay this close to whole samples is whole, whatever the rounding


def split_delay(
    delay: Float[Array, "*n"], dt: Number
) -> tuple[Int[Array, "*n"], Float[Array, "*n"]]:
    """Whole samples of a delay in s, and the rest in samples; differentiable through the rest."""
    shift = jax.lax.stop_gradient(jnp.floor(delay / dt + _WHOLE))
    return shift.astype(int), delay / dt - shift


def _propagation(
    A: Square, B: Float[Array, "states inputs"], late: Float[Array, " inputs"],
    span: Float[Array, ""], dt: Number,
) -> tuple[Square, Float[Array, "segments states"]]:  # fmt: skip
    """What the first `span` samples of a sample `dt` s long make of the state and of the inputs.

    Each input goes over from one straight segment to the next after `late` samples. The second
    result acts on value and change over a whole sample of the old and of the new segment, input by
    input. A may be singular.
    """
    states = len(A)

    def of_input(b, late):
        def over(time):
            # Van Loan's augmented exponential; the second part acts on value and change.
            plant = jnp.pad(jnp.concatenate([A, b[:, None]], axis=1) * time, ((0, 0), (0, 1)))
            line = jnp.eye(2, states + 2, k=states + 1, dtype=A.dtype)
            step = matrix_exponential(jnp.concatenate([plant, line]), _small_dot)[:states]
            return step[:, :states], step[:, states:]

        old = jnp.minimum(late, span)
        new = span - old
        zero, one = jnp.zeros_like(late), jnp.ones_like(late)
        # From value and change of a segment to those over the part of it that acts.
        last = jnp.stack([jnp.stack([one, 1 - late]), jnp.stack([zero, old])])
        first = jnp.stack([jnp.stack([one, zero]), jnp.stack([zero, new])])
        both = jax.vmap(over)(jnp.stack([old, new]) * dt)
        (before, of_old), (after, of_new) = (
            jax.tree.map(lambda x, k=k: x[k], both) for k in (0, 1)
        )
        drive = [_small_dot(after, _small_dot(of_old, last)), _small_dot(of_new, first)]
        return _small_dot(after, before), jnp.concatenate(drive, axis=1)

    transition, drive = jax.vmap(of_input, in_axes=(1, 0))(B, late)
    return transition[0], jnp.swapaxes(drive, 1, 2).reshape(4 * len(late), states)


def _delay_input(
    segments: Float[Array, "samples 2"], delay: Float[Array, ""], dt: Number
) -> Float[Array, " samples"]:
    """The input itself, `delay` s late, at the samples; where it jumps, the value just after."""
    shift, late = split_delay(delay, dt)
    old, new = shift_samples(segments, shift + 1), shift_samples(segments, shift)
    # At whole samples the slope by the delay is that of a longer one.
    now = new[:, 0] - late * old[:, 1]
    return jnp.where(late <= _WHOLE, now, old[:, 0] + (1 - late) * old[:, 1])


_HOLDS = ("zero", "first")


def simulate_linear(
    model: TransferFunction | StateSpace | DiscreteTransferFunction,
    u: Float[ArrayLike, " samples"] | Float[ArrayLike, "samples inputs"], dt: Number, *,
    hold: str = "zero", direct_samples: Float[ArrayLike, "outputs inputs"] | None = None,
) -> Float[Array, " samples"] | Float[Array, "samples outputs"]:  # fmt: skip
    """Simulate a linear model from rest, exactly at the samples.

    Delays may be any fraction of a sample. Where a held input jumps, x' jumps: H1 x' is the value
    just after.

    **Arguments:**

    - `model`: a `TransferFunction`, a `StateSpace`, or a `DiscreteTransferFunction`, which has hold
        and `direct_samples` in it.
    - `u`: the input, (samples, inputs) for a `StateSpace`, (samples,) for the others; it was 0
        before the first sample.
    - `dt`: the sample interval in s.
    - `hold`: between samples the input stays at the last one ("zero") or is straight ("first").
    - `direct_samples`: after how many samples a held input passes directly, outputs per inputs; by
        default what its delays make of it, which changes by whole samples.

    **Returns:** The outputs, (samples,) or (samples, outputs).

    **Raises:** `ValueError`: `hold` is unknown, `dt` is not positive or not that of a discrete
    model, or `u` has another shape.
    """
    require_all_positive(dt=dt)
    if hold not in _HOLDS:
        raise ValueError(f"hold is {hold!r}, but it must be one of {_HOLDS}.")
    columns = model.G.shape[1] if isinstance(model, StateSpace) else None
    shape = "(samples,)" if columns is None else f"(samples, {columns})"
    u = jnp.asarray(u)
    if u.ndim != (1 if columns is None else 2) or u.shape[1:] not in ((), (columns,)):
        raise ValueError(f"u has the shape {u.shape}, but this model takes {shape}: reshape it.")
    if isinstance(model, DiscreteTransferFunction):
        if is_concrete(dt):
            require_sampled(model.dt, samples=float(dt))
        return simulate_samples(model, u)
    u = u[:, None] if columns is None else u
    segments = _segments(u, hold)
    direct = None if direct_samples is None else jnp.asarray(direct_samples)
    outputs = _simulate(_plant(model), segments, dt, direct)
    return outputs[:, 0] if columns is None else outputs


def free_responses(
    model: TransferFunction | StateSpace | DiscreteTransferFunction, samples: int, dt: Number
) -> tuple[Float[Array, "samples *outputs states"], Float[Array, "samples *outputs states"]]:
    """The outputs due to each unit initial state, and due to each unit constant bias.

    They are regressors for the start and the trim of a record. A bias adds to the derivative of a
    state, and so to H1 x'. A delayed output shows the same motion, continued to before the first
    sample.

    **Arguments:**

    - `model`: a `TransferFunction`, a `StateSpace`, or a `DiscreteTransferFunction`, whose biases
        add to the state at each sample.
    - `samples`: how many, `dt` seconds apart.

    **Returns:** Two arrays, (samples, outputs, states) of a `StateSpace`, (samples, states) of the
    others. The states of these are those of `realise`, so that only the span of the columns has a
    meaning.
    """
    if isinstance(model, DiscreteTransferFunction):
        start, bias = free_samples(model, samples)
    else:
        start, bias = _free_outputs(_plant(model), samples, dt)
    if not isinstance(model, StateSpace):
        return start[:, 0], bias[:, 0]
    return start, bias


class SampledRational(NamedTuple):
    """A model at its samples: y = B(q) u / A(q), `shift` samples late, and its free motions."""

    above: Float[Array, " zeros"]  # B, of u[k], u[k-1], ...
    below: Float[Array, " poles"]  # A without its leading 1, of y[k-1], y[k-2], ...
    shift: Int[Array, ""]
    step: Float[Array, "both both"]  # of state and constant bias over one sample
    rows: Float[Array, "1 both"]  # from these to the output


def sample_rational(
    model: TransferFunction | DiscreteTransferFunction, dt: Number, hold: str
) -> SampledRational:
    """The difference equation that `simulate_linear` solves, and what `free_responses` shows.

    **Arguments:**

    - `model`: with a numerator of no higher degree than its denominator. A discrete one is its
        difference equation, whatever the hold.
    - `dt`: the sample interval in s.
    - `hold`: as in `simulate_linear`.

    **Returns:** A `SampledRational`, differentiable by all of the model but whole samples of its
    delay.

    Source: Faddeev and LeVerrier's recursion for C adj(qI - A); Astrom & Wittenmark,
    Computer-Controlled Systems, sec. 2.3.
    """
    if isinstance(model, DiscreteTransferFunction):
        above, below = (c / model.denominator[0] for c in (model.numerator, model.denominator))
        above = jnp.pad(above, (below.size - above.size, 1))
        return SampledRational(above, below[1:], jnp.asarray(model.delay), *step_with_bias(model))
    plant = _plant(model)
    states, one = len(plant.A), jnp.ones((), plant.A.dtype)
    shift, late = split_delay(plant.input_delay, dt)
    step, drive = _propagation(plant.A, plant.B, late, one, dt)
    old, old_change, new, new_change = drive
    if hold == "first":  # by samples of u itself, the next one first
        drive = jnp.stack([new_change, old_change + new - new_change, old - old_change])
    else:
        drive = jnp.stack([jnp.zeros_like(new), new, old])
    below, row, above = [], plant.C[0], jnp.zeros(states + 2, plant.A.dtype)
    power = jnp.eye(states, dtype=plant.A.dtype)
    for k in range(states):
        above = above + jnp.pad(_small_dot(drive, _small_dot(row, power)), (k, states - 1 - k))
        power = _small_dot(step, power)
        below.append(-jnp.trace(power) / (k + 1))
        power = power + below[-1] * jnp.eye(states, dtype=plant.A.dtype)
    poles = jnp.stack(below) if below else jnp.zeros(0, plant.A.dtype)
    if plant.D is not None:
        # What `_delay_input` makes of u[k] and u[k-1].
        at_sample = jnp.where(late[0] <= _WHOLE, jnp.ones_like(late[0]), 0)
        share = 1 - late[0] if hold == "first" else at_sample
        now, before = plant.D[0, 0] * jnp.stack([share, 1 - share])
        monic = jnp.concatenate([jnp.ones(1, poles.dtype), poles])
        above = above.at[:-1].add(now * monic).at[1:].add(before * monic)
    block = _with_bias(plant.A)
    rows = jnp.concatenate([plant.C, jnp.zeros_like(plant.C)], axis=1)
    exponential = matrix_exponential(block * dt, _small_dot)
    return SampledRational(above, poles, shift[0], exponential, rows)


class _Plant(NamedTuple):
    A: Square
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


class SampledStates(NamedTuple):
    """x[k+1] = step x[k] + pushed[k], y[k] = rows x[k] + direct[k], on the host.

    The states are those of the model, a constant bias on the derivative of each, and what output
    delays remember of them.
    """

    step: Float[np.ndarray, "all all"]
    rows: Float[np.ndarray, "outputs all"]
    pushed: Float[np.ndarray, "samples all"]
    direct: Float[np.ndarray, "samples outputs"]


def sample_states(
    model: TransferFunction | StateSpace | DiscreteTransferFunction,
    u: Float[ArrayLike, "samples inputs"], dt: Number, *, hold: str = "zero",
) -> SampledStates:  # fmt: skip
    """The difference equation of the states that `simulate_linear` solves, for observers.

    **Arguments:**

    - `model`: a `StateSpace`, or a `TransferFunction` or `DiscreteTransferFunction`, whose states
        are those of `realise`.
    - `u`, `dt`, `hold`: as in `simulate_linear`, with one column for each input.

    **Returns:** a `SampledStates`.

    Source: Astrom & Wittenmark, Computer-Controlled Systems, sec. 2.3 (systems with time delay).
    """
    if isinstance(model, DiscreteTransferFunction):
        late = shift_samples(jnp.asarray(u), jnp.asarray(model.delay))
        (_, B, _, D), (step, rows) = realise(model), step_with_bias(model)
        pushed = dot(late, jnp.pad(B.T, ((0, 0), (0, len(B)))))
        return SampledStates(*map(np.asarray, (step, rows, pushed, dot(late, D.T))))
    plant = _plant(model)
    passing = jnp.zeros_like(plant.C) if plant.bias is None else plant.bias
    plant = plant._replace(
        A=_with_bias(plant.A),
        B=jnp.pad(plant.B, ((0, len(plant.A)), (0, 0))),
        C=jnp.concatenate([plant.C, passing], axis=1),
    )
    step, rows, pushed, late_pushed, direct = map(
        np.asarray, _sampled(plant, _segments(jnp.asarray(u), hold), jnp.asarray(dt))
    )
    if plant.output_delay is None:
        return SampledStates(step, rows, pushed, direct)
    # An output that is late is the last of a row of states, each of them a sample behind the other.
    first, places = len(step), []
    behind = np.asarray(split_delay(plant.output_delay, dt)[0]) + 1
    total = first + int(behind.sum())
    A, C = np.zeros((total, total)), np.zeros((len(rows), total))
    A[:first, :first] = step
    for output, count in enumerate(behind):
        at = first + int(behind[:output].sum())
        A[at, :first] = rows[output]
        A[at + 1 : at + count, at : at + count - 1] = np.eye(count - 1)
        C[output, at + count - 1] = 1.0
        places.append(at)
    driven = np.zeros((len(pushed), total))
    driven[:, :first], driven[:, places] = pushed, late_pushed
    return SampledStates(A, C, driven, direct)


@ft.partial(Jit, options=brief_options)
def _sampled(
    plant: _Plant, segments: Float[Array, "inputs samples 2"], dt: Float[Array, ""]
) -> tuple[Array, Array, Array, Array, Array]:
    """Of state and output: what goes over to the next sample, and what the inputs add to it."""
    late = split_delay(plant.input_delay, dt)[1]
    acting = _acting(plant, segments, dt)
    step, drive = _propagation(plant.A, plant.B, late, jnp.ones((), late.dtype), dt)
    rows, shown = plant.C, jnp.zeros((len(acting), len(plant.C)), acting.dtype)
    if plant.output_delay is not None:
        rows, ways = jax.vmap(lambda *one: _late_row(plant, late, dt, *one))(
            plant.C, plant.output_delay
        )
        shown = dot(acting, ways.T)
    direct = _passed(plant, segments, dt, None)
    return step, rows, dot(acting, drive), shown, jnp.zeros_like(shown) + direct


def _segments(u: Float[Array, "samples inputs"], hold: str) -> Float[Array, "inputs samples 2"]:
    """Value and change of each input from each sample to the next."""
    change = jnp.diff(u, axis=0, append=u[-1:]) if hold == "first" else jnp.zeros_like(u)
    return jnp.stack([u.T, change.T], axis=2)


def _acting(
    plant: _Plant, segments: Float[Array, "inputs samples 2"], dt: Number
) -> Float[Array, "samples segments"]:
    """What acts on the states in each sample: the old and the new segment of each input."""
    shift = split_delay(plant.input_delay, dt)[0]
    parts = [jax.vmap(shift_samples)(segments, shift + n) for n in (1, 0)]
    acting = jnp.swapaxes(jnp.concatenate(parts, axis=2), 0, 1)
    return acting.reshape(segments.shape[1], 4 * len(segments))


def _late_row(
    plant: _Plant,
    late: Float[Array, " inputs"],
    dt: Number,
    row: Float[Array, " states"],
    delay: Float[Array, ""],
) -> tuple[Float[Array, " states"], Float[Array, " segments"]]:
    """Of an output that shows the state somewhere within an earlier sample."""
    wait = split_delay(delay, dt)[1]
    step, drive = _propagation(plant.A, plant.B, late, 1 - wait, dt)
    return dot(row, step), dot(drive, row)


@ft.partial(Jit, options=brief_options)
def _simulate(
    plant: _Plant,
    segments: Float[Array, "inputs samples 2"],
    dt: Number,
    direct_samples: Float[Array, "outputs inputs"] | None,
) -> Float[Array, "samples outputs"]:
    late = split_delay(plant.input_delay, dt)[1]
    acting = _acting(plant, segments, dt)
    step, drive = _propagation(plant.A, plant.B, late, jnp.ones((), late.dtype), dt)
    states = run_states(step, dot(acting, drive))

    def late_output(row, delay):
        over, way = _late_row(plant, late, dt, row, delay)
        within = dot(states, over) + dot(acting, way)
        return shift_samples(within[:, None], split_delay(delay, dt)[0] + 1)[:, 0]

    if plant.output_delay is None:
        outputs = dot(states, plant.C.T)
    else:
        outputs = jax.vmap(late_output, out_axes=1)(plant.C, plant.output_delay)
    return outputs if plant.D is None else outputs + _passed(plant, segments, dt, direct_samples)


def _passed(
    plant: _Plant,
    segments: Float[Array, "inputs samples 2"],
    dt: Number,
    direct_samples: Float[Array, "outputs inputs"] | None,
) -> Float[Array, "samples outputs"] | Float[Array, ""]:
    """What the inputs pass directly to the outputs."""
    if plant.D is None:
        return jnp.zeros((), segments.dtype)
    if direct_samples is not None:
        shifted = jax.vmap(shift_samples, in_axes=(0, 0))
        by_both = jax.vmap(shifted, in_axes=(None, 0))(segments, direct_samples.astype(int))
        return jnp.einsum("oi,oik->ko", plant.D, by_both[..., 0], precision="highest")
    wait = plant.output_delay
    wait = jnp.zeros(len(plant.D), plant.D.dtype) if wait is None else wait
    one = lambda wait, late, segments: _delay_input(segments, wait + late, dt)
    by_input = jax.vmap(one, in_axes=(None, 0, 0))
    by_both = jax.vmap(by_input, in_axes=(0, None, None))(wait, plant.input_delay, segments)
    return jnp.einsum("oi,oik->ko", plant.D, by_both, precision="highest")


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
    motion = free_motion(matrix_exponential(block * dt), rows, samples)
    return motion[:, :, :states], motion[:, :, states:]


def _with_bias(A: Square) -> Float[Array, "both both"]:
    """Of x' = A x + bias, for state and bias."""
    both = jnp.concatenate([A, jnp.eye(len(A), dtype=A.dtype)], axis=1)
    return jnp.concatenate([both, jnp.zeros_like(both)])
