"""The ensemble engine computes what one plain scan does: in chunks, in blocks, in kernels."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad._compile import engine, in_chunks, most_at_once, scan_members
from jaxquad.control import LADRC
from jaxquad.loops import Loop, per_member
from jaxquad.models import DecoupledAxes, sincos
from jaxquad.simulation import (
    evaluate,
    metrics,
    Pulse,
    run_ensemble,
    Saturation,
    scan_loop,
    scenario,
    simulate,
    Step,
)


MEMBERS, SAMPLES, TAG = 150, 131, "xla_cpu_small_call"
RNG = np.random.default_rng(0)
GAINS, STIFFNESS = jnp.asarray([0.8, 0.3]), jnp.asarray(RNG.uniform(0.5, 2.0, MEMBERS))
START = jnp.asarray(RNG.normal(size=(2, MEMBERS)))
SIGNAL, NOISE = (
    jnp.asarray(RNG.normal(size=SAMPLES)),
    jnp.asarray(RNG.normal(size=(SAMPLES, MEMBERS))),
)
OWN = ((False, True), (False, True))


def swing(state, parts, now):
    """A pendulum under a controller, with a push that all feel and noise of its own."""
    (gains, stiffness), (push, noise) = parts, now
    angle, rate = state
    force = -gains[0] * (angle + 0.01 * noise) - gains[1] * rate + push
    sine, cosine = sincos(angle)
    rate = rate + 0.05 * (force * cosine - stiffness * sine - jnp.tanh(rate))
    return jnp.stack([angle + 0.05 * rate, rate]), (angle, push * angle)


def engine_run(start, gains, chunk=48):
    parts, signals = (gains, STIFFNESS), (SIGNAL, NOISE)
    return run_ensemble(swing, start, parts, signals, of_members=OWN, chunk=chunk)


def plain_run(start, gains):
    step = lambda state, now: swing(state, (gains, STIFFNESS), now)
    return jax.lax.scan(step, start, (SIGNAL, NOISE))


def close(found, expected, rtol=1e-11):
    same = lambda a, b: np.testing.assert_allclose(a, b, rtol=rtol, atol=1e-12)
    jax.tree.map(same, found, expected)


@pytest.mark.parametrize("chunk", [48, 1000])
def test_an_ensemble_in_chunks_is_the_plain_scan(chunk):
    run = jax.jit(lambda *args: engine_run(*args, chunk=chunk))
    close(run(START, GAINS), jax.jit(plain_run)(START, GAINS))
    assert TAG in run.lower(START, GAINS).as_text()


def cost_of(run):
    return lambda start, gains: jnp.sum(run(start, gains)[1][0] ** 2)


@pytest.mark.slow
def test_derivatives_through_chunks_blocks_and_kernels_are_those_of_the_plain_scan():
    for transform in (jax.grad, lambda f, argnums: jax.jacfwd(lambda g: f(START, g))):
        args = (START, GAINS) if transform is jax.grad else (GAINS,)
        fast, slow = (
            jax.jit(transform(cost_of(f), argnums=(0, 1))) for f in (engine_run, plain_run)
        )
        close(fast(*args), slow(*args), rtol=1e-9)


@pytest.mark.parametrize("chunk, kernels", [(1000, 2), (48, 3)])
def test_a_gradient_alone_has_both_passes_in_kernels(chunk, kernels):
    """Nothing asks for the forward pass's own result there, which is where its mark is.

    Few members are computed again by one kernel and reversed by another, compiled side by side.
    """
    last = lambda start, gains: jnp.sum(engine_run(start, gains, chunk=chunk)[0])
    text = jax.jit(jax.grad(last)).lower(START, GAINS).as_text()
    assert text.count(TAG) == kernels


def test_a_kernel_computes_a_value_that_several_need_once():
    def shared(x):
        y = jnp.tanh(jnp.sin(x) * x)
        return y * x, y + x, y - 2 * x

    step = lambda x, _: (sum(shared(x)) / 9, None)
    run = jax.jit(
        lambda x: run_ensemble(lambda x, _, now: step(x, now), x, (), SIGNAL, of_members=False)[0]
    )
    compiled = str(run.lower(START).compile().as_text())
    assert compiled.count(" sine(") + compiled.count(" tanh(") == 2


def test_what_all_members_share_is_no_result_of_chunks():
    count = lambda given: {"each": 2 * given["each"], "all": given["all"] + 1}
    given = {"each": jnp.arange(300.0), "all": jnp.ones(128)}
    with pytest.raises(ValueError, match="members of a chunk belong on its last axis"):
        in_chunks(count, given, {"each": True, "all": False})


def test_wide_arrays_make_smaller_chunks_which_are_kernels():
    """At 128 members a kernel cannot hold 4 x 4 sums of three axes, nor the run be fast."""
    sums, shared = jnp.ones((4, 4, 3, MEMBERS)), jnp.ones((99, 99))
    assert most_at_once((sums, shared), MEMBERS) == 80
    assert [most_at_once(jnp.ones((n, MEMBERS)), MEMBERS) for n in (31, 256, 257)] == [
        128,
        128,
        128,
    ]
    step = lambda x, _, now: (jnp.tanh(x * now), None)
    run = jax.jit(lambda x: run_ensemble(step, x, (), SIGNAL, of_members=False)[0])
    assert TAG in run.lower(sums).as_text()


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 128, 131, 1009])
def test_blocks_of_any_number_of_samples_are_one_scan(count):
    step = lambda x, u: (0.9 * x + jnp.sin(u * x), u * x)
    inputs = jnp.linspace(0.0, 1.0, count)
    in_blocks = lambda x, u: scan_members(lambda x, _, u: step(x, u), x, (), u)
    blocks = jax.jit(in_blocks)
    scan = jax.jit(lambda x, u: jax.lax.scan(step, x, u))
    both = [jax.value_and_grad(lambda x, u, f=f: f(x, u)[0] + jnp.sum(f(x, u)[1] ** 2), (0, 1))
            for f in (blocks, scan)]  # fmt: skip
    found, expected = (f(jnp.asarray(0.7), inputs) for f in both)
    close(found, expected)
    engine(kernel="off")  # which would hide the step
    try:
        text = jax.jit(lambda *args: in_blocks(*args)).lower(0.7, inputs).as_text()
    finally:
        engine(kernel="auto")
    assert text.count("stablehlo.sine") == 1  # no second copy of the step for the last samples


HAPPENS = scenario(
    duration=0.5,
    axes=1,
    reference={0: Step(np.radians(4.0))},
    disturbance={0: Pulse(0.1, width=0.1, at=0.2)},
)
INERTIA = 0.0552 * np.geomspace(0.5, 2.0, MEMBERS)[None]


def rig(inertia):
    return DecoupledAxes([0.0468], inertia, lag=[0.005])


def flown(inertia, gains):
    controller = LADRC(*(gain[None] for gain in gains))
    return evaluate(Loop(rig(inertia), controller, drive=Saturation(20.0)), HAPPENS)


@pytest.mark.slow
def test_members_of_a_large_ensemble_fly_as_in_a_small_one():
    gains = jnp.asarray([10.0, 30.0, 0.8478])
    many = lambda gains: flown(INERTIA, gains).itae[:, -20:]
    few = lambda gains: flown(INERTIA[:, -20:], gains).itae
    mean = lambda f: jax.jit(jax.value_and_grad(lambda gains: jnp.mean(f(gains))))
    close(mean(many)(gains), mean(few)(gains), rtol=1e-9)


@pytest.mark.slow
def test_a_record_of_a_large_ensemble_has_every_member_in_its_place():
    controller, drive = LADRC([10.0], [30.0], [0.8478]), Saturation(20.0)
    record = simulate(Loop(rig(INERTIA), controller, drive=drive), HAPPENS)
    alone = simulate(Loop(rig(INERTIA[:, -1]), controller, drive=drive), HAPPENS)
    close(record.angle[..., -1], alone.angle)
    close(metrics(record).itae, evaluate(Loop(rig(INERTIA), controller, drive=drive), HAPPENS).itae)


class Weighted(eqx.Module):
    """An accumulator with a weight for each member."""

    weight: jax.Array = per_member(rank=1)

    def begin(self, like):
        return jnp.zeros_like(like)

    def update(self, total, now):
        return total + self.weight * now.angle, None


@pytest.mark.slow
def test_an_accumulator_may_have_numbers_of_each_member():
    weight = jnp.arange(float(MEMBERS))[None]
    loop = Loop(rig(INERTIA), LADRC([10.0], [30.0], [0.8478]), drive=Saturation(20.0))
    run = eqx.filter_jit(lambda: scan_loop(loop, HAPPENS, Weighted(weight))[0])
    record = simulate(loop, HAPPENS)
    close(run(), weight * jnp.sum(record.angle, axis=0), rtol=1e-9)


NOISE_ROWS = np.asarray(NOISE)[:, :3]


def queued(waits, count=SAMPLES):
    """A scan whose state is driven by what it sent `waits` samples ago, and the same without it."""

    def move(x, gain, now, oldest):
        x = 0.9 * x + 0.1 * jnp.tanh(oldest) + gain * now[None]
        return x, (jnp.sin(x) * gain, x)

    def by_queue(gain, start):
        queue, signal = jnp.zeros((waits, 2, 3)), jnp.asarray(NOISE_ROWS[:count])
        return scan_members(move, start, gain, signal, members=3, queue=queue)

    def by_list(gain, start):
        sent, states = [jnp.zeros((2, 3))] * waits, []
        for now in NOISE_ROWS[:count]:
            start, (newest, state) = move(start, gain, now, sent[len(states)])
            sent, states = [*sent, newest], [*states, state]
        return start, jnp.stack(states)

    return by_queue, by_list


@pytest.mark.parametrize("waits, count", [(1, 20), (7, 20), (8, 20), (8, 19), (13, 20), (30, 20)])
def test_a_queue_hands_on_what_was_sent_as_many_samples_ago(waits, count):
    by_queue, by_list = queued(waits, count)
    close(jax.jit(by_queue)(0.7, START[:, :3]), by_list(0.7, START[:, :3]))


@pytest.mark.slow
@pytest.mark.parametrize("waits", [3, 40])
def test_all_derivatives_pass_through_a_queue(waits):
    cost = lambda run: lambda gain, start: jnp.sum(run(gain, start)[1] ** 2)
    fast, slow = map(cost, queued(waits, 12))
    gains, start = jnp.asarray([0.5, 0.7]), START[:, :3]
    for transform in (
        lambda f: jax.vmap(jax.grad(f), in_axes=(0, None)),
        lambda f: jax.vmap(jax.hessian(f), in_axes=(0, None)),
        lambda f: jax.vmap(jax.jacfwd(jax.checkpoint(f)), in_axes=(0, None)),
    ):
        found, expected = (jax.jit(transform(f))(gains, start) for f in (fast, slow))
        close(found, expected, rtol=1e-9)


@pytest.mark.slow
def test_no_sample_of_a_reverse_pass_adds_up_a_whole_queue():
    """It would cost the delay's length in every sample, and be too wide for a kernel."""
    late = lambda gain: Loop(rig(INERTIA[:, :2]), LADRC(gain, 30.0, 0.85), delay=0.1)
    cost = lambda gain: jnp.mean(evaluate(late(gain), HAPPENS).itae)
    text = jax.jit(jax.grad(cost)).lower(10.0).as_text()
    assert "tensor<50x1x2xf64>" in text
    assert not [x for x in text.splitlines() if "stablehlo.add" in x and "50x1x2" in x]
