from collections.abc import Callable, Mapping
from pathlib import Path

from .._errors import RecordError
from .._log import Log
from .._names import printable
from ..formats import load_log
from ._ardupilot import ardupilot_setup
from ._betaflight import betaflight_setup
from ._crazyflie import crazyflie_setup
from ._proposal import AXES, complete, Proposal, Setup
from ._px4 import px4_setup


_SETUPS: Mapping[str, Callable[[Log, str | None], Setup]] = {
    "ardupilot": ardupilot_setup,
    "px4": px4_setup,
    "betaflight": betaflight_setup,
    "crazyflie": crazyflie_setup,
}


def propose(path: str | Path, *, axis: str | None = None) -> Proposal:
    """Propose which channels of an autopilot's log are command, rate and external reference.

    Injected excitation is found, with its time and band: ArduPilot's SystemID mode, PX4's
    autotune, Betaflight's chirp mode. A set-point that an outer loop computes contains feedback,
    and is never proposed as the external reference. For ArduPilot's chirps into the mixer (SID_AXIS
    10 to 12) the command is the sum of controller output and chirp; for others the output already
    contains it.

    **Arguments:**

    - `path`: a log of ArduPilot, PX4, Betaflight or Crazyflie.
    - `axis`: `"roll"`, `"pitch"` or `"yaw"`; by default that of the longest injected excitation,
        else the one that moves most.

    **Returns:** a `Proposal`, which prints its reasons and the command line.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    - `RecordError`: where the log lacks the channels of the axis.
    """
    if axis is not None and axis not in AXES:
        raise RecordError(f"axis is {axis!r}: use one of {', '.join(AXES)}.")
    log = load_log(path)
    if log.vehicle not in _SETUPS:
        raise RecordError(
            f"{path}: not a log of a known autopilot ({', '.join(_SETUPS)}), so the meaning of its "
            f"channels is unknown. List them (jaxquad channels, jq.records.channels) and name "
            f"inputs, outputs and references yourself."
        )
    try:
        return complete(str(path), log, _SETUPS[log.vehicle](log, axis))
    except RecordError as error:
        raise RecordError(f"{path}: {error}") from error
    # A log may call anything by the names that its vehicle uses.
    except (ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise RecordError(
            f"{path}: the channels are not those that {log.vehicle} logs "
            f"({type(error).__name__}: {printable(str(error))}). Name inputs, outputs and "
            f"references yourself."
        ) from error
