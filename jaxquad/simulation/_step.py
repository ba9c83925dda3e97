"""One sample of a loop, and what keeps an unstable one finite in values and derivatives.

A member whose angle leaves the bound, or whose numbers grow beyond all measure, is held where it
was from then on.
"""

import functools as ft
from collections.abc import Callable
from typing import cast, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, ArrayLike, Bool, Float, Int, PyTree

from jaxquad._compile import KEPT, Queue
from jaxquad._core import align
from jaxquad.control import Setpoint
from jaxquad.loops import CarriesPayload, ChecksState, Controller, Drive, Plant, Sensor

from ._hardware import DelayLine
from ._scenario import Scenario


def runge_kutta(
    derivative: Callable[[PyTree], PyTree], state: PyTree, dt: Float[ArrayLike, "*ensemble"]
) -> PyTree:
    """One classical fourth-order step of an autonomous system: the inputs are held in it.

    `dt` in s may differ between the members of an ensemble, the trailing axes of the state.
    """
    spans = jax.tree.map(lambda x: _over(dt, x), state)

    def ahead(slope: PyTree, share: float) -> PyTree:
        return jax.tree.map(lambda x, h, k: x + share * h * k, state, spans, slope)

    k1 = derivative(state)
    k2 = derivative(ahead(k1, 0.5))
    k3 = derivative(ahead(k2, 0.5))
    k4 = derivative(ahead(k3, 1.0))
    return jax.tree.map(
        lambda x, h, a, b, c, d: x + h / 6 * (a + 2 * b + 2 * c + d), state, spans, k1, k2, k3, k4
    )


_STAGES = ((0.0, 0.5, 0.5, 1.0), (1.0, 2.0, 2.0, 1.0))  # how far ahead, and sixfold weights


def _rolled_runge_kutta(
    derivative: Callable[[PyTree], PyTree], state: PyTree, dt: Float[ArrayLike, "*ensemble"]
) -> PyTree:
    """`runge_kutta` in the same order, its stages in a loop: the derivative is compiled once.

    Its gradient compiles in half the time. In an ensemble it runs as fast; a single loop, whose
    arithmetic takes no longer than to hand on a state, is a quarter slower.
    """
    spans = jax.tree.map(lambda x: _over(dt, x), state)

    @ft.partial(jax.checkpoint, prevent_cse=False)
    def stage(carry: tuple[PyTree, PyTree], now: tuple[Array, Array]) -> tuple[PyTree, None]:
        (slope, total), (share, weight) = carry, now
        slope = derivative(jax.tree.map(lambda x, h, k: x + share * h * k, state, spans, slope))
        return (slope, jax.tree.map(lambda t, k: t + weight * k, total, slope)), None

    still = jax.tree.map(jnp.zeros_like, state)
    dtype = jnp.result_type(*jax.tree.leaves(state))
    ahead, weights = _STAGES
    stages = jnp.asarray(ahead, dtype), jnp.asarray(weights, dtype)
    total = jax.lax.scan(stage, (still, still), stages)[0][1]
    return jax.tree.map(lambda x, h, t: x + h / 6 * t, state, spans, total)


def integrate(
    derivative: Callable[[PyTree], PyTree], state: PyTree, duration: Float[ArrayLike, "*ensemble"],
    substeps: int, *, rolled: bool = False,
) -> PyTree:  # fmt: skip
    """`duration` seconds in `substeps` equal Runge-Kutta steps, whose stages may be `rolled`."""
    step = _rolled_runge_kutta if rolled else runge_kutta
    if substeps == 1:
        return step(derivative, state, duration)

    @jax.checkpoint
    def substep(state: PyTree, _: None) -> tuple[PyTree, None]:
        return step(derivative, state, duration / substeps), None

    return jax.lax.scan(substep, state, None, length=substeps)[0]


