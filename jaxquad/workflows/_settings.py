"""Settings of the workflows: the same in Python, on the command line, in TOML and in results."""

import dataclasses
import difflib
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, NamedTuple, TypeVar

from . import _kinds as kinds
from ._kinds import convert, Pair, SettingsError, Value


class Option(NamedTuple):
    """How a setting is said on the command line, and what its help says."""

    kind: kinds.Kind
    help: str
    group: str
    flag: str


def option_field(
    kind: kinds.Kind, default: Value, help: str, *, group: str = "", flag: str = ""
) -> Value:
    metadata = {"option": Option(kind, help, group, flag)}
    if isinstance(default, dict):
        return dataclasses.field(default_factory=default.copy, metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


_REQUIRED = dataclasses.MISSING
THE_RECORD = _PART = "the record"
_ESTIMATE, _MODEL, _CHECK = "the estimate", "the model", "a second record"
GROUPS = (THE_RECORD, _ESTIMATE, _MODEL, _CHECK)  # in the order in which help shows them
REPLACED: Mapping[str, Sequence[str]] = {  # the keys that a key takes the place of
    "segments": ("start", "stop"),
    "start": ("segments",),
    "stop": ("segments",),
    "band": ("band_rad",),
    "band_rad": ("band",),
}


S = TypeVar("S", bound="Settings")


class Settings:
    """Frozen dataclasses whose fields are declared by `option_field`, which says what they take."""

    __no_type_check__ = True  # in tests: fields are converted, such as a list to a tuple

    @classmethod
    def options(cls) -> dict[str, Option]:
        """How each setting is said, by its key."""
        fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
        found = {field.name: field.metadata["option"] for field in fields}
        flags = {key: each.flag or f"--{key.replace('_', '-')}" for key, each in found.items()}
        return {key: each._replace(flag=flags[key]) for key, each in found.items()}

    @classmethod
    def defaults(cls) -> dict[str, Value]:
        fields = dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
        return {f.name: {} if f.default is _REQUIRED else f.default for f in fields}

    @classmethod
    def from_mapping(cls: type[S], content: Mapping[str, object], where: str = "") -> S:
        """Settings from what TOML or JSON hold; `where` begins the message of an error.

        Raises SettingsError for an unknown key, with the most similar known one, for a required
        key that is missing, and for values that cannot be.
        """
        try:
            check_keys(content, cls.options())
            missing = [
                each.name
                for each in dataclasses.fields(cls)  # pyright: ignore[reportArgumentType]
                if each.default is each.default_factory is _REQUIRED and each.name not in content
            ]
            if missing:
                keys = " and ".join(f"`{key}`" for key in missing)
                raise SettingsError(f"{keys} must be given")
            return cls(**content)
        except SettingsError as error:
            raise within_file(where, error) from error

    @classmethod
    def from_toml(cls: type[S], path: str | Path) -> S:
        """As `from_mapping`, from a TOML file."""
        return cls.from_mapping(read_toml(path), str(path))

    def content(self) -> dict[str, Value]:
        """All settings, for JSON; `from_mapping` reads them."""
        return {key: vars(self)[key] for key in self.options()}

    def given(self) -> dict[str, Value]:
        """The settings that differ from their defaults."""
        defaults = self.defaults()
        return {key: value for key, value in self.content().items() if value != defaults[key]}

    def changed(self: S, changes: Mapping[str, object]) -> S:
        """These settings with others for some keys; `band` takes the place of `band_rad`, etc."""
        return self.from_mapping(updated(self.given(), changes))

    def words(self) -> list[str]:
        """The options on the command line that stand for these settings."""
        options = self.options()
        return [w for key, value in self.given().items() for w in _words(options[key], value)]

    def __post_init__(self):
        for key, option in self.options().items():
            object.__setattr__(self, key, self._converted(key, option.kind))
        self._check_together()

    def _converted(self, key: str, kind: kinds.Kind) -> Value:
        value = vars(self)[key]
        if value is None and self.defaults()[key] is None:
            return None
        return convert(key, kind, value)

    def _check_together(self) -> None:
        pass


def _words(option: Option, value: Value) -> list[str]:
    kind, flag = option.kind, option.flag
    if kind.words == 0:
        return [flag]
    if kind.repeated:
        items = value.items() if isinstance(value, Mapping) else value
        texts = [kind.write(each) for each in items]
        # A negative start by itself would be taken for an option.
        each = [[f"{flag}={text}"] if text.startswith("-") else [flag, text] for text in texts]
        return [word for words in each for word in words]
    return [flag, *(kind.write(each) for each in (value if kind.words > 1 else [value]))]


def within_file(where: str, error: SettingsError) -> SettingsError:
    """In a file, keys are what they are: no flags of the command line stand for them."""
    return SettingsError(f"{where}: {error}".replace("`", "") if where else str(error))


def check_keys(content: Mapping[str, object], known: Iterable[str]) -> None:
    """Raise SettingsError for the first key that is not known."""
    known = list(known)
    for key in content:
        if key not in known:
            near = difflib.get_close_matches(key, known, n=1, cutoff=0.4)
            hint = f"did you mean {near[0]!r}?" if near else f"known keys: {', '.join(known)}"
            raise SettingsError(f"unknown key {key!r}; {hint}")


def read_toml(path: str | Path) -> dict[str, object]:
    """Raises SettingsError for a file that is not TOML, and for none."""
    try:
        return tomllib.loads(Path(path).read_text())
    except FileNotFoundError as error:
        raise SettingsError(f"{path}: there is no such file in {Path.cwd()}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise SettingsError(f"{path}: not TOML: {error}") from error


def updated(content: Mapping[str, object], changes: Mapping[str, object]) -> dict[str, object]:
    """`content` with `changes`; keys that say the same in another way go (band for band_rad)."""
    gone = {old for key in changes for old in REPLACED.get(key, ()) if old not in changes}
    return {key: value for key, value in content.items() if key not in gone} | dict(changes)


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

    input: str | None = option_field(
        kinds.MIX,
        None,
        "a channel, or a weighted sum NAME=-a+b+0.5*c, also with powers: NAME=0.1*a^2; "
        "by default the log of a known autopilot proposes input and output",
        group=THE_RECORD,
    )
    output: str | None = option_field(kinds.MIX, None, "likewise", group=THE_RECORD)
    reference: str | None = option_field(
        kinds.MIX,
        None,
        "an external signal that no feedback computes; with it, the joint input-output "
        "estimate is made beside the direct one",
        group=THE_RECORD,
    )
    axis: str | None = option_field(
        kinds.AXIS, None, "the axis to propose input and output for", group=THE_RECORD
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
    units: Mapping[str, str] = option_field(
        kinds.UNITS,
        {},
        "the unit of a channel, such as q=rad/s; may be repeated",
        group=THE_RECORD,
        flag="--unit",
    )
    time: str | None = option_field(
        kinds.TEXT,
        None,
        "the channel that holds the time, or the two with seconds and nanoseconds: sec+nanosec",
        group=THE_RECORD,
    )
    time_unit: Literal["s", "ms", "us", "ns"] | None = option_field(
        kinds.TIME_UNIT, None, "its unit", group=THE_RECORD
    )
    dt: float | None = option_field(
        kinds.DURATION,
        None,
        "the sampling interval of a table without time, whose rows are equally spaced",
        group=THE_RECORD,
    )
    time_factor: float | None = option_field(
        kinds.POSITIVE,
        None,
        "of the time stamps, where their clock runs slow or fast: 1.0119 (85/84) for a Crazyflie's "
        "micro-SD log with firmware before August 2026",
        group=THE_RECORD,
    )
    rate: float | None = option_field(
        kinds.HERTZ,
        None,
        "resample to this rate; by default the slowest channel's own",
        group=_PART,
    )
    hold: float | Literal["dt"] | None = option_field(
        kinds.HOLD,
        None,
        "for how long the plant's input keeps each value: the loop's period for a command (dt: a "
        "sample), 0 for a quantity that was measured; by default what an autopilot's log says",
        group=THE_RECORD,
    )
    valid: Mapping[str, Pair] = option_field(
        kinds.RANGES,
        {},
        "lowest and highest value of a channel that can be true, such as gyro.x=-20:20: others "
        "count as missing, and are interpolated; may be repeated",
        group=_PART,
    )
    max_gap: float | None = option_field(
        kinds.DURATION,
        None,
        "the longest gap, and the longest run of missing values, that is interpolated",
        group=_PART,
    )
    start: float | None = option_field(
        kinds.TIME, None, "first time to use, in the file's time", group=_PART
    )
    stop: float | None = option_field(kinds.TIME, None, "last time to use", group=_PART)
    segments: Sequence[Pair] = option_field(
        kinds.SEGMENTS,
        (),
        "instead of start and stop; repeat it to analyse several parts together",
        group=_PART,
        flag="--segment",
    )
    integrators: int = option_field(
        kinds.COUNT,
        1,
        "n in K e^(-delay s) / (s^n (lag s + 1)): 1 from a moment to a rate, 2 to an "
        "angle; 1 by default",
        group=_MODEL,
    )
    lag: bool = option_field(
        kinds.SWITCH, True, "fit a model without the lag", group=_MODEL, flag="--no-lag"
    )
    delay: bool = option_field(
        kinds.SWITCH, True, "fit a model without the delay", group=_MODEL, flag="--no-delay"
    )
    poles: int | None = option_field(
        kinds.COUNT,
        None,
        "fit a transfer function with this many poles beside the integrators, "
        "instead of gain and lag",
        group=_MODEL,
    )
    zeros: int = option_field(
        kinds.COUNT, 0, "number of zeros, with --poles; 0 by default", group=_MODEL
    )
    keep_gyro_filters: bool = option_field(
        kinds.SWITCH,
        False,
        "leave the gyro's filters in the model; by default those in front of an autopilot's logged "
        "rate are divided out, where the log has their parameters",
        group=_MODEL,
    )
    band: Pair | None = option_field(
        kinds.BAND,
        None,
        "fit between these frequencies, in Hz (6.28 rad/s); by default what the record resolves",
        group=_ESTIMATE,
    )
    band_rad: Pair | None = option_field(
        kinds.BAND, None, "the same in rad/s (0.159 Hz)", group=_ESTIMATE
    )
    estimator: str = option_field(
        kinds.ESTIMATOR,
        "local",
        "of the frequency response: local "
        "polynomials, composite windows, or windows of one length; local by default",
        group=_ESTIMATE,
    )
    window: float | None = option_field(
        kinds.DURATION,
        None,
        "length of welch's window, which it selects; a fifth of the record by default",
        group=_ESTIMATE,
    )
    cost: str = option_field(
        kinds.COST,
        "ml",
        "maximum likelihood, or CIFER's coherence-weighted cost, Eq. (14); ml by default",
        group=_ESTIMATE,
    )
    explain: bool = option_field(
        kinds.SWITCH,
        False,
        "where the misfit exceeds 1.5 random errors, fit again with one more pole, zero, pair, "
        "or damping, and say which of them explains it",
        group=_ESTIMATE,
        flag="--explain",
    )
    verify: str | None = option_field(
        kinds.FILE,
        None,
        "simulate the model on this record, which has the same channels",
        group=_CHECK,
    )
    verify_start: float | None = option_field(
        kinds.TIME, None, "first time of that record to use", group=_CHECK
    )
    verify_stop: float | None = option_field(
        kinds.TIME, None, "last time of that record to use", group=_CHECK
    )

    def _check_together(self) -> None:
        one_of_two = (self.input is None) != (self.output is None)
        if one_of_two:
            raise SettingsError(
                "`input` and `output` belong together: give both, or none to have them proposed"
            )
        if self.input is not None and self.axis is not None:
            raise SettingsError(
                "`axis` is for a proposal: leave it out, or leave `input` and `output` out"
            )
        if self.input is not None and self.chirp is not None:
            raise SettingsError(
                "`chirp` is for a proposal: leave it out, or leave `input` and `output` out"
            )
        if self.input is not None and self.flight is not None:
            raise SettingsError(
                "`flight` is for a proposal: name the channels of that flight (log2.axisSum[0]), "
                "or leave `input` and `output` out"
            )
        if self.segments and (self.start is not None or self.stop is not None):
            raise SettingsError(
                "`segments` says where to start and stop: leave `start` and `stop` out"
            )
        if self.band is not None and self.band_rad is not None:
            raise SettingsError("`band` (Hz) and `band_rad` (rad/s) are both given: keep one")
        if self.dt is not None and (self.time is not None or self.time_unit is not None):
            raise SettingsError(
                "`dt` is for a table without time: leave `time` and `time_unit` out"
            )
        self._check_unused()

    def _check_unused(self) -> None:
        """Raise SettingsError for what would change nothing beside the others."""
        if self.zeros and self.poles is None:
            raise SettingsError("`zeros` is for a transfer function: say its `poles`, too")
        if self.poles is not None and self.zeros > self.poles + self.integrators:
            raise SettingsError(
                f"`zeros` is {self.zeros}, above {self.poles} `poles` and {self.integrators} "
                "`integrators`: take as many zeros as these at most"
            )
        if self.poles is not None and not self.lag:
            raise SettingsError(
                "`lag` is for a model of gain, lag and delay: leave it out, or leave `poles` out"
            )
        if self.window is not None and self.estimator == "composite":
            raise SettingsError(
                "`window` is for windows of one length: leave it out, or choose `estimator` welch"
            )
        if self.verify is None and (self.verify_start, self.verify_stop) != (None, None):
            raise SettingsError(
                "`verify_start` and `verify_stop` are for a second record: name it by `verify`"
            )
