"""The flights of a file: a flash chip holds one log for each arming."""

import dataclasses
from pathlib import Path

from .._errors import RecordError
from .._firmwares import firmware_log
from .._log import Log
from ..formats import load_log
from ._firmware_log import Flight, one_flight


def flights(path: str | Path) -> list[Flight]:
    """List the flights that a file holds.

    A Betaflight file from a flash chip holds one for each arming. Logs of other vehicles count as
    one flight.

    **Arguments:**

    - `path`: a log of an autopilot.

    **Returns:** a `Flight` for each, in the order of the file.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    """
    return list(flights_of(load_log(path)))


def flights_of(log: Log) -> tuple[Flight, ...]:
    """Those that have enough samples for a record."""
    firmware = firmware_log(log.vehicle)
    return one_flight(log) if firmware is None else firmware.flights(log)


def choose_flight(log: Log, axis: str | None, number: int | None) -> tuple[Log, tuple[str, ...]]:
    """The log of one flight, and a remark on the choice where the file holds several.

    By default the longest with a chirp, without one the longest with sticks that move, else the
    longest. Channels keep their names in the file; settings have the names of a single log. Raises
    RecordError for a number that the file does not have.
    """
    every = flights_of(log)
    if not every and number is None:
        return log, ()
    if number is None:
        chosen = max(every, key=lambda flight: (flight.rank(axis), flight.duration))
    else:
        chosen = next((each for each in every if each.number == number), None)
    if chosen is None:
        listed = "; ".join(map(str, every)) or "none"
        raise RecordError(
            f"flight is {number}, but the file holds: {listed}. Choose one («flight=»)."
        )
    if not chosen.log:
        return log, ()
    others = "; ".join(str(each) for each in every if each is not chosen)
    reason = "" if number is not None else f", {_reason(chosen, axis)}"
    remark = f"{chosen} is used{reason}; others of this file (--flight N): {others or 'none'}"
    return _log_of(log, chosen.log), (remark,)


def _reason(chosen: Flight, axis: str | None) -> str:
    on = f" on {axis}" if axis else ""
    longest = "the longest"
    kinds = (f"{longest}, as none is excited{on}", f"{longest} with sticks that move{on}")
    return (*kinds, f"{longest} with a chirp{on}")[chosen.rank(axis)]


def _log_of(log: Log, name: str) -> Log:
    """The tables and settings of one log of a file alone."""
    tables = {
        key: table for key, table in log.tables.items() if key == name or key.startswith(f"{name}.")
    }
    settings = {
        key.removeprefix(f"{name} "): text
        for key, text in log.settings.items()
        if key.startswith(f"{name} ")
    }
    return dataclasses.replace(log, tables=tables, settings=settings)
