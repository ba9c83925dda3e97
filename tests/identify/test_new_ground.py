"""Plants drawn at random whose cost rises ever less on the way from the estimate to the truth."""

import sys
from pathlib import Path

import pytest


sys.path.append(str(Path(__file__).parents[1] / "studies"))
from new_ground_plants import draw, judge  # noqa: E402  # pyright: ignore


pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    "seed, plant", [(279338, 969), (279338, 720), (90217, 310), (90217, 82), (742955, 129)]
)
def test_no_printed_number_is_far_off_along_a_flat_valley(seed, plant):
    row = judge(draw(seed, plant))
    assert row["undetermined"]
    assert all(abs(claimed_errors) < 4 for _, claimed_errors, _ in row["numbers"])


def test_a_model_too_large_for_the_record_says_so():
    """The delay alone counts as determined, 5 claimed errors off, beside a pole at infinity."""
    row = judge(draw(90217, 737))
    assert len(row["undetermined"]) == 7
    assert any(remark.startswith("too many parameters") for remark in row["remarks"])
