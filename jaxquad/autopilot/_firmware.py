"""The interface of a firmware (law, parameters, channels, files), and the registry of all.

A firmware is one file: `firmwares/_px4.py` is a short one, and CONTRIBUTING.md says how to add one.
"""

import abc
import dataclasses
import importlib
import textwrap
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, cast, Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad._core import Number
from jaxquad.identify import CurveFirmware
from jaxquad.records import AXES
from jaxquad.records.firmware import firmware_names, FirmwareLog, register_log

from ._filters import Butterworth, Filter, FilterChain
from ._law import FlownLoop


Stage = Literal["gyro", "derivative"]
Values = Sequence[tuple["Parameter", float, float]]  # parameter, the value to set, what flew
Words = Sequence[tuple[str, str, str]]  # name, the word to set, what flew
Span = tuple[float | None, float | None]  # s; None: from the beginning, to the end
HOVER = 0.3  # of the throttle, where a log does not hold it


class Parameter(NamedTuple):
    """A parameter of a firmware, as its documentation has it."""

    name: str
    unit: str
    default: float
    low: float  # of the documented range; an infinity where none is documented
    high: float
    integer: bool = False  # whether the firmware stores a whole number; else single precision
    # Of the law that it sets: "angle.p" is a field of the angle loop, "gyro" the cutoff of the only
    # Butterworth low-pass of the gyro, "derivative_hz" that of the D term's.
    field: str = ""
    axis: int = -1  # of that field; -1 for all

    @property
    def range_text(self) -> str:
        """The documented range."""
        if not np.isfinite(self.low):
            return "none documented"
        above = f"{self.low:g} or above"
        return f"{self.low:g} to {self.high:g}" if np.isfinite(self.high) else above


Range = tuple[Number, Number]


def rows_of_axes(
    names: Sequence[str], unit: str, defaults: Sequence[Number], ranges: tuple[Range, ...] | Range,
    field: str, *, integer: bool = False,
) -> list[Parameter]:  # fmt: skip
    """A parameter of roll, pitch and yaw, with one range or with three."""
    one: Any = ranges
    bounds: Any = one if isinstance(one[0], tuple) else [one] * 3
    return [
        Parameter(name, unit, default, bound[0], bound[1], integer, field, axis)
        for axis, (name, default, bound) in enumerate(zip(names, defaults, bounds, strict=True))
    ]  # fmt: skip


class FilterOption(NamedTuple):
    """A filter as the firmware can store it; None is off."""

    parameters: Mapping[str, float]
    filter: Filter | None


class FilterChoice(NamedTuple):
    """The options of one filter of a loop."""

    stage: Stage  # the gyro, and so all terms, or the derivative alone
    shared: bool  # whether it acts on all axes
    rate_hz: float  # at which it runs
    options: tuple[FilterOption, ...]  # in the order of their cutoffs
    flown: int  # which of them flew

    @property
    def flown_parameters(self) -> Mapping[str, float]:
        """What flew."""
        return self.options[self.flown].parameters


class LowPass(NamedTuple):
    """A low-pass that is on: the parameters that scale its cutoff, and where it acts."""

    stage: Stage
    parameters: Mapping[str, float]
    filter: Filter
    rate_hz: float
    shared: bool = True


@dataclasses.dataclass(frozen=True)
class OuterLoop:
    """The gain of an axis' angle loop, and how late it acts."""

    name: str  # of the parameter
    value: float  # as the firmware stores it
    unit: float  # of it, in 1/s
    late: float  # s from the angle to the rate's set-point
    closed: bool  # whether it was closed in the flight
    smooth: FilterChain = FilterChain()  # filters of the rate's set-point

    def path(self, omega: Float[np.ndarray, " frequencies"]) -> Complex[np.ndarray, " frequencies"]:
        """From the rate to minus the set-point, per 1/s of gain."""
        smooth = np.asarray(self.smooth.response(omega / (2 * np.pi)))
        return smooth * np.exp(-1j * omega * self.late) / (1j * omega)

    @classmethod
    def of(
        cls, values: Mapping[str, str], name: str, unit: float, late: float, *, closed: bool,
        smooth: FilterChain | None = None,
    ) -> "OuterLoop | None":  # fmt: skip
        """Of a parameter among the `values` of a log; None where it is missing or 0."""
        value = float(values.get(name, 0.0))
        return cls(name, value, unit, late, closed, smooth or FilterChain()) if value > 0 else None


