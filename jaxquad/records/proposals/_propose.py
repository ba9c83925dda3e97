from collections.abc import Callable, Mapping
from pathlib import Path

from .._errors import RecordError
from .._log import Log
from .._names import printable
from ..formats._readers import load_log
from ._ardupilot import ardupilot_setup
from ._betaflight import betaflight_setup
from ._crazyflie import crazyflie_setup
from ._proposal import AXES, finished, Proposal, Setup
from ._px4 import px4_setup


_SETUPS: Mapping[str, Callable[[Log, str | None], Setup]] = {
    "ardupilot": ardupilot_setup,
    "px4": px4_setup,
    "betaflight": betaflight_setup,
    "crazyflie": crazyflie_setup,
}


def propose(path: str | Path, *, axis: str | None = None) -> Proposal:
    """Which channels of an autopilot's log are command, rate and outside reference.

    Injected chirps are found, with their time and band: ArduPilot's SystemID mode, PX4's
    autotune, Betaflight's chirp mode. Without an `axis` it is that of the longest chirp, else the
    one that moves most. A set-point that an outer loop computes contains feedback, and is never
    proposed as the reference. For ArduPilot's chirps into the mixer (SID_AXIS 10 to 12) the
    command is the sum of controller output and chirp, for others the output already holds it.

    Raises ReadError for the file, RecordError where the log lacks what the axis needs.
    """
    if axis is not None and axis not in AXES:
        raise RecordError(f"axis {axis!r}: it is one of {', '.join(AXES)}.")
    log = load_log(path)
    if log.vehicle not in _SETUPS:
        raise RecordError(
            f"{path}: no log of a known autopilot ({', '.join(_SETUPS)}), so its channels have no "
            f"known meaning: see jq.records.channels, and name inputs, outputs and references yourself."
        )
    try:
        return finished(str(path), log, _SETUPS[log.vehicle](log, axis))
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from error
    # A log may call anything by the names that its vehicle uses.
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise RecordError(
            f"{path}: its channels are not those of {log.vehicle} "
            f"({type(error).__name__}: {printable(str(error))}): name them yourself."
        ) from error
