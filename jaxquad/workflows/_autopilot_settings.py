"""Settings of the workflows on the log of an autopilot: tuning its gains, comparing two flights."""

import dataclasses
from collections.abc import Iterator
from typing import Annotated, Literal

from . import _options as kinds
from ._options import Pair, Settings


@dataclasses.dataclass(frozen=True, kw_only=True)
class AutopilotSettings(Settings):
    """How the gains of the autopilot that flew a log are tuned.

    The keyword arguments are the keys of the TOML file; `jaxquad autopilot --help` lists them as
    options. Input, output and reference are those that the log proposes.

    **The record:**

    - `axis`: the axis to tune; all by default, with one file of parameters
    - `chirp`: the number of the one to use of the chirps that a log's proposal lists; by default
      the longest, with all others on its axis at its place
    - `flight`: the number of the flight in a file with several; by default the longest with a
      chirp, else the longest with sticks that move
    - `start`: first time to use, in the file's time
    - `stop`: last time to use
    - `band`: fit between these frequencies, in Hz; by default what the record resolves
    - `throttle`: of 1, at which Betaflight's dynamic filters and TPA are taken; by default the
      log's median, 0.3 where it does not hold the throttle

    **The law:**

    - `law`: the law to tune: adrc is that of Betaflight's pull request 15400; by default what flew
    - `hover`: adrc_hover_throttle, of 1; by default that of the ADRC that flew, else the lowest
      level of throttle that was flown

    **What is kept:**

    - `sensitivity`: upper limit of the peak of |S|; 1.8 by default
    - `resonance`: upper limit of the peak of the response from set-point to rate; 1.4 by default
    - `noise`: the most that the command's noise may grow, as a factor; 1.5 by default
    - `change`: factor within which each gain and cutoff, or wc, wo and b0, stays of what flew; 3 by
      default
    - `keep_filters`: leave the filters as they flew, and tune gains alone

    **The plants:**

    - `members`: number of plants to tune on; 32 by default
    - `fresh`: number of new plants to certify on; 256 by default
    - `seed`: of the random draws; 0 by default

    **Raises:** `SettingsError` (a ValueError) for values that cannot be.
    """

    axis: Annotated[str, kinds.ONE_OR_ALL_AXES] = "all"
    chirp: Annotated[int | None, kinds.SIZE] = None
    flight: Annotated[int | None, kinds.SIZE] = None
    start: Annotated[float | None, kinds.TIME] = None
    stop: Annotated[float | None, kinds.TIME] = None
    band: Annotated[Pair | None, kinds.BAND] = None
    throttle: Annotated[float | None, kinds.POSITIVE] = None
    law: Annotated[Literal["pid", "adrc"] | None, kinds.LAW] = None
    hover: Annotated[float | None, kinds.POSITIVE] = None
    sensitivity: Annotated[float, kinds.POSITIVE] = 1.8
    resonance: Annotated[float, kinds.POSITIVE] = 1.4
    noise: Annotated[float, kinds.POSITIVE] = 1.5
    change: Annotated[float, kinds.POSITIVE] = 3.0
    keep_filters: Annotated[bool, kinds.SWITCH] = False
    members: Annotated[int, kinds.SIZE] = 32
    fresh: Annotated[int, kinds.SIZE] = 256
    seed: Annotated[int, kinds.COUNT] = 0

    def clashes(self) -> Iterator[str]:
        if self.throttle is not None and self.throttle > 1:
            yield f"`throttle` is {self.throttle:g}: give a share, above 0 to 1"
        if self.hover is not None and not 0.05 <= self.hover <= 1:
            yield f"`hover` is {self.hover:g}: give a share, from 0.05 to 1"
        if self.hover is not None and self.law == "pid":
            yield "`hover` is of the ADRC: leave it out, or give `law` adrc"
        if self.sensitivity <= 1:
            yield f"`sensitivity` is {self.sensitivity:g}: no loop has a peak of |S| of 1 or below"
        if self.resonance <= 1:
            yield f"`resonance` is {self.resonance:g}: a loop with an integral has a peak above 1"
        if self.change <= 1:
            yield f"`change` is {self.change:g}: give a factor above 1"


def limits_of(sharpness: float, heat: float) -> dict[str, float]:
    """Limits for `AutopilotProposal.retuned` by two shares of 0 to 1; at 0.5 those of the defaults.

    **Arguments:**

    - `sharpness`: 0 is calm, with Ms up to 1.4 and a peak of the response up to 1.15; 1 is sharp,
      up to 2.2 and 1.65.
    - `heat`: 0 allows three quarters of the command's noise that flew, 1 three times as much, which
      warms the motors.
    """
    return {
        "sensitivity": 1.4 + 0.8 * sharpness, "resonance": 1.15 + 0.5 * sharpness,
        "noise": 0.75 * 4**heat,
    }  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareSettings(Settings):
    """Which parts of two logs are compared.

    The keyword arguments are the keys of the TOML file; `jaxquad compare --help` lists them as
    options. Input, output and reference are those that each log proposes.

    **The record:**

    - `axis`: the axis to compare; all by default
    - `flight_before`: the number of the flight in a first file with several; by default the longest
      with a chirp, else the longest with sticks that move
    - `flight_after`: likewise of the second file, which may be the same
    - `part_before`: first and last time to use of the first log, in the file's time
    - `part_after`: likewise of the second log
    - `band`: fit between these frequencies, in Hz; by default what each record resolves

    **Raises:** `SettingsError` (a ValueError) for values that cannot be.
    """

    axis: Annotated[str, kinds.ONE_OR_ALL_AXES] = "all"
    flight_before: Annotated[int | None, kinds.SIZE] = None
    flight_after: Annotated[int | None, kinds.SIZE] = None
    part_before: Annotated[Pair | None, kinds.PART] = None
    part_after: Annotated[Pair | None, kinds.PART] = None
    band: Annotated[Pair | None, kinds.BAND] = None
