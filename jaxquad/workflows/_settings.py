"""Settings of the workflows: the same in Python, on the command line, in TOML and in results."""

import dataclasses
import functools as ft
from collections.abc import Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from typing import Literal, NamedTuple

from . import _options as kinds
from ._options import (
    check_keys,
    convert,
    option_field,
    Pair,
    REPLACED,
    S,
    Settings,
    SettingsError,
    updated,
    Value,
    within_file,
)


_MISSING = dataclasses.MISSING
# In the order in which help shows them.
GROUPS = ("the record", "the estimate", "the model", "a second record")
_record, _estimate, _model, _check = (ft.partial(option_field, group) for group in GROUPS)
_which_chirp = ft.partial(
    _record, kinds.SIZE, None,
    "the number of the one to use of the chirps that a log's proposal lists; by default the "
    "longest, with all others on its axis at its place",
)  # fmt: skip
_which_flight = ft.partial(
    _record, kinds.SIZE, None,
    "the number of the flight in a file with several; by default the longest with a chirp, "
    "else the longest with sticks that move",
)  # fmt: skip


@dataclasses.dataclass(frozen=True, kw_only=True)
class IdentifySettings(Settings):
    """How one log is identified: signals, part of the record, model and estimate.

    The keyword arguments are the keys of the TOML file; `jaxquad identify --help` lists them as
    options. Without `input` and `output`, an autopilot's log proposes them.

    **Raises:** `SettingsError` (a ValueError) for values that cannot be, and for settings that
    exclude each other.

    !!! example

        ```python
        settings = jq.workflows.IdentifySettings(
            input="roll=-m1-m2+m3+m4", output="p", band=(0.7, 12), units={"p": "rad/s"}
        )
        ```
    """

    input: str | None = _record(
        kinds.MIX,
        None,
        "a channel, or a weighted sum NAME=-a+b+0.5*c, also with powers: NAME=0.1*a^2; "
        "by default the log of a known autopilot proposes input and output",
    )
    output: str | None = _record(kinds.MIX, None, "likewise")
    reference: str | None = _record(
        kinds.MIX,
        None,
        "an external signal that no feedback computes; with it, the joint input-output "
        "estimate is made beside the direct one",
    )
    axis: str | None = _record(kinds.AXIS, None, "the axis to propose input and output for")
    chirp: int | None = _which_chirp()
    flight: int | None = _which_flight()
    units: Mapping[str, str] = _record(
        kinds.UNITS, {}, "the unit of a channel, such as q=rad/s; may be repeated", flag="--unit"
    )
    time: str | None = _record(
        kinds.TEXT,
        None,
        "the channel that holds the time, or the two with seconds and nanoseconds: sec+nanosec",
    )
    time_unit: Literal["s", "ms", "us", "ns"] | None = _record(kinds.TIME_UNIT, None, "its unit")
    dt: float | None = _record(
        kinds.DURATION,
        None,
        "the sampling interval of a table without time, whose rows are equally spaced",
    )
    time_factor: float | None = _record(
        kinds.POSITIVE,
        None,
        "of the time stamps, where their clock runs slow or fast: 1.0119 (85/84) for a Crazyflie's "
        "micro-SD log with firmware before August 2026",
    )
    rate: float | None = _record(
        kinds.HERTZ, None, "resample to this rate; by default the slowest channel's own"
    )
    hold: float | Literal["dt"] | None = _record(
        kinds.HOLD,
        None,
        "for how long the plant's input keeps each value: the loop's period for a command (dt: a "
        "sample), 0 for a quantity that was measured; by default what an autopilot's log says",
    )
    valid: Mapping[str, Pair] = _record(
        kinds.RANGES,
        {},
        "lowest and highest value of a channel that can be true, such as gyro.x=-20:20: others "
        "count as missing, and are interpolated; may be repeated",
    )
    max_gap: float | None = _record(
        kinds.DURATION,
        None,
        "the longest gap, and the longest run of missing values, that is interpolated",
    )
    start: float | None = _record(kinds.TIME, None, "first time to use, in the file's time")
    stop: float | None = _record(kinds.TIME, None, "last time to use")
    segments: Sequence[Pair] = _record(
        kinds.SEGMENTS,
        (),
        "instead of start and stop; repeat it to analyse several parts together",
        flag="--segment",
    )
    integrators: int = _model(
        kinds.COUNT,
        1,
        "n in K e^(-delay s) / (s^n (lag s + 1)): 1 from a moment to a rate, 2 to an "
        "angle; 1 by default",
    )
    lag: bool = _model(kinds.SWITCH, True, "fit a model without the lag", flag="--no-lag")
    delay: bool = _model(kinds.SWITCH, True, "fit a model without the delay", flag="--no-delay")
    poles: int | None = _model(
        kinds.COUNT,
        None,
        "fit a transfer function with this many poles beside the integrators, "
        "instead of gain and lag",
    )
    zeros: int = _model(kinds.COUNT, 0, "number of zeros, with --poles; 0 by default")
    keep_gyro_filters: bool = _model(
        kinds.SWITCH,
        False,
        "leave the gyro's filters in the model; by default those in front of an autopilot's logged "
        "rate are divided out, where the log has their parameters",
    )
    band: Pair | None = _estimate(
        kinds.BAND,
        None,
        "fit between these frequencies, in Hz (6.28 rad/s); by default what the record resolves",
    )
    band_rad: Pair | None = _estimate(kinds.BAND, None, "the same in rad/s (0.159 Hz)")
    estimator: str = _estimate(
        kinds.ESTIMATOR,
        "local",
        "of the frequency response: local "
        "polynomials, composite windows, or windows of one length; local by default",
    )
    window: float | None = _estimate(
        kinds.DURATION,
        None,
        "length of welch's window, which it selects; a fifth of the record by default",
    )
    cost: str = _estimate(
        kinds.COST,
        "ml",
        "maximum likelihood, or CIFER's coherence-weighted cost, Eq. (14); ml by default",
    )
    explain: bool = _estimate(
        kinds.SWITCH,
        False,
        "where the misfit exceeds 1.5 random errors, fit again with one more pole, zero, pair, "
        "or damping, and say which of them explains it",
        flag="--explain",
    )
    verify: str | None = _check(
        kinds.FILE, None, "simulate the model on this record, which has the same channels"
    )
    verify_start: float | None = _check(kinds.TIME, None, "first time of that record to use")
    verify_stop: float | None = _check(kinds.TIME, None, "last time of that record to use")

    def clashes(self) -> Iterator[str]:
        if (self.input is None) != (self.output is None):
            yield "`input` and `output` belong together: give both, or none to have them proposed"
        if self.input is not None and self.axis is not None:
            yield "`axis` is for a proposal: leave it out, or leave `input` and `output` out"
        if self.input is not None and self.chirp is not None:
            yield "`chirp` is for a proposal: leave it out, or leave `input` and `output` out"
        if self.input is not None and self.flight is not None:
            yield (
                "`flight` is for a proposal: name the channels of that flight (log2.axisSum[0]), "
                "or leave `input` and `output` out"
            )
        if self.segments and (self.start is not None or self.stop is not None):
            yield "`segments` says where to start and stop: leave `start` and `stop` out"
        if self.band is not None and self.band_rad is not None:
            yield "`band` (Hz) and `band_rad` (rad/s) are both given: keep one"
        if self.dt is not None and (self.time is not None or self.time_unit is not None):
            yield "`dt` is for a table without time: leave `time` and `time_unit` out"
        # What would change nothing beside the others.
        if self.zeros and self.poles is None:
            yield "`zeros` is for a transfer function: say its `poles`, too"
        if self.poles is not None and self.zeros > self.poles + self.integrators:
            yield (
                f"`zeros` is {self.zeros}, above {self.poles} `poles` and {self.integrators} "
                "`integrators`: take as many zeros as these at most"
            )
        if self.poles is not None and not self.lag:
            yield "`lag` is for a model of gain, lag and delay: leave it out, or leave `poles` out"
        if self.window is not None and self.estimator == "composite":
            yield "`window` is for windows of one length: leave it out, or choose `estimator` welch"
        if self.verify is None and (self.verify_start, self.verify_stop) != (None, None):
            yield "`verify_start` and `verify_stop` are for a second record: name it by `verify`"


