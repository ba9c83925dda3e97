"""Values that cannot be are refused by name, with the value and the remedy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad._core import (
    require_all_nonnegative,
    require_all_positive,
    require_band,
    require_finite,
    require_nonnegative,
    require_positive,
    require_vector,
    whole_samples,
)


WRONG = {
    "wc is 0, but it must be above 0 and finite: give rad/s.": lambda: require_positive(
        "wc", 0, "give rad/s"
    ),
    "dt is -1.0, but it must be above 0 and finite.": lambda: require_all_positive(a=1, dt=-1.0),
    "gain is [ 1. nan], but it must be finite": lambda: require_finite(
        "gain", jnp.asarray([1.0, np.nan])
    ),
    "lag is -0.1, but it must be 0 or above": lambda: require_nonnegative("lag", -0.1, "0 is none"),
    "trim is inf, but it must be 0 or above and finite.": lambda: require_all_nonnegative(
        trim=np.inf
    ),
    "J has shape (2,), but it must be (3,)": lambda: require_vector("J", jnp.ones(2), 3),
    "omega_max 1 rad/s is not above omega_min 2 rad/s": lambda: require_band(2.0, 1.0, 100.0),
    "omega_max 400 rad/s is not below 314.159 rad/s": lambda: require_band(2.0, 400.0, 100.0),
    "not a whole number of at least 1: the nearest are 0.02 s and 0.03 s": lambda: whole_samples(
        "width", 0.025, 100.0
    ),
}


@pytest.mark.parametrize("message", WRONG)
def test_a_value_that_cannot_be_is_refused_in_words(message):
    with pytest.raises(ValueError) as refusal:
        WRONG[message]()
    assert str(refusal.value).startswith(message) or message in str(refusal.value)


def test_values_that_may_be_pass():
    require_all_positive(a=1, b=np.ones(3))
    require_all_nonnegative(a=0, b=jnp.zeros(2))
    require_band(1.0, 300.0, 100.0)
    require_vector("J", jnp.ones((3, 5)), 3)
    assert whole_samples("width", 0.03, 100.0) == 3


def test_a_traced_value_is_not_known_and_passes():
    def run(x):
        require_positive("x", x, "")
        return x

    assert jax.jit(run)(-1.0) == -1.0
