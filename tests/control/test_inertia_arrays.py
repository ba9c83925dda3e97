"""Probes, precision, gradients, axes and ensembles of the inertia estimators."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from inertia_runs import exact, GAIN, gusty, listen, lock_in, recursive, windowed
from rig_records import DT, INERTIA, RigRecord

from jaxquad.control import ProbeTones, RecursiveInertia


def run_probe(estimator, record):
    def hear(state, now):
        state = estimator.update(state, *now)
        return state, estimator.probe(state)

    record = jax.tree.map(lambda x: jnp.asarray(x[:, :, :1]), record)
    start = estimator.init(record.measurement[0])
    return np.asarray(eqx.filter_jit(lambda: jax.lax.scan(hear, start, record)[1])())[:, 0, 0]


def test_the_probe_is_its_tones_until_the_inertia_is_known():
    probe = run_probe(lock_in(tones=ProbeTones((2.0, 4.0), 0.2, above=0.011, below=0.01)), exact())
    time = DT * np.arange(1, len(probe) + 1)
    tones = 0.2 * (np.sin(4 * np.pi * time) + np.sin(8 * np.pi * time))
    on = np.abs(probe) > 0
    known = round(5.0 / DT)
    np.testing.assert_allclose(probe[: known - 1], tones[: known - 1], atol=1e-9)
    assert not np.any(on[known : known + 490])  # then the estimate ages by 1 % a root second ...
    assert np.any(on[known + 510 :])  # ... and is in doubt again


def test_an_estimator_can_be_told_to_excite():
    estimator = recursive(tones=ProbeTones())
    zero = jnp.zeros((1, 1))

    @eqx.filter_jit
    def told(record):
        hear = lambda state, now: (estimator.update(state, *now), None)
        state = jax.lax.scan(hear, estimator.init(zero), record)[0]
        return [state, estimator.update(estimator.excite(state), zero, zero)]

    states = told(jax.tree.map(lambda x: jnp.asarray(x[:, :, :1]), exact()))
    assert [float(state.probe.exciting[0, 0]) for state in states] == [0.0, 1.0]
    assert [float(estimator.estimate(state).trusted[0, 0]) for state in states] == [1.0, 0.0]


ALL = [windowed(window=1.0), recursive(), lock_in()]


SOME = [pytest.param(ALL[0], marks=pytest.mark.slow), *ALL[1:]]


@pytest.mark.slow
@pytest.mark.parametrize("estimator", SOME, ids=lambda e: type(e).__name__)
def test_single_precision_agrees(estimator):
    single = RigRecord(*(x.astype(np.float32) for x in gusty()))
    double = RigRecord(*(x.astype(float) for x in single))
    coarse, fine = listen(estimator, single), listen(estimator, double)
    assert {x.dtype for x in jax.tree.leaves(coarse)} == {jnp.dtype("float32")}
    np.testing.assert_allclose(coarse.inertia[-1], fine.inertia[-1], rtol=3e-3)
    np.testing.assert_allclose(coarse.deviation[-1], fine.deviation[-1], rtol=0.05)


@pytest.mark.parametrize("estimator", ALL[1:], ids=lambda e: type(e).__name__)
def test_axes_without_an_ensemble_are_heard_as_members_are(estimator):
    """Each axis by its own torque gain: here two gains for the record of one rig."""
    axes = eqx.tree_at(lambda e: e.torque_gain, estimator, jnp.array([GAIN, 2 * GAIN, GAIN]))
    found = listen(axes, RigRecord(*(x[:, 0, [0, 0, 1]] for x in gusty())))
    members = listen(estimator, gusty())
    last = np.asarray(found.inertia[-1])
    np.testing.assert_allclose(last[[0, 2]], members.inertia[-1, 0, :2], rtol=1e-9)
    np.testing.assert_allclose(last[1], 2 * last[0], rtol=1e-9)


@pytest.mark.parametrize(
    "estimator",
    [pytest.param(ALL[0], marks=pytest.mark.slow), ALL[1],
     pytest.param(ALL[2], marks=pytest.mark.slow)],
    ids=lambda e: type(e).__name__,
)  # fmt: skip
def test_the_estimate_is_proportional_to_the_torque_gain_and_its_gradient_says_so(estimator):
    """dJ/dKT = J/KT, and dJ/ds = -J for an angle scaled by s: exact, and finite at the start."""
    record = jax.tree.map(lambda x: jnp.asarray(x[:3000, :, :1]), exact())

    def last(gain, scale):
        scaled = eqx.tree_at(lambda e: e.torque_gain, estimator, gain)
        stretched = RigRecord(record.command, scale * record.measurement)
        return listen(scaled, stretched).inertia[-1, 0, 0]

    value = eqx.filter_jit(jax.value_and_grad(last, argnums=(0, 1)))
    inertia, (by_gain, by_scale) = value(jnp.asarray(GAIN), jnp.asarray(1.0))
    assert by_gain == pytest.approx(float(inertia) / GAIN, rel=1e-6)
    assert by_scale == pytest.approx(-float(inertia), rel=1e-6)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: windowed(order=4), "order is 4"),
        (lambda: windowed(window=0.05), "50 or more"),
        (lambda: windowed(nuisance=("drag",)), "'offset', 'rate' and 'angle'"),
        (lambda: windowed(bandwidth=0.0), "bandwidth is 0.0"),
        (lambda: recursive(memory=0.1), "0.2 s or more"),
        (lambda: RecursiveInertia([GAIN, -1.0], INERTIA), "torque_gain is"),
        (lambda: RecursiveInertia(GAIN, [[0.0]]), "nominal is"),
        (lambda: lock_in(nuisance=("angle",)), "two frequencies"),
        (lambda: lock_in(tones=ProbeTones((2.05,))), "has 10.25 periods"),
        (lambda: lock_in(tones=ProbeTones((0.6,))), "from 5 to 250"),
        (lambda: lock_in(tones=ProbeTones((2.0, 2.4))), "closer than 0.8 Hz"),
        (lambda: lock_in(window=5.001), "whole number of samples"),
        (lambda: ProbeTones(()), "at least one"),
        (lambda: ProbeTones(above=0.01, below=0.02), "below <= above"),
        (lambda: ProbeTones(amplitude=-1.0), "amplitude is -1.0"),
    ],
)  # fmt: skip
def test_what_cannot_work_is_refused(make, text):
    with pytest.raises(ValueError, match=text):
        make()
