"""The loop of a log's parameters, and which of its filters a proposal may change."""

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np

from jaxquad._core import Number

from ._filters import Filter
from ._firmware import cutoff_of, FilterChoice, FilterOption, Firmware, firmware_named, LowPass
from ._law import FlownLoop
from ._parameters import find_parameter, store_parameters


_STEPS = 8  # of a cutoff, to either side of the one that flew
_HIGHEST = 0.45  # of the rate at which a filter runs
_WIDTHS = (0.1, 0.2)  # half of a notch, of its centre


def flown_loop(
    firmware: str,
    values: Mapping[str, str],
    version: Sequence[int] = (),
    *,
    throttle: float = 0.3,
    tracked_hz: Mapping[int, Sequence[float]] | None = None,
) -> FlownLoop:
    """The rate loop of the parameters of a log.

    **Arguments:**

    - `firmware`: "betaflight", "px4", "ardupilot", or one that is registered.
    - `values`, `version`: as `jq.records.read_settings` returns them.
    - `throttle`: 0 to 1, at which Betaflight's dynamic cutoffs and ArduPilot's notches are.
    - `tracked_hz`: as in `ardupilot_loop`.

    **Raises:**

    - `ValueError`: a gain is missing.
    """
    return firmware_named(firmware).flown_loop(
        values, version, throttle=throttle, tracked_hz=tracked_hz or {}
    )


def filter_choices(
    firmware: str,
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
    known = firmware_named(firmware)
    loop = flown_loop(firmware, values, version, throttle=throttle)
    choices = [
        _low_pass_choice(firmware, low_pass, change)
        for low_pass in known.low_passes(loop, values, version, axis, throttle)
    ]
    if line_hz is not None:
        choices += _notch_choices(known, values, known.notch_rate_hz(loop), line_hz)
    return tuple(choice for choice in choices if len(choice.options) > 1)


def _low_pass_choice(firmware: str, low_pass: LowPass, change: float) -> FilterChoice:
    """Cutoffs that the firmware can store: whole numbers, or three digits in single precision."""
    stage, flown, filter, rate_hz, shared = low_pass
    cutoff, reach = cutoff_of(filter), np.linspace(0.0, np.log(change), _STEPS + 1)[1:]
    options: dict[tuple[float, ...], FilterOption] = {}
    for factor in [*np.exp(-reach[::-1]), 1.0, *np.exp(reach)]:
        if factor == 1:
            options[tuple(flown.values())] = FilterOption(dict(flown), filter)
            continue
        wanted = {name: float(f"{factor * value:.3g}") for name, value in flown.items()}
        stored = store_parameters(firmware, wanted)
        scaled = sum(stored.values()) / sum(flown.values()) * cutoff
        rows = [find_parameter(firmware, name) for name in stored]
        inside = all(
            max(row.low, 1.0) <= value <= row.high
            for row, value in zip(rows, stored.values(), strict=True)
        )
        if inside and scaled < _HIGHEST * rate_hz:
            assert dataclasses.is_dataclass(filter) and not isinstance(filter, type)
            moved = dataclasses.replace(filter, **{"cutoff_hz": scaled})
            assert isinstance(moved, Filter)
            options[tuple(stored.values())] = FilterOption(dict(stored), moved)
    at = [*options].index(tuple(flown.values()))
    return FilterChoice(stage, shared, rate_hz, tuple(options.values()), at)


def _notch_choices(
    firmware: Firmware, values: Mapping[str, str], rate_hz: float, line_hz: float
) -> list[FilterChoice]:
    """A static notch that is off, on the line: narrow or wide."""
    line = float(np.rint(line_hz))
    flown = zip(firmware.notches, firmware.flown_notches(values), strict=False)
    free = [(names, second) for names, (centre, second) in flown if centre == 0]
    if not free or line >= _HIGHEST * rate_hz:
        return []
    names, second = free[0]
    options = [FilterOption(dict(zip(names, (0.0, second), strict=True)), None)]
    for half_width in _WIDTHS:
        pair = line, firmware.notch_width(line, half_width)
        options.append(FilterOption(dict(zip(names, pair, strict=True)), firmware.notch(*pair)))
    return [FilterChoice("gyro", True, rate_hz, tuple(options), 0)]


def change_filters(
    firmware: str, values: Mapping[str, str], parameters: Mapping[str, Number]
) -> dict[str, str]:
    """The values of a log as they would be with other filters.

    **Arguments:**

    - `firmware`, `values`: as in `flown_loop`.
    - `parameters`: new cutoffs and notches by their names in `PARAMETERS`.

    **Raises:**

    - `ValueError`: Betaflight's header has no line for one of them.
    """
    return firmware_named(firmware).change_filters(values, parameters)
