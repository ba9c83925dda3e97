from pathlib import Path

import numpy as np

from jaxquad._core import marked_text

from .._errors import printable, RecordError
from .._firmwares import firmware_log, firmware_names
from .._log import Log
from ..formats import load_log
from ._firmware_log import FirmwareLog
from ._flights import choose_flight
from ._flown_span import in_flight
from ._proposal import complete, Proposal
from ._setup import AXES, Selection


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
        known = ", ".join(firmware_names())
        raise RecordError(
            f"{path}: not a log of a known autopilot ({known}), so the meaning of its channels is "
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
        return _proposed(str(path), log, firmware, Selection(axis, chirp, low, high), flight)
    except RecordError as error:
        raise RecordError(f"{path}: {marked_text(error)}") from error
    # A log may call anything by the names that its vehicle uses.
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise RecordError(
            f"{path}: the channels are not those that {log.vehicle} logs "
            f"({type(error).__name__}: {printable(str(error))}). Name inputs, outputs and "
            f"references yourself."
        ) from error


def _proposed(
    path: str, log: Log, firmware: FirmwareLog, wanted: Selection, flight: int | None
) -> Proposal:
    log, choice = choose_flight(log, wanted.axis, flight)
    setup = in_flight(log, firmware.setup(log, wanted), wanted.start, wanted.stop)
    proposal = complete(path, log, firmware, setup._replace(remarks=(*choice, *setup.remarks)))
    setup = proposal.setup
    used = [
        (-np.inf if start is None else start, np.inf if stop is None else stop)
        for start, stop in setup.segments or ((setup.start, setup.stop),)
    ]
    further = firmware.remarks_on(log, setup, used)
    return proposal._replace(setup=setup._replace(remarks=(*setup.remarks, *further)))
