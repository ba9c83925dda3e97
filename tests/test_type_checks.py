"""A wrong type is refused in each test, however often earlier tests have called the function."""

import numpy as np
import pytest
import type_checks
from jaxtyping import TypeCheckError

from jaxquad.spectra._leakage import power_of


@pytest.mark.parametrize("again", [False, True])
def test_a_function_of_complex_numbers_refuses_real_ones(again):
    with pytest.raises(TypeCheckError, match="Complex"):
        power_of(np.ones(3))
    for _ in range(type_checks.CALLS):
        power_of(np.ones(3, complex))