class Channels(NamedTuple):
    """Names of channels of an axis; a mix is a weighted sum of some. Empty: not logged."""

    unfiltered: Sequence[str] = ()  # the gyro before its filters, of roll, pitch and yaw
    terms: Sequence[str] = ()  # P, I, D and F of the command
    motors: Sequence[str] = ()  # their commands
    motor_ends: tuple[float, float] = (0.0, 1.0)  # the lowest and the highest of these
    output: Mapping[str, float] = {}  # the sum of the terms
    output_limit: float = np.inf  # of that, before the mixer
    stick: Mapping[str, float] = {}  # the throttle that filters and TPA follow
    stick_ends: tuple[float, float] = (0.0, 1.0)  # of that
    mixed: Mapping[str, float] = {}  # what the motors made of the output
    slewed: Mapping[str, float] = {}  # the share that a slew limiter leaves of P and D
    # Patterns of channels, in turns per minute, that notches of a mode follow.
    tracked: Mapping[int, str] = {}
    resolution: tuple[float, float] = (0.0, 0.0)  # steps of rates (rad/s) and terms; 0 is none


# Of all recipes.
_DEFAULTS = "The lines to go back set the firmware's defaults: what you saved holds your own."
_HOVER = "Hover 10 m high or more over open ground, away from people, in little wind"
_OTHER_THROTTLES = (
    "For gains that hold over the throttle, fly it again with 0.1 of throttle less and more, in "
    "turns of about 8 s, as the vehicle sinks or climbs."
)


_ENDINGS = (".param", ".params")  # of files that ground stations load


class RecipeSteps(NamedTuple):
    """What a pilot does, in sentences."""

    before: str
    flight: str
    abort: str
    after: str


@dataclasses.dataclass(frozen=True)
class Recipe:
    """What to set and to fly, so that `jaxquad autopilot` can tune from the log.

    **Arguments:**

    - `firmware`: its name; `axes`: which of roll, pitch and yaw are excited.
    - `paste`: the text to paste; `back`: that of the settings afterwards, the firmware's defaults.
    - `load`: both, as files that the firmware's ground station loads, whose names end in `suffix`.
    - `steps`: what to do before, in flight, to abort, and after.
    - `command`: what to run with the log.
    """

    firmware: str
    axes: tuple[str, ...]
    paste: str
    back: str
    load: tuple[str, str]
    suffix: str
    steps: RecipeSteps
    command: str

    def files(self, path: str | Path) -> dict[Path, str]:
        """What to write: to `path` what to set, and to another one with `_back` what goes back.

        A path that ends in `suffix` gets a file to load, another one the text to paste.

        **Raises:** `ValueError`: the path has the ending of another firmware's files.
        """
        path = Path(path)
        ending = path.suffix.lower()
        if ending in _ENDINGS and ending != f".{self.suffix}":
            raise ValueError(
                f"{path.name} has the ending of another firmware: what {self.firmware} loads ends "
                f"in .{self.suffix}, so name it {path.with_suffix(f'.{self.suffix}').name}."
            )
        texts = self.load if ending == f".{self.suffix}" else (self.paste, self.back)
        paths = path, path.with_name(f"{path.stem}_back{path.suffix}")
        return dict(zip(paths, texts, strict=True))

    def content(self) -> dict[str, object]:
        """All of it for JSON."""
        return {**vars(self), "steps": self.steps._asdict()}

    def __str__(self) -> str:
        text = lambda words: textwrap.fill(words, 78, break_on_hyphens=False)
        lines = lambda words: textwrap.indent(words.rstrip(), "  ")
        parts = {
            "Before": text(self.steps.before), "Paste": lines(self.paste),
            "In flight": text(self.steps.flight), "Abort": text(self.steps.abort),
            "After": text(self.steps.after), "Paste to go back": lines(self.back),
            "Then": lines(self.command),
        }  # fmt: skip
        head = f"{self.firmware}: what to fly for the gains of {', '.join(self.axes)}"
        return "\n\n".join([head, *(f"{title}:\n{part}" for title, part in parts.items())])