def _over(dt: Float[ArrayLike, "*ensemble"], leaf: Array) -> Float[ArrayLike, "..."]:
    rank = jnp.ndim(dt)
    return dt if rank == 0 else jnp.reshape(dt, (1,) * (leaf.ndim - rank) + jnp.shape(dt))


class SampleResult(NamedTuple):
    """One sample of a loop, as wide as the ensemble."""

    index: Int[Array, ""]
    time: Float[Array, ""]  # s
    angle: Float[Array, " axes *ensemble"]  # true, rad
    measurement: Float[Array, " axes *ensemble"]  # rad
    reference: Float[Array, " axes *ensemble"]  # rad
    requested: Float[Array, " axes *ensemble"]  # of the drive, by controller and injection
    command: Float[Array, " axes *ensemble"]  # achieved
    saturated: Bool[Array, " axes *ensemble"]  # the drive gave less than was asked
    injection: Float[Array, " axes *ensemble"]
    disturbance: Float[Array, " axes *ensemble"]  # N m
    signals: dict[str, Array]  # of the controller, [axes, *ensemble]
    running: Bool[Array, "*ensemble"]  # not so from the sample on at which a member is held


class Carry(NamedTuple):
    """What a loop hands from sample to sample."""

    state: PyTree  # of the plant
    memory: PyTree  # of the controller
    past: Float[Array, "past inputs *ensemble"] | None  # inputs that have left the queue
    running: Bool[Array, "*ensemble"]
    queue: Queue | None = None  # inputs that no member feels yet; after a sample the newest alone


