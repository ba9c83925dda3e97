"""Settings of the workflows: the same in Python, in TOML, in results, and in a shell's words."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field
from fnmatch import fnmatchcase
from typing import Annotated, Literal, NamedTuple

from jaxquad._core import marked_text, Message

from . import _options as kinds
from ._autopilot_settings import AutopilotSettings, CompareSettings
from ._options import (
    check_keys,
    convert,
    Pair,
    REPLACED,
    S,
    Settings,
    SettingsError,
    updated,
    Value,
    within_file,
)


# In the order in which help shows them.
GROUPS = ("the record", "the estimate", "the model", "a second record")


@dataclasses.dataclass(frozen=True, kw_only=True)
class IdentifySettings(Settings):
    """How one log is identified: signals, part of the record, model and estimate.

    The keyword arguments are the keys of the TOML file; `jaxquad identify --help` lists them as
    options. Without `input` and `output`, an autopilot's log proposes them.

    **The record:**

    - `input`: a channel, or a weighted sum NAME=-a+b+0.5*c, also with powers: NAME=0.1*a^2; by
      default the log of a known autopilot proposes input and output
    - `output`: likewise
    - `reference`: an external signal that no feedback computes; with it, the joint input-output
      estimate is made beside the direct one
    - `other_inputs` (`--other-input`): another signal that moves the output, such as another axis'
      command: its part is taken out of the response; may be repeated
    - `axis`: the axis to propose input and output for
    - `chirp`: the number of the one to use of the chirps that a log's proposal lists; by default
      the longest, with all others on its axis at its place
    - `flight`: the number of the flight in a file with several; by default the longest with a
      chirp, else the longest with sticks that move
    - `units` (`--unit`): the unit of a channel, such as q=rad/s; may be repeated
    - `time`: the channel that holds the time, or the two with seconds and nanoseconds: sec+nanosec
    - `time_unit`: its unit
    - `dt`: the sampling interval of a table without time, whose rows are equally spaced
    - `time_factor`: of the time stamps, where their clock runs slow or fast: 1.0119 (85/84) for a
      Crazyflie's micro-SD log with firmware before August 2026
    - `rate`: resample to this rate; by default the slowest channel's own
    - `hold`: for how long the plant's input keeps each value: the loop's period for a command (dt:
      a sample), 0 for a quantity that was measured; by default what an autopilot's log says
    - `valid`: lowest and highest value of a channel that can be true, such as gyro.x=-20:20: others
      count as missing, and are interpolated; may be repeated
    - `max_gap`: the longest gap, and the longest run of missing values, that is interpolated
    - `start`: first time to use, in the file's time
    - `stop`: last time to use
    - `segments` (`--segment`): instead of start and stop; repeat it to analyse several parts
      together

    **The model:**

    - `integrators`: n in K e^(-delay s) / (s^n (lag s + 1)): 1 from a moment to a rate, 2 to an
      angle; 1 by default
    - `lag` (`--no-lag`): fit a model without the lag
    - `delay` (`--no-delay`): fit a model without the delay
    - `poles`: fit a transfer function with this many poles beside the integrators, instead of gain
      and lag
    - `zeros`: number of zeros, with --poles; 0 by default
    - `keep_gyro_filters`: leave the gyro's filters in the model; by default those in front of an
      autopilot's logged rate are divided out, where the log has their parameters

    **The estimate:**

    - `band`: fit between these frequencies, in Hz (6.28 rad/s); by default what the record resolves
    - `band_rad`: the same in rad/s (0.159 Hz)
    - `estimator`: of the frequency response: local polynomials, composite windows, or windows of
      one length; local by default
    - `window`: length of welch's window, which it selects; a fifth of the record by default
    - `cost`: maximum likelihood, or CIFER's coherence-weighted cost, Eq. (14); ml by default
    - `explain`: where the misfit exceeds 1.5 random errors, or gain or clock seem to drift, fit
      again with one more pole, zero, pair, damping, or drift, and say which of them explains it

    **A second record:**

    - `verify`: simulate the model on this record, which has the same channels
    - `verify_start`: first time of that record to use
    - `verify_stop`: last time of that record to use

    **Raises:** `SettingsError` (a ValueError) for values that cannot be, and for settings that
    exclude each other.

    !!! example

        ```python
        settings = jq.workflows.IdentifySettings(
            input="roll=-m1-m2+m3+m4", output="p", band=(0.7, 12), units={"p": "rad/s"}
        )
        ```
    """

    input: Annotated[str | None, kinds.MIX] = None
    output: Annotated[str | None, kinds.MIX] = None
    reference: Annotated[str | None, kinds.MIX] = None
    other_inputs: Annotated[Sequence[str], kinds.MIXES] = ()
    axis: Annotated[str | None, kinds.AXIS] = None
    chirp: Annotated[int | None, kinds.SIZE] = None
    flight: Annotated[int | None, kinds.SIZE] = None
    units: Annotated[Mapping[str, str], kinds.UNITS] = field(default_factory=dict)
    time: Annotated[str | None, kinds.TEXT] = None
    time_unit: Annotated[Literal["s", "ms", "us", "ns"] | None, kinds.TIME_UNIT] = None
    dt: Annotated[float | None, kinds.DURATION] = None
    time_factor: Annotated[float | None, kinds.POSITIVE] = None
    rate: Annotated[float | None, kinds.HERTZ] = None
    hold: Annotated[float | Literal["dt"] | None, kinds.HOLD] = None
    valid: Annotated[Mapping[str, Pair], kinds.RANGES] = field(default_factory=dict)
    max_gap: Annotated[float | None, kinds.DURATION] = None
    start: Annotated[float | None, kinds.TIME] = None
    stop: Annotated[float | None, kinds.TIME] = None
    segments: Annotated[Sequence[Pair], kinds.SEGMENTS] = ()
    integrators: Annotated[int, kinds.COUNT] = 1
    lag: Annotated[bool, kinds.SWITCH] = True
    delay: Annotated[bool, kinds.SWITCH] = True
    poles: Annotated[int | None, kinds.COUNT] = None
    zeros: Annotated[int, kinds.COUNT] = 0
    keep_gyro_filters: Annotated[bool, kinds.SWITCH] = False
    band: Annotated[Pair | None, kinds.BAND] = None
    band_rad: Annotated[Pair | None, kinds.BAND] = None
    estimator: Annotated[str, kinds.ESTIMATOR] = "local"
    window: Annotated[float | None, kinds.DURATION] = None
    cost: Annotated[str, kinds.COST] = "ml"
    explain: Annotated[bool, kinds.SWITCH] = False
    verify: Annotated[str | None, kinds.FILE] = None
    verify_start: Annotated[float | None, kinds.TIME] = None
    verify_stop: Annotated[float | None, kinds.TIME] = None

    def clashes(self) -> Iterator[str]:
        if (self.input is None) != (self.output is None):
            yield "`input` and `output` belong together: give both, or none to have them proposed"
        for key in ("axis", "chirp"):
            if self.input is not None and vars(self)[key] is not None:
                yield f"`{key}` is for a proposal: leave it out, or leave `input` and `output` out"
        if self.input is not None and self.flight is not None:
            yield (
                "`flight` is for a proposal: name the channels of that flight (log2.axisSum[0]), "
                "or leave `input` and `output` out"
            )
        if self.segments and (self.start is not None or self.stop is not None):
            yield "`segments` says where to start and stop: leave `start` and `stop` out"
        if self.band is not None and self.band_rad is not None:
            yield "`band` (Hz) and `band_rad` (rad/s) are both given: keep one"
        names = [text.partition("=")[0] for text in (*self.other_inputs, self.input or "")]
        if len(set(names)) < len(names):
            yield f"`input` and `other_inputs` are {', '.join(names)}: give each signal once"
        if self.other_inputs and self.reference and (self.window or self.estimator != "local"):
            yield (
                "`other_inputs` beside a `reference` need local polynomials: leave `estimator` and "
                "`window` out"
            )
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


@dataclasses.dataclass(frozen=True, kw_only=True)
class TuneSettings(Settings):
    """How a controller is tuned on an identified axis: what the record does not tell.

    The keyword arguments are the keys of the TOML file; `jaxquad tune --help` lists them as
    options.

    **The vehicle:**

    - `inertia`: nominal inertia of the axis, in kg m^2, from CAD, a swing test or a guess with a
      wide `spread`; required
    - `limit`: largest command, to either side, in its unit, as the log has it; required
    - `spread`: range of the true inertia, as factors of the nominal one; 0.5 3 by default
    - `inertia_error`: relative standard error of the inertia that the controller's gains are
      scheduled with; 0.1 by default
    - `noise`: standard deviation of the measured angle; 0.02 by default

    **The simulated flight:**

    - `step`: step of the reference; 4 by default
    - `disturbance`: torque pulse; by default a tenth of the torque at the limit
    - `duration`: of one flight; 4 by default

    **The controller:**

    - `dt`: sampling interval of the controller; by default that of the record
    - `sensitivity`: upper limit of the peak of |S|; 3.6 by default
    - `wo`: hold the observer's bandwidth at this value in rad/s, for instance where the identified
      band ends; by default it is tuned
    - `name`: prefix of the functions in the C header; attitude by default

    **The plants:**

    - `members`: number of plants to tune on; 64 by default
    - `fresh`: number of new plants to certify on; 256 by default
    - `seed`: of the random draws; 0 by default

    **Raises:** `SettingsError` (a ValueError) for values that cannot be.
    """

    inertia: Annotated[float, kinds.INERTIA]
    limit: Annotated[float, kinds.POSITIVE]
    spread: Annotated[Pair, kinds.BAND] = (0.5, 3.0)
    inertia_error: Annotated[float, kinds.NOT_NEGATIVE] = 0.1
    noise: Annotated[float, kinds.DEVIATION] = 0.02
    step: Annotated[float, kinds.DEGREES] = 4.0
    disturbance: Annotated[float | None, kinds.TORQUE] = None
    duration: Annotated[float, kinds.DURATION] = 4.0
    dt: Annotated[float | None, kinds.DURATION] = None
    sensitivity: Annotated[float, kinds.POSITIVE] = 3.6
    wo: Annotated[float | None, kinds.POSITIVE] = None
    name: Annotated[str, kinds.TEXT] = "attitude"
    members: Annotated[int, kinds.SIZE] = 64
    fresh: Annotated[int, kinds.SIZE] = 256
    seed: Annotated[int, kinds.COUNT] = 0


class Override(NamedTuple):
    """Settings of the logs whose paths match one of the patterns."""

    logs: tuple[str, ...]
    changes: Mapping[str, object]


_ONE_LOG = ("verify", "verify_start", "verify_stop")
_LOG_KEYS = tuple(key for key in IdentifySettings.options() if key not in _ONE_LOG)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchSettings(Settings):
    """Which logs of a folder are identified, how each of them, and by how many processes.

    In TOML the keys of `identify` stand beside the others, and each override is a table
    `[[override]]` with `logs` and the keys that it changes.

    **Arguments:**

    - `logs`: file patterns below the folder; by default every file but hidden ones
    - `timeout`: limit for one log, which has failed if it takes longer; 1800 by default, none with
      a scheduler
    - `workers`: processes of this machine; by default one for each core
    - `scheduler`: of a Dask cluster that sees the same files, such as tcp://10.0.0.1:8786

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

    logs: Annotated[str | Sequence[str], kinds.PATTERNS] = ("**/*",)
    timeout: Annotated[float | None, kinds.DURATION] = None
    workers: Annotated[int | None, kinds.SIZE] = None
    scheduler: Annotated[str | None, kinds.ADDRESS] = None
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
            settings["overrides"] = overrides = []
            for k, table in enumerate(tables, 1):
                try:
                    check_keys(table, [*_LOG_KEYS, "logs"])
                    if "logs" not in table:
                        raise SettingsError('`logs` is missing: add logs = "flight_07*"')
                    patterns = convert("logs", kinds.PATTERNS, table["logs"])
                    changes = _checked({k: v for k, v in table.items() if k != "logs"})
                except SettingsError as error:
                    raise SettingsError(f"override {k}: {error}") from error
                overrides.append(Override(patterns, changes))
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