class RecipeOption(NamedTuple):
    """A number of a recipe that a pilot may choose."""

    name: str
    usual: Number
    low: Number
    high: Number
    meaning: str

    def choose(self, value: Number | None) -> float:
        """The value, or the usual one for None. Raises ValueError where it is out of range."""
        value = self.usual if value is None else value
        if not self.low <= value <= self.high:
            raise ValueError(
                f"`{self.name}` is {value:g}, {self.meaning}: give {self.low:g} to {self.high:g}, "
                f"or leave it out for {self.usual:g}."
            )
        return float(value)


class Firmware(abc.ABC):
    """A firmware: what flies, its parameters and files, and what its logs hold.

    Subclasses have `log`, `parameters` and the methods that are abstract; all others have defaults
    for what a firmware does not have. `register` makes one known.
    """

    log: FirmwareLog  # what its logs mean; its `name` is that of the firmware
    parameters: Mapping[str, Parameter]  # by name
    fields: tuple[str, str, str] = ("p", "i", "d")  # of the rate law, which are tuned
    unit: str = "command"  # of the law's command
    suffix: str = "param"  # of parameter files
    file_head: tuple[str, ...] = ()  # comments that begin them
    # Relative thrust of a motor of a quad X per unit of output, of three axes.
    motor_shares: tuple[float, float, float] = (1.0, 1.0, 1.0)
    follows_throttle: bool = False  # whether the law changes with the throttle
    averages_gyro: bool = False  # whether the unfiltered rate is the mean over its sample
    thrust_curve: str = ""  # the parameter that inverts the curve of thrust
    keeps_throttle: bool = False  # whether for the axes alone: motors get the throttle itself
    weighs_setpoint: bool = False  # whether feed-forward of the set-point can stand for its weight
    notches: tuple[tuple[str, str], ...] = ()  # static ones: the parameters of centre and width
    words: bool = False  # whether some of its parameters are words
    has_adrc: bool = False  # whether it can fly Betaflight's proposed ADRC
    no_ladrc: str = "it has no disturbance observer"  # why it cannot run a LADRC of the angle

    @abc.abstractmethod
    def flown_loop(
        self, values: Mapping[str, str], version: Sequence[int], *, throttle: float,
        tracked_hz: Mapping[int, Sequence[float]],
    ) -> FlownLoop:  # fmt: skip
        """The rate loop of a log's parameters. Raises ValueError where a gain is missing."""

    @abc.abstractmethod
    def channels(self, prefix: str, axis: int, values: Mapping[str, str]) -> Channels:
        """Of a log with these parameters whose channels begin with `prefix`."""

    # What to fly

    def recipe(
        self, axes: Sequence[str], *, amplitude: Number | None = None, switch: int | None = None
    ) -> Recipe | None:
        """What to set and fly to excite the axes; None where there is none.

        `amplitude` is that of the excitation in the firmware's unit, `switch` what starts it; None
        are usual ones. Raises ValueError for those that are not flyable.
        """
        return None

    def make_recipe(
        self, axes: Sequence[str], paste: Sequence[str], back: Sequence[str], *, before: str,
        flight: str, abort: str, after: str, log: str,
        load: tuple[Mapping[str, Number | str], Mapping[str, Number | str]] | None = None,
    ) -> Recipe:  # fmt: skip
        """Of lines, sentences (`flight` begins with the mode), and the name of a log.

        `load` are the parameters of both texts, where a ground station loads them as files.
        """
        steps = RecipeSteps(
            f"{before} {_DEFAULTS}", f"{_HOVER}, {flight}", abort, f"{after} {_OTHER_THROTTLES}"
        )
        command = f"jaxquad autopilot {log}" + (f" --axis {axes[0]}" if len(axes) == 1 else "")
        texts = joined_lines(paste), joined_lines(back)
        files = texts if load is None else (
            self._recipe_file(f"what to set, to excite {', '.join(axes)}", load[0]),
            self._recipe_file("the firmware's defaults, to go back", load[1]),
        )  # fmt: skip
        return Recipe(self.log.name, tuple(axes), *texts, files, self.suffix, steps, command)

    def _recipe_file(self, title: str, values: Mapping[str, Number | str]) -> str:
        line = lambda name, value: self.file_line(name, str(value), isinstance(value, int))
        rows = [line(name, value) for name, value in values.items()]
        return joined_lines([f"# {title}", *self.file_head, *rows])

    def what_to_fly(self, axis: str) -> str:
        """A flight that excites the axis: that of the recipe, and how to get all of it."""
        recipe = self.recipe([axis])
        if recipe is None:
            return f"Fly this: strong and quick {axis} stick for 20 s"
        flight = recipe.steps.flight[0].lower() + recipe.steps.flight[1:]
        command = f"jaxquad recipe {self.log.name} --axis {axis}"
        return f"Fly this: {flight} What to set before, and how to abort, says {command}"

    # What a log holds beside its channels

    def unfiltered_gyro(
        self, names: frozenset[str], values: Mapping[str, str], median: Callable[[str], float]
    ) -> Sequence[str]:
        """The gyro before its filters that flew, where `channels` cannot know it.

        `names` are all logged ones, `median` gives that of a channel, 0 where it is not logged.
        """
        return []

    def with_hold(self, values: Mapping[str, str], hold: float | None) -> Mapping[str, str]:
        """The parameters with the loop's interval in s that the log's stamps show."""
        return values

    # The law

    def angle_loop(
        self, values: Mapping[str, str], axis: int, dt: float, *, levelled: bool
    ) -> OuterLoop | None:
        """The angle loop around a rate loop of interval `dt` in s; None where there is none.

        `levelled` is whether it is known to have been closed, where that may change in flight.
        """
        return None

    def low_passes(
        self, loop: FlownLoop, values: Mapping[str, str], version: Sequence[int], axis: int,
        throttle: float,
    ) -> Iterator[LowPass]:  # fmt: skip
        """Those of gyro and D term that are on, whose cutoffs may change.

        By default those with parameters of the fields "gyro" and "derivative_hz".
        """
        law, rows = loop.law, self.parameters.values()
        for row in (row for row in rows if row.field == "gyro"):
            for x in (x for x in law.gyro.filters if isinstance(x, Butterworth)):
                yield LowPass("gyro", {row.name: float(x.cutoff_hz)}, x, law.gyro.rate_hz)
        for row in (row for row in rows if row.field == "derivative_hz" and row.axis in (-1, axis)):
            chain, shared = law.derivative_chain(axis), row.axis < 0
            d = np.broadcast_to(law.d, (3,))[slice(None) if shared else axis]
            for x in chain.filters if np.any(d > 0) else ():
                yield LowPass("derivative", {row.name: cutoff_of(x)}, x, chain.rate_hz, shared)

    def notch(self, centre_hz: float, half_width: float) -> tuple[float, Filter]:
        """A static notch whose half width is this share of its centre, and its second parameter."""
        raise NotImplementedError

    def flown_notches(self, values: Mapping[str, str]) -> list[tuple[float, float]]:
        """The parameters of the `notches` that a log holds, in their order."""
        number, usual = Numbers(values).number, self.parameters
        return [(number(a, 0.0), number(b, float(usual[b].default))) for a, b in self.notches]

    def notch_rate_hz(self, loop: FlownLoop) -> float:
        """At which static notches run."""
        return loop.law.gyro.rate_hz

    def change_filters(
        self, values: Mapping[str, str], parameters: Mapping[str, Number]
    ) -> dict[str, str]:
        """The values of a log with other filters. Raises ValueError where one has no place."""
        return {**values, **{name: repr(float(x)) for name, x in parameters.items()}}

    def curve_kind(self, version: Sequence[int]) -> CurveFirmware:
        """What `jq.identify` calls the family of the `thrust_curve`."""
        return cast(CurveFirmware, self.log.name)

    def flies_adrc(self, values: Mapping[str, str]) -> bool:
        """Whether the log is of a flight with Betaflight's proposed ADRC."""
        return False

    # Gains in SI units, and files

    def si_scales(self, axis: str) -> tuple[float, float, float]:
        """P, I and D parameters per gain in SI units over the torque of a unit of output."""
        return 1.0, 1.0, 1.0

    def angle_parameters(self, axis: str, p: float) -> dict[str, float]:
        """The angle loop's parameters for a gain in 1/s, by default of the field "angle.p"."""
        for row in self.parameters.values():
            if row.field == "angle.p" and AXES[row.axis] == axis:
                return {row.name: p}
        raise ValueError(f"{self.log.title} has no angle loop here.")

    def parameter_file(
        self, values: Values, title: str, *, version: tuple[int, ...], profile: int | None,
        raised: Sequence[str], words: Words,
    ) -> str:  # fmt: skip
        """The text to load, see `jq.autopilot.parameter_file`; by default of `file_line`s."""
        rows = [f"# {title}", *self.file_head] if title else list(self.file_head)
        for row, value, flown in values:
            rows.append(f"# the flight had {row.name} {number_text(flown, row.integer)}")
            rows.append(self.file_line(row.name, number_text(value, row.integer), row.integer))
        return joined_lines(rows)

    def file_line(self, name: str, text: str, is_whole: bool) -> str:
        """What sets a parameter in a file, by default `NAME,value`."""
        return f"{name},{text}"


