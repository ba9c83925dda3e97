"""The channels of an axis that a log proposes, and the flights of a file: one for each arming."""

import dataclasses
from pathlib import Path

import numpy as np

from jaxquad._core import marked_text

from .._errors import printable, RecordError
from .._firmwares import firmware_log, firmware_names
from .._log import Log
from ..formats import load_log
from ._firmware_log import Flight, one_flight
from ._flown_span import in_flight
from ._proposal import complete, Proposal
from ._setup import AXES, Selection


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
    return list(_flights_of(load_log(path)))


def _flights_of(log: Log) -> tuple[Flight, ...]:
    """Those that have enough samples for a record."""
    firmware = firmware_log(log.vehicle)
    return one_flight(log) if firmware is None else firmware.flights(log)


def propose(
    path: str | Path,
    *,
    axis: str | None = None,
    chirp: int | None = None,
    flight: int | None = None,
    start: float | int | None = None,
    stop: float | int | None = None,
) -> Proposal:
    """Propose which channels of an autopilot's log are command, rate and external reference.

    Injected excitation is found, with its time and band: ArduPilot's SystemID mode, PX4's
    autotune, Betaflight's chirp mode. A set-point that an outer loop computes contains feedback,
    and is never proposed as the external reference. Without injected excitation the proposal is of
    the time in flight: what comes before take-off and after landing or a crash is left out.

    **Arguments:**

    - `path`: a log of ArduPilot, PX4, Betaflight or Crazyflie.
    - `axis`: `"roll"`, `"pitch"` or `"yaw"`; by default that of the longest injected excitation,
        else the one that moves most.
    - `chirp`: the number, from 1, of one of the chirps that the proposal of an ArduPilot log lists;
        by default the longest one, with all others on its axis at its place.
    - `flight`: the number of the flight in a file with several, as `flights` lists them; by default
        the longest with a chirp, else the longest with sticks that move, else the longest.
    - `start`, `stop`: in s, instead of what the log says: the ends of the injected excitation, or
        take-off and landing; only ArduPilot's chirps between them are taken.

    **Returns:** a `Proposal`, which prints its reasons and the command line.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    - `RecordError`: where the log lacks the channels of the axis, or the chirp.
    """
    if axis is not None and axis not in AXES:
        raise RecordError(f"axis is {axis!r}: use one of {', '.join(AXES)}.")
    log = load_log(path)
    firmware = firmware_log(log.vehicle)
    if firmware is None:
        names = ", ".join(firmware_names())
        raise RecordError(
            f"{path}: not a log of a known autopilot ({names}), so the meaning of its channels is "
            "unknown. jaxquad identify takes it all the same: list them (jaxquad channels"
            "«, jq.records.channels») and «name inputs, outputs and references yourself»."
        )
    if chirp is not None and not firmware.numbers_chirps:
        raise RecordError(
            f"{path}: the chirps of {log.vehicle} have no numbers: leave `chirp` out, and give the "
            "time (`start`, `stop`) of the one to use."
        )
    try:
        low, high = (None if end is None else float(end) for end in (start, stop))
        wanted = Selection(axis, chirp, low, high)
        log, choice = _choose_flight(log, axis, flight)
        setup = in_flight(log, firmware.setup(log, wanted), low, high)
        setup = setup._replace(remarks=(*choice, *setup.remarks))
        proposal = complete(str(path), log, firmware, setup)
        setup = proposal.setup
        used = [
            (-np.inf if start is None else start, np.inf if stop is None else stop)
            for start, stop in setup.segments or ((setup.start, setup.stop),)
        ]
        further = firmware.remarks_on(log, setup, used)
        return proposal._replace(setup=setup._replace(remarks=(*setup.remarks, *further)))
    except RecordError as error:
        raise RecordError(f"{path}: {marked_text(error)}") from error
    # A log may call anything by the names that its vehicle uses.
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise RecordError(
            f"{path}: the channels are not those that {log.vehicle} logs "
            f"({type(error).__name__}: {printable(str(error))}). Name inputs, outputs and "
            f"references yourself."
        ) from error


def _choose_flight(log: Log, axis: str | None, number: int | None) -> tuple[Log, tuple[str, ...]]:
    """The log of one flight, and a remark on the choice where the file holds several.

    By default the longest with a chirp, without one the longest with sticks that move, else the
    longest. Channels keep their names in the file; settings have the names of a single log. Raises
    RecordError for a number that the file does not have.
    """
    every = _flights_of(log)
    if not every and number is None:
        return log, ()
    if number is None:
        chosen = max(every, key=lambda flight: (flight.rank(axis), flight.duration))
    else:
        chosen = next((flight for flight in every if flight.number == number), None)
    if chosen is None:
        listed = "; ".join(map(str, every)) or "none"
        raise RecordError(
            f"flight is {number}, but the file holds: {listed}. Choose one («flight=»)."
        )
    if not (name := chosen.log):
        return log, ()
    on = f" on {axis}" if axis else ""
    kinds = (f", as none is excited{on}", f" with sticks that move{on}", f" with a chirp{on}")
    reason = "" if number is not None else f", the longest{kinds[chosen.rank(axis)]}"
    others = "; ".join(str(flight) for flight in every if flight is not chosen)
    remark = f"{chosen} is used{reason}; others of this file (--flight N): {others or 'none'}"
    tables = {k: t for k, t in log.tables.items() if k == name or k.startswith(f"{name}.")}
    settings = {
        key.removeprefix(f"{name} "): text
        for key, text in log.settings.items()
        if key.startswith(f"{name} ")
    }
    return dataclasses.replace(log, tables=tables, settings=settings), (remark,)
