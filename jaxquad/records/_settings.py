"""What an autopilot's log says about the firmware that wrote it: version and parameters."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from ._errors import ReadError
from ._log import Log
from .formats import load_log


class Settings(NamedTuple):
    """Firmware and parameters of a log, as text.

    **Arguments:**

    - `vehicle`: ardupilot, px4 or betaflight.
    - `version`: of the firmware, (4, 2, 0); empty where the log does not say.
    - `values`: by name: a Betaflight header's lines, ArduPilot's PARM, PX4's parameters.
    """

    vehicle: str
    version: tuple[int, ...]
    values: Mapping[str, str]


_REVISION = re.compile(r"(\d+)\.(\d+)(?:\.(\d+))?")


def read_settings(path: str | Path, *, log: str = "", at: float | int | None = None) -> Settings:
    """Read the parameters that a log begins with.

    A parameter that was changed in flight has its value of the time `at`; by default its last one
    in ArduPilot's and PX4's logs, and its first one in Betaflight's, which say no more.

    **Arguments:**

    - `path`: a log of Betaflight, ArduPilot or PX4.
    - `log`: of a Betaflight file with several logs, which one: "log2".
    - `at`: in s of the log's own time, for logs of ArduPilot and PX4.

    **Returns:** the `Settings`.

    **Raises:**

    - `ReadError`: the file cannot be read, is of no autopilot, or holds no parameters.
    """
    found = load_log(path)
    later = [change for change in found.changes if at is not None and change.time > at]
    values = {**found.settings, **{each.name: each.before for each in reversed(later)}}
    if log:
        values = {
            k.removeprefix(f"{log} "): x for k, x in values.items() if k.startswith(f"{log} ")
        }
    if found.vehicle not in ("ardupilot", "px4", "betaflight") or not values:
        raise ReadError(
            f"{path}: the file holds no parameters of ArduPilot, PX4 or Betaflight"
            + (f" under {log!r}" if log else "")
            + ": give the log that the autopilot wrote, with its parameters logged."
        )
    return Settings(found.vehicle, _version(found, values), values)


def _version(log: Log, values: Mapping[str, str]) -> tuple[int, ...]:
    text = values.get("ver_sw_release", values.get("Firmware revision", log.firmware))
    if log.vehicle == "px4" and text.isdecimal():  # one byte each
        return tuple(int(text) >> shift & 0xFF for shift in (24, 16, 8))
    match = _REVISION.search(text)
    return tuple(int(part or 0) for part in match.groups()) if match else ()
