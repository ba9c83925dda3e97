"""The linear nominal loop of a design, for many gains at once, and the two numbers matched on."""

from typing import Any

import numpy as np

from jaxquad.loops import LoopAnalysis

from .designs import Belief, controller, Design
from .linear import analysed
from .rigs import lateness, linear_axis, rig


WIDTH = 32  # members of every ensemble, so that all cases share what is compiled
HOPELESS = 1e6  # Ms and activity of loops that are unstable


def nominal_loops(
    design: Design, level: dict[str, Any], dt: float, gains: dict[str, Any] | None = None
) -> LoopAnalysis:
    """The nominal linear loop, `WIDTH` times: with other `gains` by member if they are given."""
    belief = nominal_belief(level)
    wanted = design._replace(gains=design.gains | (gains or {}))
    plain = wanted._replace(data=wanted.data | {"law": "pid" if design.law == "pid" else "ladrc"})
    axis = linear_axis(level, WIDTH, {})
    return analysed(axis, controller(plain, belief, dt=dt), lateness(level, WIDTH))


def nominal_belief(level: dict[str, Any]) -> Belief:
    """That of the first axis, in `WIDTH` copies."""
    at = rig(level, WIDTH)
    gain, inertia, limit = (x[:1] for x in (at.torque_gain, at.inertia, at.limit))
    return Belief(gain, inertia, gain / inertia, limit, at.volts[:1])


def loops_at(
    design: Design, level: dict[str, Any], dt: float, gains: dict[str, np.ndarray]
) -> tuple[LoopAnalysis, np.ndarray]:
    """Loops with up to `WIDTH` values of these `gains`; their ln Ms and ln activity [2, n].

    The loops are filled up to `WIDTH`. Without gains they are the design's own.
    """
    count = max((len(row) for row in gains.values()), default=1)
    wide = {name: np.append(row, np.full(WIDTH - count, row[0])) for name, row in gains.items()}
    loops = nominal_loops(design, level, dt, wide)
    b = float(nominal_belief(level).gain[0, 0])
    values = np.array([loops.sensitivity_peak, b * np.asarray(loops.noise_gain)])
    return loops, np.log(np.where(np.isfinite(values), values, HOPELESS))[:, :count]
