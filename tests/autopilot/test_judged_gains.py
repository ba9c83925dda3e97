"""The verdict on certified gains of a flown rate loop."""

import pytest

from jaxquad.autopilot._over_throttle import ThrottleVerdict
from jaxquad.autopilot._rate_design import _judge
from jaxquad.autopilot._stages import Stage
from jaxquad.workflows import AutopilotSettings


def stage(stable, peak=1.5, rejection=0.5):
    return Stage((1.0, 1.0, 0.0), stable, peak, 1.2, 60.0, rejection, 1.0)


@pytest.mark.parametrize(
    "flown, best, kind",
    [(0.02, 0.5, "cannot tell"), (0.98, 0.5, "not to be flown"), (0.02, 1.0, "proposed")],
)
def test_a_loop_that_flew_is_stable_on_the_plants_that_are_the_vehicle(flown, best, kind):
    stages = [stage(flown, peak=30.0), stage(best), stage(best)]
    found, words = _judge(stages, AutopilotSettings(), 200.0, None, ThrottleVerdict(""))
    assert found == kind
    assert ("stable on 2.0 % only" in words) == (kind == "cannot tell")
    assert ("Allow more" in words) == (kind == "not to be flown")
