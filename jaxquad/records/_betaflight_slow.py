import numpy as np
from jaxtyping import Float, Int

from ._betaflight_frames import Found
from ._betaflight_header import Frame, Header
from ._betaflight_predict import add_constants, constants
from ._betaflight_units import scaled
from ._log import Table


def slow_tables(
    slow: dict[str, Found], main: Found, time: Float[np.ndarray, " samples"], header: Header
) -> dict[str, Table]:
    """The tables `slow` (flight modes) and `gps`, stamped with the last main frame before.

    GPS frames that no home position precedes are left out, as nothing is known from them.
    """
    tables = {}
    for letter, name in (("S", "slow"), ("G", "gps")):
        found = slow.get(letter)
        if found is None or not found.offsets.size:
            continue
        frame = header.frames[letter]
        before = np.searchsorted(main.offsets, found.offsets) - 1
        if 10 not in frame.predictors:  # What was noted before the first frame held then, too.
            before = np.maximum(before, 0)
        rows = np.flatnonzero(before >= 0)
        home, rows = _home(slow.get("H"), frame, found.offsets, rows)
        values = found.coded[rows]
        add_constants(values, frame, constants(frame, header))
        values[:, frame.predictors == 7] += home
        values[:, frame.predictors == 10] += main.coded[before[rows], 1][:, None]
        stamps = time[before[rows]]
        tables[name] = table(values, frame, stamps, header)
    return tables


def table(
    values: Int[np.ndarray, "samples fields"],
    frame: Frame,
    time: Float[np.ndarray, " samples"],
    header: Header,
) -> Table:
    """Views of the decoded columns with the units that the header gives them."""
    columns = {
        name: values[:, i] if frame.signed[i] else values[:, i].view(np.uint32)
        for i, name in enumerate(frame.names)
        if name != "time"
    }
    known = scaled(frame.names, header.settings)
    units = {name: unit for name, (_, unit) in known.items()}
    return Table(columns, time, units, {name: factor for name, (factor, _) in known.items()})


def _home(
    homes: Found | None, frame: Frame, offsets: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The home coordinates for the fields that refer to them, and the rows that have one."""
    fields = int((frame.predictors == 7).sum())
    if not fields:
        return np.zeros((rows.size, 0), np.int32), rows
    if homes is None or not homes.offsets.size or homes.coded.shape[1] < fields:
        return np.zeros((0, fields), np.int32), rows[:0]
    last = np.searchsorted(homes.offsets, offsets) - 1
    rows = rows[last[rows] >= 0]
    return homes.coded[last[rows], :fields], rows