_vehicle = ft.partial(option_field, "the vehicle")
_flight = ft.partial(option_field, "the simulated flight")
_controller = ft.partial(option_field, "the controller")
_plants = ft.partial(option_field, "the plants")
_law, _kept = ft.partial(option_field, "the law"), ft.partial(option_field, "what is kept")


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneSettings(Settings):
    """How a controller is tuned on an identified axis: what the record does not tell.

    The keyword arguments are the keys of the TOML file; `jaxquad tune --help` lists them as
    options.

    **Raises:** `SettingsError` (a ValueError) for values that cannot be.
    """

    inertia: float = _vehicle(
        kinds.INERTIA, _MISSING, "nominal inertia of the axis, in kg m^2; required"
    )
    limit: float = _vehicle(
        kinds.POSITIVE, _MISSING, "largest command, to either side, in its unit; required"
    )
    spread: Pair = _vehicle(
        kinds.BAND,
        (0.5, 3.0),
        "range of the true inertia, as factors of the nominal one; 0.5 3 by default",
    )
    inertia_error: float = _vehicle(
        kinds.NOT_NEGATIVE,
        0.1,
        "relative standard error of the inertia that the controller's gains "
        "are scheduled with; 0.1 by default",
    )
    noise: float = _vehicle(
        kinds.DEVIATION, 0.02, "standard deviation of the measured angle; 0.02 by default"
    )
    step: float = _flight(kinds.DEGREES, 4.0, "step of the reference; 4 by default")
    disturbance: float | None = _flight(
        kinds.TORQUE, None, "torque pulse; by default a tenth of the torque at the limit"
    )
    duration: float = _flight(kinds.DURATION, 4.0, "of one flight; 4 by default")
    dt: float | None = _controller(
        kinds.DURATION, None, "sampling interval of the controller; by default that of the record"
    )
    sensitivity: float = _controller(
        kinds.POSITIVE, 3.6, "upper limit of the peak of |S|; 3.6 by default"
    )
    wo: float | None = _controller(
        kinds.POSITIVE,
        None,
        "hold the observer's bandwidth at this value in rad/s, for instance where the "
        "identified band ends; by default it is tuned",
    )
    name: str = _controller(
        kinds.TEXT, "attitude", "prefix of the functions in the C header; attitude by default"
    )
    members: int = _plants(kinds.SIZE, 64, "number of plants to tune on; 64 by default")
    fresh: int = _plants(kinds.SIZE, 256, "number of new plants to certify on; 256 by default")
    seed: int = _plants(kinds.COUNT, 0, "of the random draws; 0 by default")


