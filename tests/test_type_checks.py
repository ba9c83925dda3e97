"""A wrong type is refused, however often the function was called before."""

import numpy as np
import pytest
import type_checks
from jaxtyping import TypeCheckError

from jaxquad.spectra._leakage import cross_products, power_of, shows_leakage


RIGHT = np.ones((2, 3, 4), complex)


@pytest.mark.parametrize("again", [False, True])
@pytest.mark.parametrize("wrong", [np.ones((2, 3, 4)), RIGHT[0], "text"])
def test_a_wrong_array_is_refused_after_many_right_ones(wrong, again):
    for _ in range(2 * type_checks.CALLS):
        cross_products(RIGHT)
    with pytest.raises(TypeCheckError, match="Complex"):
        cross_products(wrong)


def test_a_wrong_number_is_refused_after_many_right_ones():
    for _ in range(2 * type_checks.CALLS):
        assert shows_leakage(6, 1)
    with pytest.raises(TypeCheckError, match="int"):
        shows_leakage(6.5, 1)  # pyright: ignore[reportArgumentType]


def test_what_is_returned_is_checked_too(monkeypatch):
    for _ in range(2 * type_checks.CALLS):
        power_of(RIGHT)
    monkeypatch.setattr(np, "real", lambda x: x[0])
    with pytest.raises(TypeCheckError, match="return value"):
        power_of(RIGHT[:, 0])
