"""Blackbox logs of the simulated quads of `studies/throttle_flights.py`, at one throttle or three.

The header holds the PID and the filters that the simulation has.
"""

from pathlib import Path

import blackbox_rows
import blackbox_writer
import numpy as np


HEADER = {
    "Firmware type": "Betaflight", "Firmware revision": "Betaflight 4.5.1 (abc) STM32F7X2",
    "looptime": "125", "pid_process_denom": "2", "rollPID": "45,80,30", "pitchPID": "47,84,34",
    "yawPID": "45,80,0", "gyro_lpf2_static_hz": "500", "gyro_lpf1_static_hz": "350",
    "gyro_notch_hz": "190,0", "gyro_notch_cutoff": "160.9548,0", "dterm_lpf1_static_hz": "105",
    "dterm_lpf2_static_hz": "150", "tpa_rate": "0",
}  # fmt: skip
ADRC = {
    "Firmware revision": "Betaflight 2026.6.0-alpha (abc) STM32F7X2", "pid_type": "1",
    "adrcWC": "60,60,60", "adrcWO": "200,100,80", "adrcB0": "6000,2000,2000", "adrc_b0_law": "1",
    "adrc_hover_throttle": "30", "adrc_gyro_lpf_hz": "150", "adrc_sigma_decay": "3",
    "adrc_td_hz": "0", "adrc_b0_scale_max": "3",
}  # fmt: skip


def write_log(path: Path, flights, k: int = 0, *, part=slice(None), changed=None) -> Path:
    """A log of roll of one flight; rssi is put aside for the throttle, with as many bits."""
    names = [name.replace("rssi", "setpoint[3]") for name in blackbox_writer.NAMES]
    level = {name: blackbox_rows.LEVEL.get(name, 0) for name in blackbox_writer.NAMES}
    columns = (flights.setpoint, flights.gyro, flights.command, np.rint(1000 * flights.throttle))
    logged = np.stack([each[part, k] for each in columns], axis=1).astype(int).tolist()
    every = round(4000 * float(flights.time[1] - flights.time[0]))  # loops of the PID
    rows = [
        level | {
            "loopIteration": every * n, "time": 5_000_000 + 250 * every * n, "axisP[0]": u,
            "rcCommand[0]": r, "setpoint[0]": r, "gyroADC[0]": y, "rssi": x,
        }
        for n, (r, y, u, x) in enumerate(logged)
    ]  # fmt: skip
    named = HEADER | {"Field I name": ",".join(names)} | (changed or {})
    path.write_bytes(blackbox_rows.log(rows, logged=f"1/{every}", changed=named))
    return path
