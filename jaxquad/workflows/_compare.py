"""Two logs of one vehicle: each read, identified and flown again, then compared."""

import dataclasses
import re
from pathlib import Path

from jaxquad._core import announce, marked_text, Message
from jaxquad.autopilot import (
    check_loop,
    compare_axes,
    firmware_named,
    FlightComparison,
    FlownAxis,
    read_channels_if_any,
    read_flown,
)
from jaxquad.records import AXES, RecordError

from ._autopilot import channels_of
from ._autopilot_settings import AutopilotSettings, CompareSettings
from ._identify import identify_plant
from ._settings import in_options


def compare(
    before: str | Path, after: str | Path, settings: CompareSettings | None = None
) -> FlightComparison:
    """Compare two flights of one vehicle with other gains, as `jaxquad compare` does.

    For each axis that both logs hold: the step from set-point to rate, the peak of |S| and the
    effect of a step of torque, of the plant that each log leaves possible in the law that flew it;
    and the noise of the command in steady hover. Each quantity is better, worse, the same, or the
    logs cannot tell. Source: docs/autopilots.md, "Before and after".

    **Arguments:**

    - `before`, `after`: logs of Betaflight, PX4 or ArduPilot.
    - `settings`: axis, flights and parts of both.

    **Returns:** a `jq.autopilot.FlightComparison`; nothing is written before its `.write(folder)`.

    **Raises:** `RecordError` or `ReadError` (both ValueErrors) for a log that cannot be used, and
    ValueError for logs of different vehicles, or without an axis that both hold.

    !!! example

        ```python
        result = jq.workflows.compare("before.bbl", "after.bbl")
        print(result.kind, result.axes["roll"].verdict)
        result.write("results/before_and_after")
        ```
    """
    settings = settings or CompareSettings()
    taken = lambda flight, part: AutopilotSettings(
        flight=flight, band=settings.band, start=part and part[0], stop=part and part[1]
    )
    logs = {
        "before": (Path(before), taken(settings.flight_before, settings.part_before)),
        "after": (Path(after), taken(settings.flight_after, settings.part_after)),
    }
    axes, errors, firmware = {}, {}, ""
    for axis in AXES if settings.axis == "all" else (settings.axis,):
        try:
            first, second = (_read_axis(*log, axis, place) for place, log in logs.items())
            axes[axis] = compare_axes(axis, first, second)
        except ValueError as error:  # it costs no other axis
            errors[axis] = error
            continue
        name = firmware_named(first.flown.firmware).log.title
        firmware = f"{name} {'.'.join(map(str, first.flown.version))}".strip()
    if not axes:
        raise next(iter(errors.values()))
    unread = {axis: str(in_options(error)) for axis, error in errors.items()}
    return FlightComparison(Path(before), Path(after), firmware, settings, axes, unread)


def _read_axis(path: Path, settings: AutopilotSettings, axis: str, place: str) -> FlownAxis:
    announce(f"{path.name}, {axis}")
    try:
        _, proposal = channels_of(path, settings)
    except RecordError as error:  # it names the setting for one log
        of_this = lambda term: f"«{f'flight_{place}=' if term == 'flight=' else term}»"
        raise RecordError(Message(marked_text(error)).in_words(of_this)) from error
    if settings.flight is None:  # all axes are of the flight that is proposed
        number = re.match(r"log(\d+)\.", proposal.setup.rate)
        settings = dataclasses.replace(settings, flight=int(number[1]) if number else None)
    record, proposal = channels_of(path, dataclasses.replace(settings, axis=axis))
    flown = read_flown(path, proposal, record)
    around = dataclasses.replace(record, segments=(), start=settings.start, stop=settings.stop)
    flight = read_channels_if_any(path, proposal, around, flown.values)
    part = flown.flight
    if part is not None and part.rests:
        return FlownAxis(flown, flight, doubt=f"{part.rest_text} (its set-point rests)")
    plant = identify_plant(path, record, proposal, flown.filters)  # says what cannot be read
    if part is None:
        return FlownAxis(flown, flight, doubt="the log holds no set-point beside the gyro")
    if not plant.fit.identifiable:
        return FlownAxis(flown, flight, plant, doubt=plant.fit.verdict.summary)
    announce("the flown loop again")
    check = check_loop(plant, flown)
    doubt = "" if check.kind == "flown" else check.verdict
    return FlownAxis(flown, flight, plant, check, doubt)
