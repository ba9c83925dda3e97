"""Leaving out what the responses do not need."""

import equinox as eqx
import jax
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq
from jaxquad.models import imaginary


pytestmark = pytest.mark.slow


class Roll(eqx.Module):
    """Roll mode, perhaps with a spring and a lag: L / (s + p + k / s) / (T s + 1)."""

    gain: jax.Array
    damping: jax.Array
    spring: jax.Array
    lag: jax.Array

    def frequency_response(self, omega):
        s = imaginary(omega)
        leaves = (self.gain, self.damping, self.spring, self.lag)
        gain, damping, spring, lag = (leaf.astype(s.dtype) for leaf in leaves)
        return (gain * s / (s**2 + damping * s + spring) / (lag * s + 1))[:, None, None]


def roll(*values):
    return Roll(*(jax.numpy.asarray(value) for value in values))


START = roll(5.0, 2.0, 0.3, 0.02)
EQ_14 = jq.identify.CoherenceWeighted()  # a rise is of its average cost
FREE = ("gain", "damping", jq.identify.Real("spring", 1.0), jq.identify.Real("lag", 0.05))
ML = jq.identify.MaximumLikelihood()


def measured(spring, lag, seed=1):
    return response_of(roll(6.0, 3.0, spring, lag), error=0.01, seed=seed)


@pytest.fixture(scope="module")
def reduced():
    return jq.identify.reduce_structure(START, measured(0.0, 0.0), free=FREE, cost=ML)


def test_what_is_not_there_is_left_out(reduced):
    assert set(reduced.dropped) == {"spring", "lag"}
    assert reduced.fit.names == ("gain", "damping")
    assert reduced.fit.model.spring == 0 and reduced.fit.model.lag == 0


def test_what_is_left_holds_the_truth(reduced):
    error = np.abs(reduced.fit.values - [6.0, 3.0]) / reduced.fit.standard_errors
    assert np.all(error < 3)


def test_the_most_insensitive_goes_first(reduced):
    first = int(np.argmax(reduced.first.insensitivity))
    assert reduced.steps[0].parameter == reduced.first.names[first]
    assert reduced.steps[0].reason.startswith("I ")


def test_the_protocol_is_printed(reduced):
    text = str(reduced)
    assert text.startswith("start: 4 parameters, J_ave")
    assert text.count("dropped") == 2
    assert "2 parameters left:" in text


def test_what_is_there_is_kept_and_the_protocol_says_so():
    # A Cramer-Rao limit that every parameter exceeds: all are tried.
    found = jq.identify.reduce_structure(
        START, measured(2.0, 0.05), free=FREE, cost=ML, insensitivity=0.0, cramer_rao=0.0
    )
    assert found.dropped == ()
    assert len(found.steps) == 4
    assert all(step.change > 0 for step in found.steps)
    gone = {step.parameter: step.verdict for step in found.steps}
    assert gone["gain"] == "kept: no fit without it"
    assert gone["lag"] == "kept: needed"


def test_a_rise_that_is_allowed_drops_what_the_criterion_would_keep():
    frf = measured(0.0, 0.003, seed=2)
    strict = jq.identify.reduce_structure(
        START, frf, free=FREE, null={"spring": 0.0}, insensitivity=1.0, cost=EQ_14
    )
    loose = jq.identify.reduce_structure(
        START, frf, free=FREE, insensitivity=1.0, rise=5.0, cost=EQ_14
    )
    assert "lag" not in strict.dropped
    assert "lag" in loose.dropped
    assert loose.fit.average_cost - loose.first.average_cost < 10.0


def test_a_null_of_an_unknown_parameter_is_refused():
    with pytest.raises(ValueError, match=r"null names mass, which is not free; free are: gain"):
        jq.identify.reduce_structure(START, measured(0.0, 0.0), free=FREE, null={"mass": 1.0})
