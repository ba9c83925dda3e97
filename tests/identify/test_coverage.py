"""95 % intervals hold the truth as often as they say: 100 draws of the 1000-draw study."""

import sys
from pathlib import Path

import numpy as np
import pytest


sys.path.append(str(Path(__file__).parents[1] / "benchmarks"))
from coverage_study import draw, omega_of, studies  # noqa: E402  # pyright: ignore


pytestmark = pytest.mark.slow
NAMES = ("open loop", "closed loop", "two inputs")


@pytest.mark.parametrize("name", NAMES)
def test_intervals_cover_errors_are_the_scatter_and_bias_is_small(name):
    """By noise alone as they are, without the degrees of freedom of the noise estimate."""
    study = studies()[name]
    values, errors, halves = draw(study, omega_of(name, frequencies=25), 100)
    covered = np.abs(values - study.truth) < 1.96 * errors
    # 100 draws know a coverage of 95 % to 2.2 %; all parameters together to about 1 %.
    assert np.all(np.mean(covered, axis=0) > 0.88)
    assert 0.92 < np.mean(covered) < 0.98
    assert 0.93 < np.mean(np.abs(values - study.truth) < halves) < 0.99
    ratio = np.sqrt(np.mean(errors**2, axis=0)) / np.std(values, axis=0)
    # 100 draws know a scatter to 7 %.
    assert 0.8 < ratio.min() and ratio.max() < 1.25
    assert np.mean(ratio) == pytest.approx(1, abs=0.1)
    bias = values.mean(axis=0) - study.truth
    assert np.all(np.abs(bias) < 0.4 * errors.mean(axis=0))