def number_text(value: Number, is_whole: bool) -> str:
    """The shortest text that single precision reads back exactly."""
    if is_whole:
        return str(int(value))
    return np.format_float_positional(np.float32(value), trim="-")


def joined_lines(rows: Sequence[str]) -> str:
    return "\n".join([*rows, ""])


def cutoff_of(low_pass: Filter) -> float:
    """In Hz, of a low-pass of one axis or of the first one."""
    return float(np.ravel(vars(low_pass)["cutoff_hz"])[0])


_FIRMWARES: dict[str, Firmware] = {}


def register(firmware: Firmware) -> None:
    """Make a firmware known: to `jq.read` and `jq.propose`, and to `jq.workflows.autopilot`.

    One of the same name is replaced.
    """
    register_log(firmware.log)
    _FIRMWARES[firmware.log.name] = firmware


def firmware_named(name: str) -> Firmware:
    """The firmware of this name, as the `vehicle` of a log. Raises ValueError for another one."""
    if name not in _FIRMWARES:
        if name not in firmware_names():
            raise ValueError(f"firmware is {name!r}: give one of {', '.join(firmware_names())}.")
        _FIRMWARES[name] = importlib.import_module(f"{__package__}.firmwares._{name}").FIRMWARE
    return _FIRMWARES[name]


class Numbers:
    """Numbers by the names of parameters, for `Firmware.flown_loop`."""

    def __init__(self, values: Mapping[str, str]):
        self.values = values

    def number(self, name: str, default: float | None = None) -> float:
        """Raises ValueError where it is missing and has no default."""
        if name in self.values:
            return float(self.values[name])
        if default is None:
            raise ValueError(
                f"the log has no parameter {name}: log the parameters of the autopilot."
            )
        return default
