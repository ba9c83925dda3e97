"""For how long a rate loop holds its command: by its parameters, and by the log's own stamps."""

import numpy as np

from .._log import Log


_RATES = ("SCHED_LOOP_RATE", "IMU_GYRO_RATEMAX")  # Hz, of ArduPilot's and of PX4's rate loop
_LONGEST = 0.1  # s
_TOLERANCE = 0.05  # between the header's period and that of the stamps
_STRIDE = 256  # rows, over which stamps that jitter give a period


def command_hold(log: Log) -> tuple[float | None, tuple[str, ...]]:
    """The period of the rate loop in s, None where the log does not say it, and remarks.

    Betaflight's header has it, and `loopIteration` counts the loops between two stamps: where they
    contradict each other by more than 5 %, the stamps are right.
    """
    values = {name: float(text) for name, text in log.settings.items() if _is_number(text)}
    rates = [values[name] for name in _RATES if values.get(name, 0.0) > 0]
    if rates:
        return _plausible(1 / rates[0]), ()
    # us, and loops of the gyro for one of the PID
    stated = _plausible(1e-6 * values.get("looptime", 0.0) * values.get("pid_process_denom", 1.0))
    stamped = _plausible(_period_of_stamps(log))
    if stated is None or stamped is None or abs(stamped / stated - 1) < _TOLERANCE:
        return stated, ()
    remark = (
        f"the header says a loop of {1e6 * stated:.6g} us (looptime, pid_process_denom), but the "
        f"time stamps say {1e6 * stamped:.6g} us for each loopIteration: the stamps are taken for "
        f"how long the command is held (--hold takes another)"
    )
    return float(f"{stamped:.6g}"), (remark,)


def _plausible(period: float) -> float | None:
    return period if 0 < period < _LONGEST else None


def _period_of_stamps(log: Log) -> float:
    """The median time for one loopIteration in s; 0 where the log does not count them."""
    for table in log.tables.values():
        counter = table.columns.get("loopIteration")
        if log.vehicle == "betaflight" and counter is not None and table.time is not None:
            stride = min(_STRIDE, table.time.size - 1)
            loops = np.asarray(counter, np.float64)
            loops, time = (
                loops[stride:] - loops[:-stride],
                table.time[stride:] - table.time[:-stride],
            )
            good = (loops > 0) & (time > 0)
            return float(np.median(time[good] / loops[good])) if good.any() else 0.0
    return 0.0


def _is_number(text: str) -> bool:
    try:
        return bool(np.isfinite(float(text)))
    except ValueError:
        return False
