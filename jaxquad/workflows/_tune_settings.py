"""Settings of the workflows that find gains: a tune, and the gains of an autopilot."""

import dataclasses
from typing import Literal

from . import _kinds as kinds
from ._kinds import Pair, SettingsError
from ._settings import option_field, Settings, THE_RECORD


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneSettings(Settings):
    """How a controller is tuned on an identified axis: what the record does not tell.

    The keyword arguments are the keys of the TOML file; `jaxquad tune --help` lists them as
    options.

    **Raises:** `SettingsError` (a ValueError) for values that cannot be.
    """

    inertia: float = option_field(
        kinds.INERTIA,
        dataclasses.MISSING,
        "nominal inertia of the axis, in kg m^2; required",
        group="the vehicle",
    )
    limit: float = option_field(
        kinds.POSITIVE,
        dataclasses.MISSING,
        "largest command, to either side, in its unit; required",
        group="the vehicle",
    )
    spread: Pair = option_field(
        kinds.BAND,
        (0.5, 3.0),
        "range of the true inertia, as factors of the nominal one; 0.5 3 by default",
        group="the vehicle",
    )
    inertia_error: float = option_field(
        kinds.NOT_NEGATIVE,
        0.1,
        "relative standard error of the inertia that the controller's gains "
        "are scheduled with; 0.1 by default",
        group="the vehicle",
    )
    noise: float = option_field(
        kinds.DEVIATION,
        0.02,
        "standard deviation of the measured angle; 0.02 by default",
        group="the vehicle",
    )
    step: float = option_field(
        kinds.DEGREES, 4.0, "step of the reference; 4 by default", group="the simulated flight"
    )
    disturbance: float | None = option_field(
        kinds.TORQUE,
        None,
        "torque pulse; by default a tenth of the torque at the limit",
        group="the simulated flight",
    )
    duration: float = option_field(
        kinds.DURATION, 4.0, "of one flight; 4 by default", group="the simulated flight"
    )
    dt: float | None = option_field(
        kinds.DURATION,
        None,
        "sampling interval of the controller; by default that of the record",
        group="the controller",
    )
    sensitivity: float = option_field(
        kinds.POSITIVE,
        3.6,
        "upper limit of the peak of |S|; 3.6 by default",
        group="the controller",
    )
    wo: float | None = option_field(
        kinds.POSITIVE,
        None,
        "hold the observer's bandwidth at this value in rad/s, for instance where the "
        "identified band ends; by default it is tuned",
        group="the controller",
    )
    name: str = option_field(
        kinds.TEXT,
        "attitude",
        "prefix of the functions in the C header; attitude by default",
        group="the controller",
    )
    members: int = option_field(
        kinds.SIZE, 64, "number of plants to tune on; 64 by default", group="the plants"
    )
    fresh: int = option_field(
        kinds.SIZE,
        256,
        "number of new plants to certify on; 256 by default",
        group="the plants",
    )
    seed: int = option_field(
        kinds.COUNT, 0, "of the random draws; 0 by default", group="the plants"
    )


_PLANTS, _KEPT, _LAW = "the plants", "what is kept", "the law"


@dataclasses.dataclass(frozen=True, kw_only=True)
class AutopilotSettings(Settings):
    """How the gains of the autopilot that flew a log are tuned.

    The keyword arguments are the keys of the TOML file; `jaxquad autopilot --help` lists them as
    options. Input, output and reference are those that the log proposes.

    **Raises:** `SettingsError` (a ValueError) for values that cannot be.
    """

    axis: str = option_field(
        kinds.ONE_OR_ALL_AXES,
        "all",
        "the axis to tune; all by default, with one file of parameters",
        group=THE_RECORD,
    )
    chirp: int | None = option_field(
        kinds.SIZE,
        None,
        "the number of the one to use of the chirps that a log's proposal lists; by default the "
        "longest, with all others on its axis at its place",
        group=THE_RECORD,
    )
    flight: int | None = option_field(
        kinds.SIZE,
        None,
        "the number of the flight in a file with several; by default the longest with a chirp, "
        "else the longest with sticks that move",
        group=THE_RECORD,
    )
    start: float | None = option_field(
        kinds.TIME, None, "first time to use, in the file's time", group=THE_RECORD
    )
    stop: float | None = option_field(kinds.TIME, None, "last time to use", group=THE_RECORD)
    band: Pair | None = option_field(
        kinds.BAND,
        None,
        "fit between these frequencies, in Hz; by default what the record resolves",
        group=THE_RECORD,
    )
    throttle: float | None = option_field(
        kinds.POSITIVE,
        None,
        "of 1, at which Betaflight's dynamic filters and TPA are taken; by default the log's "
        "median, 0.3 where it does not hold the throttle",
        group=THE_RECORD,
    )
    law: Literal["pid", "adrc"] | None = option_field(
        kinds.LAW,
        None,
        "the law to tune: adrc is that of Betaflight's pull request 15400; by default what flew",
        group=_LAW,
    )
    hover: float | None = option_field(
        kinds.POSITIVE,
        None,
        "adrc_hover_throttle, of 1; by default that of the ADRC that flew, else the lowest level "
        "of throttle that was flown",
        group=_LAW,
    )
    sensitivity: float = option_field(
        kinds.POSITIVE, 1.8, "upper limit of the peak of |S|; 1.8 by default", group=_KEPT
    )
    resonance: float = option_field(
        kinds.POSITIVE,
        1.4,
        "upper limit of the peak of the response from set-point to rate; 1.4 by default",
        group=_KEPT,
    )
    noise: float = option_field(
        kinds.POSITIVE,
        1.5,
        "the most that the command's noise may grow, as a factor; 1.5 by default",
        group=_KEPT,
    )
    change: float = option_field(
        kinds.POSITIVE,
        3.0,
        "factor within which each gain and cutoff, or wc, wo and b0, stays of what flew; 3 by "
        "default",
        group=_KEPT,
    )
    keep_filters: bool = option_field(
        kinds.SWITCH, False, "leave the filters as they flew, and tune gains alone", group=_KEPT
    )
    members: int = option_field(
        kinds.SIZE, 32, "number of plants to tune on; 32 by default", group=_PLANTS
    )
    fresh: int = option_field(
        kinds.SIZE, 256, "number of new plants to certify on; 256 by default", group=_PLANTS
    )
    seed: int = option_field(kinds.COUNT, 0, "of the random draws; 0 by default", group=_PLANTS)

    def _check_together(self) -> None:
        if self.throttle is not None and self.throttle > 1:
            raise SettingsError(f"`throttle` is {self.throttle:g}: give a share, above 0 to 1")
        if self.hover is not None and not 0.05 <= self.hover <= 1:
            raise SettingsError(f"`hover` is {self.hover:g}: give a share, from 0.05 to 1")
        if self.hover is not None and self.law == "pid":
            raise SettingsError("`hover` is of the ADRC: leave it out, or give `law` adrc")
        if self.sensitivity <= 1:
            raise SettingsError(
                f"`sensitivity` is {self.sensitivity:g}: no loop has a peak of |S| of 1 or below"
            )
        if self.resonance <= 1:
            raise SettingsError(
                f"`resonance` is {self.resonance:g}: a loop with an integral has a peak above 1"
            )
        if self.change <= 1:
            raise SettingsError(f"`change` is {self.change:g}: give a factor above 1")
