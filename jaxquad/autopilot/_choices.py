"""The filters of a flown loop that a proposal may change: what the firmware can store of each."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from typing import Literal, NamedTuple

import numpy as np

from jaxquad._core import Number

from ._filters import BandwidthNotch, betaflight_quality, Butterworth, Filter, Notch, PT1
from ._flown import (
    ardupilot_loop,
    betaflight_loop,
    betaflight_low_passes,
    FlownBetaflight,
    FlownLoop,
    px4_loop,
)
from ._parameters import find_parameter, Firmware, store_parameters


Stage = Literal["gyro", "derivative"]
_STEPS = 8  # of a cutoff, to either side of the one that flew
_HIGHEST = 0.45  # of the rate at which a filter runs
_WIDTHS = (0.1, 0.2)  # half of a notch, of its centre


class FilterOption(NamedTuple):
    """A filter as the firmware can store it; None is off."""

    parameters: Mapping[str, float]
    filter: Filter | None


class FilterChoice(NamedTuple):
    """The options of one filter of a loop.

    **Arguments:**

    - `stage`: whether it acts on the gyro, and so on all terms, or on the derivative alone.
    - `shared`: whether it acts on all axes.
    - `rate_hz`: at which it runs.
    - `options`: in the order of their cutoffs.
    - `flown`: which of them flew.
    """

    stage: Stage
    shared: bool
    rate_hz: float
    options: tuple[FilterOption, ...]
    flown: int

    @property
    def names(self) -> tuple[str, ...]:
        """Of its parameters."""
        return tuple(self.options[self.flown].parameters)


def flown_loop(
    firmware: Firmware,
    values: Mapping[str, str],
    version: Sequence[int] = (),
    *,
    throttle: float = 0.3,
    tracked_hz: Mapping[int, Sequence[float]] | None = None,
) -> FlownLoop:
    """The rate loop of the parameters of a log.

    **Arguments:**

    - `firmware`: "betaflight", "px4" or "ardupilot".
    - `values`, `version`: as `jq.records.read_settings` returns them.
    - `throttle`: 0 to 1, at which Betaflight's dynamic cutoffs and ArduPilot's notches are.
    - `tracked_hz`: as in `ardupilot_loop`.

    **Raises:**

    - `ValueError`: a gain is missing.
    """
    if firmware == "betaflight":
        return betaflight_loop(values, version, throttle=throttle)
    if firmware == "px4":
        return px4_loop(values)
    return ardupilot_loop(values, throttle=throttle, tracked_hz=tracked_hz)


def filter_choices(
    firmware: Firmware,
    values: Mapping[str, str],
    version: Sequence[int] = (),
    *,
    axis: int = 0,
    throttle: float = 0.3,
    change: float = 3.0,
    line_hz: float | None = None,
) -> tuple[FilterChoice, ...]:
    """The low-passes of gyro and D term that are on, and a notch at a line of the gyro's noise.

    Their kinds stay. A dynamic low-pass is moved as a whole, its lowest and its highest cutoff by
    one factor. A notch is offered where one of the firmware's static notches is off.

    **Arguments:**

    - `firmware`, `values`, `version`, `throttle`: as in `flown_loop`.
    - `axis`: 0, 1 or 2 for roll, pitch or yaw, whose own filters are offered.
    - `change`: factor by which a cutoff may rise or fall, within its documented range.
    - `line_hz`: of the line; None offers no notch.
    """
    loop = flown_loop(firmware, values, version, throttle=throttle)
    chains = {
        "betaflight": _betaflight_choices, "px4": _px4_choices, "ardupilot": _ardupilot_choices,
    }  # fmt: skip
    held = _Held(firmware, values, tuple(version), change)
    found = [*chains[firmware](held, loop, axis, throttle)]
    if line_hz is not None and (notch := _notch_choice(held, loop, line_hz)) is not None:
        found.append(notch)
    return tuple(each for each in found if len(each.options) > 1)


class _Held(NamedTuple):
    firmware: Firmware
    values: Mapping[str, str]
    version: tuple[int, ...]
    change: float

    def low_pass(
        self, stage: Stage, flown: Mapping[str, float], now: PT1 | Butterworth | Filter,
        rate_hz: float, *, shared: bool = True,
    ) -> FilterChoice:  # fmt: skip
        """The options of a low-pass whose parameters scale its cutoff."""
        cutoff = float(np.ravel(vars(now)["cutoff_hz"])[0])
        reach = np.linspace(0.0, np.log(self.change), _STEPS + 1)[1:]
        factors = [*np.exp(-reach[::-1]), 1.0, *np.exp(reach)]
        options: dict[tuple[float, ...], FilterOption] = {}
        for factor in factors:
            wanted = {name: factor * value for name, value in flown.items()}
            stored = flown if factor == 1 else self._stored(wanted)
            scale = sum(stored.values()) / sum(flown.values())
            inside = all(self._allows(name, value) for name, value in stored.items())
            if factor == 1 or (inside and scale * cutoff < _HIGHEST * rate_hz):
                other = now if factor == 1 else _with_cutoff(now, scale * cutoff)
                options[tuple(stored.values())] = FilterOption(dict(stored), other)
        ordered = tuple(options.values())
        at = [*options].index(tuple(flown.values()))
        return FilterChoice(stage, shared, rate_hz, ordered, at)

    def _stored(self, wanted: Mapping[str, float]) -> dict[str, float]:
        """Whole numbers, or three digits in single precision."""
        return store_parameters(self.firmware, {k: float(f"{x:.3g}") for k, x in wanted.items()})

    def _allows(self, name: str, value: Number) -> bool:
        row = find_parameter(self.firmware, name)
        return max(row.low, 1.0) <= value <= row.high


def _with_cutoff(now: Filter, cutoff_hz: float) -> Filter:
    assert dataclasses.is_dataclass(now) and not isinstance(now, type)
    changed = dataclasses.replace(now, **{"cutoff_hz": cutoff_hz})
    assert isinstance(changed, Filter)
    return changed


def _betaflight_choices(
    held: _Held, loop: FlownLoop, axis: int, throttle: float
) -> Iterator[FilterChoice]:
    for each in betaflight_low_passes(held.values, held.version, throttle=throttle):
        yield held.low_pass(each.stage, each.parameters, each.filter, each.rate_hz)


def _px4_choices(
    held: _Held, loop: FlownLoop, axis: int, throttle: float
) -> Iterator[FilterChoice]:
    rate = loop.law.gyro.rate_hz
    for each in loop.law.gyro.filters:
        if isinstance(each, Butterworth):
            cutoff = float(each.cutoff_hz)
            yield held.low_pass("gyro", {"IMU_GYRO_CUTOFF": cutoff}, each, rate)
    slope = float(loop.law.derivative_hz)
    if slope > 0 and np.any(np.asarray(loop.law.d) > 0):
        yield held.low_pass("derivative", {"IMU_DGYRO_CUTOFF": slope}, PT1(slope), rate)


def _ardupilot_choices(
    held: _Held, loop: FlownLoop, axis: int, throttle: float
) -> Iterator[FilterChoice]:
    rate, name = loop.law.gyro.rate_hz, ("RLL", "PIT", "YAW")[axis]
    for each in loop.law.gyro.filters:
        if isinstance(each, Butterworth):
            cutoff = float(each.cutoff_hz)
            yield held.low_pass("gyro", {"INS_GYRO_FILTER": cutoff}, each, rate)
    wide = lambda x: float(np.broadcast_to(x, (3,))[axis])
    slope = wide(loop.law.derivative_hz)
    if slope > 0 and wide(loop.law.d) > 0:
        flown = {f"ATC_RAT_{name}_FLTD": slope}
        yield held.low_pass("derivative", flown, PT1(slope), 1 / loop.law.dt, shared=False)


def _notch_choice(held: _Held, loop: FlownLoop, line_hz: float) -> FilterChoice | None:
    """A static notch of the firmware that is off, on the line: narrow or wide."""
    line = float(np.rint(line_hz))
    if isinstance(loop, FlownBetaflight):
        centres = [float(x) for x in held.values.get("gyro_notch_hz", "").split(",") if x]
        lows = [float(x) for x in held.values.get("gyro_notch_cutoff", "").split(",") if x]
        free = [k for k, x in enumerate(centres[:2]) if x == 0 and k < len(lows)]
        rate = 1 / loop.law.dt
        if not free or line >= _HIGHEST * rate:
            return None
        names = f"gyro_notch{free[0] + 1}_hz", f"gyro_notch{free[0] + 1}_cutoff"
        off = FilterOption(dict(zip(names, (0.0, lows[free[0]]), strict=True)), None)
        kinds = []
        for width in _WIDTHS:
            low = float(np.rint((1 - width) * line))
            notch = Notch(line, betaflight_quality(line, low))
            kinds.append(FilterOption(dict(zip(names, (line, low), strict=True)), notch))
        return FilterChoice("gyro", True, rate, (off, *kinds), 0)
    rate = loop.law.gyro.rate_hz
    if held.firmware != "px4" or line >= _HIGHEST * rate:
        return None
    number = lambda name: float(held.values.get(name, 0.0))
    free = [k for k in (0, 1) if number(f"IMU_GYRO_NF{k}_FRQ") == 0]
    if not free:
        return None
    names = f"IMU_GYRO_NF{free[0]}_FRQ", f"IMU_GYRO_NF{free[0]}_BW"
    width = float(held.values.get(names[1], 20.0))
    off = FilterOption(dict(zip(names, (0.0, width), strict=True)), None)
    kinds = [
        FilterOption(
            dict(zip(names, (line, float(np.rint(2 * w * line))), strict=True)),
            BandwidthNotch(line, float(np.rint(2 * w * line))),
        )
        for w in _WIDTHS
    ]
    return FilterChoice("gyro", True, rate, (off, *kinds), 0)


_LINES = {
    "gyro_lpf1_static_hz": (("gyro_lpf1_static_hz", "gyro_lowpass_hz"), 0),
    "gyro_lpf1_dyn_min_hz": (("gyro_lpf1_dyn_hz", "gyro_lowpass_dyn_hz"), 0),
    "gyro_lpf1_dyn_max_hz": (("gyro_lpf1_dyn_hz", "gyro_lowpass_dyn_hz"), 1),
    "gyro_lpf2_static_hz": (("gyro_lpf2_static_hz", "gyro_lowpass2_hz"), 0),
    "dterm_lpf1_static_hz": (("dterm_lpf1_static_hz", "dterm_lowpass_hz"), 0),
    "dterm_lpf1_dyn_min_hz": (("dterm_lpf1_dyn_hz", "dterm_lowpass_dyn_hz"), 0),
    "dterm_lpf1_dyn_max_hz": (("dterm_lpf1_dyn_hz", "dterm_lowpass_dyn_hz"), 1),
    "dterm_lpf2_static_hz": (("dterm_lpf2_static_hz", "dterm_lowpass2_hz"), 0),
    "gyro_notch1_hz": (("gyro_notch_hz",), 0),
    "gyro_notch1_cutoff": (("gyro_notch_cutoff",), 0),
    "gyro_notch2_hz": (("gyro_notch_hz",), 1),
    "gyro_notch2_cutoff": (("gyro_notch_cutoff",), 1),
}


def change_filters(
    firmware: Firmware, values: Mapping[str, str], parameters: Mapping[str, Number]
) -> dict[str, str]:
    """The values of a log as they would be with other filters.

    **Arguments:**

    - `firmware`, `values`: as in `flown_loop`.
    - `parameters`: new cutoffs and notches by their names in `PARAMETERS`.

    **Raises:**

    - `ValueError`: Betaflight's header has no line for one of them.
    """
    changed = dict(values)
    if firmware != "betaflight":
        return changed | {name: repr(float(value)) for name, value in parameters.items()}
    for name, value in parameters.items():
        lines, place = _LINES.get(name, ((), 0))
        line = next((each for each in lines if each in changed), None)
        if line is None:
            raise ValueError(f"the header has no line for {name}, so it cannot be changed.")
        parts = changed[line].split(",")
        parts[place] = f"{value:g}"
        changed[line] = ",".join(parts)
    return changed