class LoopStep(eqx.Module):
    """A loop ready to be run: one sample after the other."""

    plant: Plant
    controller: Controller
    drive: Drive | None
    encoder: Sensor | None
    line: DelayLine | None
    dt: float = eqx.field(static=True)  # s
    substeps: int = eqx.field(static=True)
    bound: float = eqx.field(static=True)  # rad
    ensemble: tuple[int, ...] = eqx.field(static=True)

    def begin(self, state: PyTree, like: Float[Array, " axes *ensemble"]) -> Carry:
        """At rest: before the first command arrives, the inputs are those of none."""
        line, inputs = self.line, self._driven(like)[0]
        waiting = lambda count: jnp.broadcast_to(inputs, (count, *inputs.shape)) if count else None
        further, fewest = (0, 0) if line is None else (line.further, line.fewest)
        past, queue = waiting(further), waiting(fewest)
        return Carry(state, self.controller.init(like), past, jnp.ones(self.ensemble, bool), queue)

    def sample(
        self, carry: Carry, index: Int[Array, ""], happens: Scenario,
        oldest: Float[Array, " inputs *ensemble"] | None = None,
    ) -> tuple[Carry, SampleResult]:  # fmt: skip
        """Measure, control, and hold the inputs until the next sample.

        `oldest` are the inputs that leave the queue; the next carry's queue has the newest alone.
        """
        angle = self.plant.measure(carry.state)
        bound, parts = self.bound, happens.parts  # one scenario for all members of an ensemble
        widen = lambda x: jnp.broadcast_to(align(x, angle), angle.shape).astype(angle.dtype)
        where = lambda h: [vars(h)[name] for name in parts]
        happens = eqx.tree_at(where, happens, [widen(x) for x in parts.values()])
        fine = carry.running & jnp.all(jnp.abs(angle) <= bound, axis=0)
        angle = jnp.clip(jnp.where(jnp.isnan(angle), bound, angle), -bound, bound)
        measurement = angle + happens.noise
        measurement = measurement if self.encoder is None else self.encoder(measurement)
        memory, requested, inputs, achieved, fine = self._answer(carry, measurement, happens, fine)
        felt = inputs if oldest is None else oldest
        record = getattr(self.controller, "signals", None)
        signals = {} if record is None else record(memory)
        following = self._move(carry, memory, felt, happens, fine)
        if oldest is not None:
            following = following._replace(queue=inputs[None])
        rounding = 1e3 * float(jnp.finfo(requested.dtype).eps)
        result = SampleResult(
            index=index,
            time=index.astype(angle.dtype) * self.dt,
            angle=angle,
            measurement=measurement,
            reference=happens.reference,
            requested=requested,
            command=jnp.where(fine, achieved, 0),
            saturated=jnp.abs(requested - achieved) > rounding * (1 + jnp.abs(requested)),
            injection=happens.injection,
            disturbance=happens.disturbance,
            signals={
                name: jnp.broadcast_to(align(x, angle), angle.shape) for name, x in signals.items()
            },
            running=fine,
        )
        # Unchanged, but batched by `jax.vmap` where `fine` is, because the derivatives of `guarded`
        # are: JAX does not widen the value where only the derivatives of a custom rule are wide.
        return following, choose(fine, result, result, self.ensemble)

    def _answer(
        self, carry: Carry, measurement: Float[Array, " axes *ensemble"], happens: Scenario,
        fine: Bool[Array, "*ensemble"],
    ) -> tuple[PyTree, Array, Array, Array, Array]:  # fmt: skip
        """The controller's memory, what it asked for, what the drive makes of it, who is fine."""
        reference, slopes = happens.reference, (happens.rate, happens.acceleration)
        if any(x is not None for x in slopes):
            still = jnp.zeros_like(reference)
            reference = Setpoint(reference, *(still if x is None else x for x in slopes))
        memory, command = self.controller.step(carry.memory, reference, measurement)
        if command.shape != measurement.shape:
            raise ValueError(
                f"the controller's command has the shape {command.shape}, but {measurement.shape} "
                "is expected: make its fields that differ between members by jq.loops.per_member"
            )
        fine = fine & are_tame(command, self.ensemble)
        requested = jnp.where(fine, command, 0) + happens.injection
        inputs, achieved = self._driven(requested)
        if applied := getattr(self.controller, "applied", None):
            memory = applied(memory, achieved)
        # No float is nan; inf may be a bound or a spread that is not known.
        fine = fine & _members(memory, self.ensemble, lambda x: ~jnp.isnan(x))
        return choose(fine, memory, carry.memory, self.ensemble), requested, inputs, achieved, fine

    def _move(
        self, carry: Carry, memory: PyTree, inputs: Array, happens: Scenario, fine: Array
    ) -> Carry:
        """To the next sample, unless it leads out of what can be computed on."""
        past, state = self._integrate(carry, inputs, happens)
        runs = fine & are_tame(state, self.ensemble)
        if isinstance(self.plant, ChecksState):
            runs = runs & self.plant.is_resolved(state)
        state, past = choose(runs, (state, past), (carry.state, carry.past), self.ensemble)
        return Carry(state, memory, past, runs)

    def _driven(self, command: Float[Array, " axes *ensemble"]) -> tuple[Array, Array]:
        if self.drive is None:
            return command, command
        inputs = self.drive.inputs(command)
        return inputs, self.drive.achieved(inputs)

    def _integrate(
        self, carry: Carry, inputs: Float[Array, " inputs *ensemble"], happens: Scenario
    ) -> tuple[Array | None, PyTree]:
        """The inputs on their way and the plant's state, both at the next sample."""
        plant, line, dt = self.plant, self.line, self.dt
        if happens.payload is not None and isinstance(plant, CarriesPayload):
            plant = plant.with_added_inertia(happens.payload)

        def hold(state: PyTree, now: tuple[Array, ArrayLike]) -> tuple[PyTree, None]:
            inputs, duration = now
            slope = lambda x: plant.derivative(x, inputs, happens.disturbance)
            rolled = self.ensemble != ()
            return integrate(slope, state, duration, self.substeps, rolled=rolled), None

        if line is None:
            return None, hold(carry.state, (inputs, dt))[0]
        past, early, late = line.step(carry.past, inputs)
        if not line.splits:
            return past, hold(carry.state, (late, dt))[0]
        samples = line.samples.astype(inputs.dtype)
        share = samples - jnp.floor(samples)  # of the interval, with the early inputs
        both = jnp.stack([early, late]), jnp.stack([share, 1 - share]) * dt
        return past, jax.lax.scan(hold, carry.state, both)[0]  # the plant is compiled once