# The command line's words: `max_gap=` is an argument, `jq.verify` a function, and someone who typed
# `jaxquad identify` needs the option, `--max-gap`, or the command, `jaxquad verify`.
_FLAGS = {
    key: option.flag
    for settings in (
        BatchSettings,
        CompareSettings,
        AutopilotSettings,
        TuneSettings,
        IdentifySettings,
    )
    for key, option in settings.options().items()
} | {"amplitude": "--amplitude", "switch": "--switch"}  # of a recipe
_ARGUMENTS = _FLAGS | {  # those of `read`, `frequency_response` and `fit`, whose names differ
    "inputs": "--input",
    "outputs": "--output",
    "references": "--reference",
    "sample_rate": "--rate",
    "window_length": "--window",
    "band": "--band-rad",  # of a fit, in rad/s
}
_WORDS = {  # of a message, by what stands in its guillemets
    "name inputs, outputs and references yourself": "name them (--input, --output, --reference)",
    "pick channels with jq.records.select": "name one channel each with --input and --output",
    "select other channels with jq.records.select, or ": "",
    " with jq.records.select": "",
    " with jq.records.trim": "",
    " (horizon=)": "",
    ", jq.records.channels": "",
    ", or build a jq.Record from its arrays": "",
    " in jq.read, or cut the arrays": "",
    " (jq.Record, jq.read)": "",
    "jq.spectra.LocalPolynomial()": "--estimator local",
    " (estimator=jq.spectra.LocalPolynomial())": " (without --reference)",
    "joint estimate": " (--reference)",
    ", or give the frequencies (omega=)": "",
    ", or raise global_order": "",
    "wider": "",
    "start from other values": "choose another band (--band)",
    "start from other values, or fit fewer parameters (free=)":
        "choose another band (--band) or a simpler model (--no-lag, --no-delay, fewer --poles)",
    "try other starting values": "try another band (--band), or jaxquad identify --no-lag",
    ", or give starts=20": "",
    "sign": " (--no-lag, --no-delay)",
    "other sign": ". A lag and a delay cannot be negative: the model",
    " (leave it out of free=)": "",
    "free=": "what is fitted (--no-delay)",
    "fit with a jq.identify.Prior or a second record, or ask for a determined combination":
        "fit without one of them (--no-lag, --no-delay), or fly again with more excitation",
    "Fit.explain()": "--explain",
    "jq.verify": "jaxquad verify",
    "jq.sweep": "jaxquad design sweep",
}  # fmt: skip


def in_options(text: str | BaseException) -> Message:
    """A message with options in place of Python's words, and of keys of settings in backticks."""

    def word(term: str) -> str:
        key, _, python = term.rpartition("|")
        key = key or python
        name, _, value = key.partition("=")
        flag = _ARGUMENTS.get(name)
        return _WORDS.get(key, python if flag is None else f"{flag} {value}".rstrip())

    marked = marked_text(text)
    for key, flag in _FLAGS.items():
        marked = marked.replace(f"`{key}`", flag)
    return Message(marked, text.kind if isinstance(text, Message) else "").in_words(word)
