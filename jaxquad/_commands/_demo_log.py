"""A log to try things on: the rate loop of one axis in gusts, while its command is swept."""

from pathlib import Path

import numpy as np


RATE_HZ, GAIN, LAG, DELAY = 250.0, 280.0, 0.02, 0.008  # Hz, rad/s^2 per unit of M, s, s
BAND = (0.5, 12.0)  # Hz
_FEEDBACK = 0.02  # of M per rad/s
_GUST, _CORNER, _NOISE = 2.0, 3.0, 0.01  # rad/s^2, rad/s, rad/s


def write_demo_log(path: Path) -> Path:
    """Write time, reference x0, command M and rate q as CSV; the same at every call."""
    from jaxquad import sweep
    from jaxquad.batch._store import write_whole

    signal = sweep(
        2 * np.pi * 0.4, 2 * np.pi * 15, duration=40, sample_rate=RATE_HZ, amplitude=0.06
    )
    command, rate = _flown(signal.signal)
    columns = (signal.time, signal.signal, command, rate)
    rows = ("{:.6f},{:.8g},{:.8g},{:.8g}\n".format(*row) for row in zip(*columns, strict=True))
    write_whole(path, f"time,x0,M,q\n{''.join(rows)}".encode())
    return path


def _flown(swept: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """M = x0 - feedback q, held for a sample; q' = GAIN M(t - delay) behind a lag, and gusts."""
    random = np.random.default_rng(0)
    noise, shocks = random.standard_normal((2, swept.size))
    dt, late = 1 / RATE_HZ, round(DELAY * RATE_HZ)
    stay, hold = np.exp(-dt / LAG), np.exp(-_CORNER * dt)
    command, measured = np.zeros((2, swept.size))
    rate = moment = gust = 0.0
    for k in range(swept.size):
        measured[k] = rate + _NOISE * noise[k]
        command[k] = swept[k] - _FEEDBACK * measured[k]
        held = command[k - late] if k >= late else 0.0
        # The lag's exact mean over the sample, in which its input is constant.
        mean = held + (moment - held) * (1 - stay) * LAG / dt
        rate += dt * (GAIN * mean + gust)
        moment = held + (moment - held) * stay
        gust = hold * gust + _GUST * np.sqrt(1 - hold**2) * shocks[k]
    return command, measured
