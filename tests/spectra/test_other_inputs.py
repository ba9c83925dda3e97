"""Another signal that moves the output beside the input: looked for, and taken out."""

import numpy as np
import pytest

from jaxquad.records import Record
from jaxquad.spectra import (
    compare_with_input,
    frequency_response,
    JointInputOutput,
    LocalPolynomial,
    Welch,
)


RATE, SAMPLES = 50.0, 4000
OMEGA, TIME = np.geomspace(0.6, 60, 30), np.arange(SAMPLES) / RATE
PLAIN = LocalPolynomial(global_order=0)


def draw(seed, *, coupling, alike=0.6, feedback=0.0):
    """Reference, input, other input, output."""
    random = np.random.default_rng(seed)
    r, other, noise = random.standard_normal((3, SAMPLES))
    other = alike * r + np.sqrt(1 - alike**2) * other
    noise *= 0.1
    u, y = np.zeros((2, SAMPLES))
    state = 0.0
    for k in range(SAMPLES):  # y = (.3 + .1 / z) / (1 - .7 / z) u, u by the sample before
        before = u[k - 1] + coupling * other[k - 1] if k else 0.0
        state = 0.7 * state + before
        y[k] = 0.3 * state + noise[k]
        u[k] = r[k] - feedback * y[k]
    return r, u, other, y


def exact():
    z = np.exp(1j * OMEGA / RATE)
    return 0.3 / z / (1 - 0.7 / z)


@pytest.mark.parametrize("feedback", [0.0, 0.5])
def test_what_moves_with_the_input_is_told_from_it_unless_both_are_one(feedback):
    def compare(alike, coupling, seed):
        r, u, other, y = draw(seed, coupling=coupling, alike=alike, feedback=feedback)
        record = Record(TIME, u, y, r if feedback else None)
        estimator = JointInputOutput(PLAIN) if feedback else PLAIN
        frf = frequency_response(record, OMEGA, estimator=estimator)
        compared = compare_with_input([record], frf, [other])
        assert compared is not None
        return compared

    idle = [compare(0.6, 0.0, seed) for seed in range(6)]
    assert min(one.chance for one in idle) > 1e-3
    acting = compare(0.6, 0.05, 0)
    assert acting.chance < 1e-6
    assert acting.alone == pytest.approx(1 - 0.6**2, abs=0.1)
    assert compare(1.0, 0.05, 0).alone < 5e-3


def test_a_joint_estimate_takes_other_signals_out():
    errors = []
    for seed in range(4):
        r, u, other, y = draw(seed, coupling=0.2, feedback=0.5)
        record = Record(TIME, u, y, np.stack([r, other], axis=1))
        frf = frequency_response(record, OMEGA, estimator=JointInputOutput(PLAIN, 1))
        error = np.asarray(frf.response)[:, 0, 0] / exact() - 1
        errors.append(error / (np.sqrt(2) * np.asarray(frf.random_error)[:, 0, 0]))
        alone = frequency_response(Record(TIME, u, y, r), OMEGA)
        assert np.median(np.asarray(alone.response)[:, 0, 0] / exact() - 1).real > 0.08
    # Errors of the stated size, and none that all frequencies share.
    assert np.sqrt(np.mean(np.abs(errors) ** 2)) == pytest.approx(1, abs=0.25)
    assert abs(np.mean(errors)) < 0.3


def test_others_need_local_polynomials_and_a_reference_for_each_input():
    with pytest.raises(ValueError, match="needs local polynomials"):
        JointInputOutput(Welch(4.0), 1)
    r, u, _, y = draw(0, coupling=0.0, feedback=0.5)
    with pytest.raises(ValueError, match=r"for 1 inputs \['u'\] and 1 others"):
        frequency_response(Record(TIME, u, y, r), OMEGA, estimator=JointInputOutput(PLAIN, 1))


def test_a_pair_is_the_response_of_one_output_to_one_input():
    _, u, other, y = draw(0, coupling=0.1)
    both = Record(TIME, np.stack([u, other], axis=1), y, input_names=("u", "w"))
    frf = frequency_response(both, OMEGA, estimator=Welch(16.0))
    pair = frf.pair(0, 1)
    np.testing.assert_array_equal(pair.response[:, 0, 0], frf.response[:, 0, 1])
    np.testing.assert_allclose(pair.relative_covariance(), frf.relative_covariance(0, 1))
    assert pair.input_names == ("w",) and pair.remarks == frf.remarks