@dataclasses.dataclass(frozen=True, kw_only=True)
class AutopilotSettings(Settings):
    """How the gains of the autopilot that flew a log are tuned.

    The keyword arguments are the keys of the TOML file; `jaxquad autopilot --help` lists them as
    options. Input, output and reference are those that the log proposes.

    **Raises:** `SettingsError` (a ValueError) for values that cannot be.
    """

    axis: str = _record(
        kinds.ONE_OR_ALL_AXES,
        "all",
        "the axis to tune; all by default, with one file of parameters",
    )
    chirp: int | None = _which_chirp()
    flight: int | None = _which_flight()
    start: float | None = _record(kinds.TIME, None, "first time to use, in the file's time")
    stop: float | None = _record(kinds.TIME, None, "last time to use")
    band: Pair | None = _record(
        kinds.BAND,
        None,
        "fit between these frequencies, in Hz; by default what the record resolves",
    )
    throttle: float | None = _record(
        kinds.POSITIVE,
        None,
        "of 1, at which Betaflight's dynamic filters and TPA are taken; by default the log's "
        "median, 0.3 where it does not hold the throttle",
    )
    law: Literal["pid", "adrc"] | None = _law(
        kinds.LAW,
        None,
        "the law to tune: adrc is that of Betaflight's pull request 15400; by default what flew",
    )
    hover: float | None = _law(
        kinds.POSITIVE,
        None,
        "adrc_hover_throttle, of 1; by default that of the ADRC that flew, else the lowest level "
        "of throttle that was flown",
    )
    sensitivity: float = _kept(
        kinds.POSITIVE, 1.8, "upper limit of the peak of |S|; 1.8 by default"
    )
    resonance: float = _kept(
        kinds.POSITIVE,
        1.4,
        "upper limit of the peak of the response from set-point to rate; 1.4 by default",
    )
    noise: float = _kept(
        kinds.POSITIVE,
        1.5,
        "the most that the command's noise may grow, as a factor; 1.5 by default",
    )
    change: float = _kept(
        kinds.POSITIVE,
        3.0,
        "factor within which each gain and cutoff, or wc, wo and b0, stays of what flew; 3 by "
        "default",
    )
    keep_filters: bool = _kept(
        kinds.SWITCH, False, "leave the filters as they flew, and tune gains alone"
    )
    members: int = _plants(kinds.SIZE, 32, "number of plants to tune on; 32 by default")
    fresh: int = _plants(kinds.SIZE, 256, "number of new plants to certify on; 256 by default")
    seed: int = _plants(kinds.COUNT, 0, "of the random draws; 0 by default")

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


class Override(NamedTuple):
    """Settings of the logs whose paths match one of the patterns."""

    logs: tuple[str, ...]
    changes: Mapping[str, object]


