"""What tasks tell the page: plain values, which the page's process reads without JAX."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float


Files = Mapping[str, bytes]  # by their names


class Change(NamedTuple):
    """A parameter of the firmware, as it flew and as it is proposed."""

    name: str
    old: float
    new: float
    unit: str


class Step(NamedTuple):
    """The rate after a step of the set-point, with its band, as `jaxquad.plot.StepBand`."""

    time: Float[np.ndarray, " samples"]  # s
    middle: Float[np.ndarray, " samples"]
    low: Float[np.ndarray, " samples"]
    high: Float[np.ndarray, " samples"]
    overshoot: tuple[float, float]
    half_way: float  # s
    settled: float  # s


class AxisResult(NamedTuple):
    """What the page shows of an axis."""

    axis: str
    kind: str  # of the verdict; "not this log" where the axis could not be read
    sentence: str  # the verdict in words
    in_short: str = ""  # what a pilot feels of it
    changes: tuple[Change, ...] = ()
    reasons: tuple[str, ...] = ()  # for the changes, each once
    steps: Mapping[str, Step] = {}  # of the set-point, by "flown" and "proposed"
    measured: Step | None = None  # that of the log itself

    def value(self, change: Change) -> float | None:
        """What the axis' proposal sets a parameter to; None where nothing may be flown."""
        new = {x.name: x.new for x in self.changes}
        return new.get(change.name, change.old) if self.changes or self.kind == "kept" else None

    @property
    def all_steps(self) -> Mapping[str, Step]:
        """With what was "measured"."""
        return self.steps if self.measured is None else {"measured": self.measured, **self.steps}


class Tuned(NamedTuple):
    """What the page shows of all axes."""

    axes: tuple[AxisResult, ...]
    movable: bool  # whether sliders can tune it again


class Light(NamedTuple):
    """A verdict with its sentence."""

    level: str  # good, warn or bad
    word: str
    sentence: str = ""


class Outcome(NamedTuple):
    """A result with files, one of which is its page."""

    lights: tuple[Light, ...]
    text: str
    page: str  # its name among the files
    files: Files
