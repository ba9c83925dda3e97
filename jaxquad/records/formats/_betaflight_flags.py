"""Flight modes as blackbox_decode writes them: names in the cells of its table."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int

from .._log import Table


# In the order of the bits. An older blackbox_decode gives the bits of Betaflight, which begin with
# ARM, the names of Cleanflight's: armed reads ANGLE_MODE, and ANGLE reads HORIZON_MODE.
_OLD = "ANGLE_MODE HORIZON_MODE MAG BARO GPS_HOME GPS_HOLD HEADFREE AUTOTUNE PASSTHRU SONAR".split()
_NEW = (
    "ARM ANGLE HORIZON MAG HEADFREE PASSTHRU FAILSAFE GPSRESCUE - ANTIGRAVITY HEADADJ CAMSTAB "
    "BEEPERON LEDLOW CALIB OSD TELEMETRY SERVO1 SERVO2 SERVO3 BLACKBOX AIRMODE 3D FPVANGLEMIX "
    "BLACKBOXERASE CAMERA1 CAMERA2 CAMERA3 FLIPOVERAFTERCRASH PREARM BEEPGPSCOUNT VTXPITMODE"
).split()
_NONE = ("", "0", "NONE")


class FlagTexts:
    """The cells of a column of flags, numbered as they come."""

    def __init__(self):
        self._numbers: dict[str, int] = {}
        self._parts: list[Int[np.ndarray, " rows"]] = []

    def add(self, lines: list[str], column: int) -> None:
        """Take the cell of each line, "" where a line ends before it."""
        cells = (line.split(",", column + 1)[column : column + 1] for line in lines)
        texts = (cell[0].strip().strip('"') if cell else "" for cell in cells)
        self._parts.append(
            np.array([self._numbers.setdefault(text, len(self._numbers)) for text in texts])
        )

    def table(
        self, rows: np.ndarray, time: Float[np.ndarray, " rows"]
    ) -> Table | None:  # fmt: skip
        """`flightModeFlags` where it changes, of the `rows` that have a `time` (s).

        None where the column is empty, or holds what is no name of a mode.
        """
        names = _OLD if any(_is_old(text) for text in self._numbers) else _NEW
        masks = [_mask(text, names) for text in self._numbers]
        if not any(self._numbers) or None in masks:
            return None
        flags = np.array(masks, np.uint32)[np.concatenate(self._parts)[rows]]
        changes = np.flatnonzero(np.diff(flags, prepend=~flags[:1]))
        return Table({"flightModeFlags": flags[changes]}, time[changes])


def _is_old(text: str) -> bool:
    return any(name.endswith("_MODE") for name in text.split("|"))


def _mask(text: str, names: Sequence[str]) -> int | None:
    """The bits of a cell; None for what is not understood."""
    if text in _NONE:
        return 0
    if text.isascii() and text.isdecimal():
        return int(text) if len(text) < 10 else None
    bits = [names.index(name) if name in names else -1 for name in text.split("|")]
    return None if min(bits) < 0 else sum(1 << bit for bit in set(bits))
