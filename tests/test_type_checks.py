"""A wrong type is refused, however often the function was called before."""

import numpy as np
import pytest
import type_checks
from jaxtyping import TypeCheckError

from jaxquad.identify import coherence_weight, paper_cost
from jaxquad.tuning import upper_bound


RIGHT = np.ones(4, complex)
COHERENCE = np.ones(4)


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("wrong", [np.ones(4), RIGHT[None], "text"])
def test_a_wrong_array_is_refused_after_many_right_ones(wrong, again):
    for _ in range(2 * type_checks.CALLS):
        paper_cost(RIGHT, RIGHT, COHERENCE)
    with pytest.raises(TypeCheckError, match="Complex"):
        paper_cost(wrong, RIGHT, COHERENCE)


def test_a_wrong_number_is_refused_after_many_right_ones():
    for _ in range(2 * type_checks.CALLS):
        assert upper_bound(1, 6) < 1
    with pytest.raises(TypeCheckError, match="int"):
        upper_bound(1, 6.5)  # pyright: ignore[reportArgumentType]


def test_what_is_returned_is_checked_too(monkeypatch):
    for _ in range(2 * type_checks.CALLS):
        coherence_weight(COHERENCE)
    monkeypatch.setattr(np, "exp", lambda x: 1j * x)
    with pytest.raises(TypeCheckError, match="return value"):
        coherence_weight(COHERENCE)