def require_runnable(controller: object) -> Controller:
    """The controller, or ValueError for one that can only be analysed."""
    kind = type(controller)  # Python takes 10 us to compare an object with a protocol
    methods = callable(getattr(kind, "init", None)) and callable(getattr(kind, "step", None))
    if methods or isinstance(controller, Controller):
        return cast(Controller, controller)
    raise ValueError(
        f"a {type(controller).__name__} cannot be run: a controller needs init(like) and "
        "step(state, reference, measurement)"
    )


# In SI units no angle, rate, voltage or squared rotor speed comes near it.
VAST = 1e9


def are_tame(tree: PyTree, ensemble: tuple[int, ...]) -> Bool[Array, "*ensemble"]:
    """Whether every float of a member is finite and not vast."""
    return _members(tree, ensemble, lambda x: jnp.abs(x) <= VAST)


def choose(
    fresh: Bool[Array, "*ensemble"], new: PyTree, old: PyTree, ensemble: tuple[int, ...]
) -> PyTree:
    """Per member the `new` numbers or the `old`; what all members share is always new.

    So is a single integer, such as a count of samples, in a single loop, too: what happens at some
    samples only (`jax.lax.cond`) then stays so for all that are batched by `jax.vmap`.
    """

    def leaf(new: Array, old: Array) -> Array:
        count = new.ndim == 0 and jnp.issubdtype(new.dtype, jnp.integer)
        if count or not _is_per_member(new, ensemble):
            return new
        return jnp.where(fresh.reshape((1,) * (new.ndim - fresh.ndim) + ensemble), new, old)

    return jax.tree.map(leaf, new, old)


@ft.partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def guarded(
    sample: Callable[..., PyTree], ensemble: tuple[int, ...], rest: PyTree, *args: PyTree
) -> PyTree:
    """`sample(*args)`, whose derivatives are those of the members that run after it.

    The first of `args` is the carry, which tells who runs; `rest` is one that is safe to step from.
    Reverse mode multiplies by a derivative even where its result is thrown away, and 0 * inf is
    nan. So the sample of a member that is held is differentiated at `rest`, and the result is 0.
    """
    return sample(*args)


@guarded.defjvp
def _guarded_jvp(sample, ensemble, primals, tangents):
    rest, carry, *others = primals
    following, result = sample(carry, *others)
    keep = lambda x: checkpoint_name(x, KEPT)  # for reverse mode: who runs, and what was measured
    runs = keep(following.running)
    out = following._replace(running=runs), jax.tree.map(keep, result)
    carry = choose(runs, carry, rest, ensemble)
    moved = jax.jvp(sample, (carry, *others), tangents[1:])[1]
    still = jax.tree.map(lambda t: t if _is_void(t) else jnp.zeros_like(t), moved)
    return out, choose(runs, moved, still, ensemble)


def _is_void(tangent: Array) -> bool:  # of an integer, which has no tangent
    return tangent.dtype == jax.dtypes.float0


def _members(tree: PyTree, ensemble: tuple[int, ...], valid) -> Bool[Array, "*ensemble"]:
    checks = [jnp.ones(ensemble, bool)]
    for x in jax.tree.leaves(tree):
        if jnp.issubdtype(x.dtype, jnp.floating) and _is_per_member(x, ensemble):
            checks.append(jnp.all(valid(x), axis=tuple(range(x.ndim - len(ensemble)))))
    return ft.reduce(jnp.logical_and, checks)


def _is_per_member(x: Array, ensemble: tuple[int, ...]) -> bool:
    shared = x.ndim - len(ensemble)
    return shared >= 0 and x.shape[shared:] == ensemble and not _is_void(x)