_ONE_LOG = ("verify", "verify_start", "verify_stop")
_LOG_KEYS = tuple(key for key in IdentifySettings.options() if key not in _ONE_LOG)
_batch = ft.partial(option_field, "")


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchSettings(Settings):
    """Which logs of a folder are identified, how each of them, and by how many processes.

    In TOML the keys of `identify` stand beside the others, and each override is a table
    `[[override]]` with `logs` and the keys that it changes.

    **Raises:** `SettingsError` (a ValueError) for values that cannot be.

    !!! example

        ```python
        settings = jq.workflows.BatchSettings(
            logs="**/*.ulg",
            identify={"band": (0.7, 12), "integrators": 1},
            overrides=[jq.workflows.Override(("flight_07*",), {"stop": 80})],
        )
        ```
    """

    logs: str | Sequence[str] = _batch(
        kinds.PATTERNS,
        ("**/*",),
        "file patterns below the folder; by default every file but hidden ones",
    )
    timeout: float | None = _batch(
        kinds.DURATION,
        None,
        "limit for one log, which has failed if it takes longer; 1800 by default, "
        "none with a scheduler",
    )
    workers: int | None = _batch(
        kinds.SIZE, None, "processes of this machine; by default one for each core"
    )
    scheduler: str | None = _batch(
        kinds.ADDRESS,
        None,
        "of a Dask cluster that sees the same files, such as tcp://10.0.0.1:8786",
    )
    identify: IdentifySettings | Mapping[str, object] = dataclasses.field(default_factory=dict)
    overrides: Sequence[Override] = ()

    @classmethod
    def from_mapping(cls: type[S], content: Mapping[str, object], where: str = "") -> S:
        try:
            check_keys(content, [*cls.options(), *_LOG_KEYS, "override"])
            tables = content.get("override", [])
            if not isinstance(tables, list) or not all(isinstance(t, dict) for t in tables):
                raise SettingsError("`override` is no list of tables: write [[override]]")
            settings: dict[str, Value] = {k: content[k] for k in content if k in cls.options()}
            settings["identify"] = {key: content[key] for key in content if key in _LOG_KEYS}
            settings["overrides"] = [_override(k, table) for k, table in enumerate(tables, 1)]
            return cls(**settings)
        except SettingsError as error:
            raise within_file(where, error) from error

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "identify", _checked(self._common))
        object.__setattr__(self, "overrides", tuple(Override(*x) for x in self.overrides))

    def clashes(self) -> Iterator[str]:
        if self.timeout is not None and self.scheduler is not None:
            yield "`timeout` is for processes of this machine: leave it out with `scheduler`"

    @property
    def _common(self) -> Mapping[str, object]:
        common = self.identify
        return common.changes() if isinstance(common, IdentifySettings) else common

    def changed(self: S, changes: Mapping[str, object]) -> S:
        return dataclasses.replace(self, **changes)  # pyright: ignore[reportArgumentType]

    def of(self, log: str) -> IdentifySettings:
        """The settings of one log, by its path below the folder.

        Later overrides change earlier ones. A key that says the same in another way takes the
        place of the other: `segments` that of `start` and `stop`, `band` that of `band_rad`.

        **Raises:** `SettingsError` for settings that exclude each other.
        """
        settings = self._common
        for patterns, changes in self.overrides:
            if any(fnmatchcase(log, pattern) for pattern in patterns):
                settings = updated(settings, changes)
        return IdentifySettings.from_mapping(settings, f"settings of {log}")


def _override(k: int, table: Mapping[str, object]) -> Override:
    try:
        check_keys(table, [*_LOG_KEYS, "logs"])
        if "logs" not in table:
            raise SettingsError('`logs` is missing: add logs = "flight_07*"')
        patterns = convert("logs", kinds.PATTERNS, table["logs"])
        return Override(patterns, _checked({k: v for k, v in table.items() if k != "logs"}))
    except SettingsError as error:
        raise SettingsError(f"override {k}: {error}") from error


def _checked(content: Mapping[str, object]) -> dict[str, object]:
    """The values converted; whether they go together is known once overrides are applied."""
    check_keys(content, _LOG_KEYS)
    options = IdentifySettings.options()
    values = {key: convert(key, options[key].kind, value) for key, value in content.items()}
    for key, others in REPLACED.items():
        clash = next((other for other in others if key in values and other in values), None)
        if clash is not None:
            raise SettingsError(f"`{key}` and `{clash}` are both given: keep one")
    return values
