"""The verdict on certified gains of a flown rate loop."""

from types import SimpleNamespace
from typing import Any

import pytest

from jaxquad.autopilot import judge
from jaxquad.workflows import AutopilotSettings


def stage(stable, peak=1.5, rejection=0.5):
    return SimpleNamespace(
        gains=(1.0, 1.0, 0.0), stable=stable, peak=peak, resonance=1.2, crossover=60.0,
        rejection=rejection, noise=1.0, peaks=(), relaxed=None, delay_margin=0.01,
        angle=None,
    )  # fmt: skip


@pytest.mark.parametrize(
    "flown, best, kind",
    [(0.02, 0.5, "cannot tell"), (0.98, 0.5, "not to be flown"), (0.02, 1.0, "proposed")],
)
@pytest.mark.usefixtures("without_type_checks")  # of the stand-ins
def test_a_loop_that_flew_is_stable_on_the_plants_that_are_the_vehicle(flown, best, kind):
    stages: Any = [stage(flown, peak=30.0), stage(best), stage(best)]
    found, words = judge(stages, AutopilotSettings(), 200.0, None, ())
    assert found == kind
    assert ("stable on 2.0 % only" in words) == (kind == "cannot tell")
    assert ("Allow more" in words) == (kind == "not to be flown")
