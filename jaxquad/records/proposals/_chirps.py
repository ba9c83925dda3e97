"""Sweeps of Betaflight's chirp mode, from the debug channels that it fills."""

from typing import NamedTuple

import numpy as np

from .._log import Table


class Chirp(NamedTuple):
    """A sweep that Betaflight's chirp mode injected, on axis 0 (roll), 1 (pitch) or 2 (yaw)."""

    axis: int
    start: float  # s
    stop: float
    low: float  # Hz
    high: float
    channel: str = "debug[3]"  # of the excitation


_AXES = (0, 1, 2)
_SHORTEST = 1.0  # s
_MOST_EDGES = 10_000


def chirps(table: Table) -> list[Chirp]:
    """The sweeps in a log whose debug channels are those of debug mode CHIRP.

    There, debug[1] is the axis (-1 when idle), debug[2] the frequency in 0.1 Hz and debug[3] the
    excitation (betaflight pull request 15113). The number of that mode depends on the version, so
    the data decide: a frequency that only rises while the axis stays the same. Earlier firmware
    has debug[0] alone, from which the reader makes the channel `chirp`.
    """
    debug = [table.columns.get(f"debug[{i}]") for i in range(4)]
    if table.time is None:
        return []
    if "chirp" in table.columns:
        return _chirps_of_phase(table, table.time)
    if any(each is None for each in debug):
        return []
    _, axis, tenths, excitation = (np.asarray(each, np.float64) for each in debug)
    active = np.where(tenths > 0, axis, -1)
    edges = np.flatnonzero(np.diff(active)) + 1
    if not np.isin(axis, (-1, *_AXES)).all() or edges.size > _MOST_EDGES:
        return []
    sweeps = []
    for first, end in zip([0, *edges], [*edges, axis.size], strict=True):
        frequency, time = tenths[first:end] / 10, table.time[first:end]
        rises = (np.diff(frequency) >= 0).all() and frequency[-1] > frequency[0]
        moves = rises and np.ptp(excitation[first:end]) > 0
        if active[first] in _AXES and moves and time[-1] - time[0] >= _SHORTEST:
            ends = (float(time[0]), float(time[-1]), float(frequency[0]), float(frequency[-1]))
            sweeps.append(Chirp(int(active[first]), *ends))
    return sweeps


_PAUSE = 0.2  # s of a phase of 0: another sweep; within one, single samples pass through 0
_DRIVEN = 0.1  # of its variance that a sweep explains, at least, in the set-point of its axis


def _chirps_of_phase(table: Table, time: np.ndarray) -> list[Chirp]:
    """The sweeps of a log that has their phase alone (debug[0], 5000 a radian).

    The axis is the one whose set-point holds the sweep.
    """
    phase = np.asarray(table.columns["debug[0]"], np.float64) / 5e3
    rows = np.flatnonzero(phase > 0)
    cuts = np.flatnonzero(np.diff(time[rows]) > _PAUSE) + 1
    sweeps = []
    for part in np.split(rows, cuts):
        if not part.size or time[part[-1]] - time[part[0]] < _SHORTEST:
            continue
        inside = slice(part[0], part[-1] + 1)
        axis = _driven_axis(table, inside)
        if axis is not None:
            band = _band(phase[inside], time[inside])
            sweeps.append(Chirp(axis, float(time[part[0]]), float(time[part[-1]]), *band, "chirp"))
    return sweeps


def _driven_axis(table: Table, inside: slice) -> int | None:
    """The axis whose set-point is most coherent with the sweep, whatever its lead or lag."""
    phase = np.asarray(table.columns["debug[0]"][inside], np.float64) / 5e3
    wave = np.exp(1j * phase) * (phase > 0)
    shares = {}
    for axis in _AXES:
        name = f"setpoint[{axis}]"
        if name in table.columns:
            values = np.asarray(table.columns[name][inside], np.float64)
            values = np.nan_to_num(values - np.nanmean(values))
            power = float(np.mean(values**2))
            if power > 0:
                shares[axis] = 2 * abs(np.mean(values * wave.conj())) ** 2 / power
    best = max(shares, key=lambda axis: shares[axis], default=None)
    return best if best is not None and shares[best] > _DRIVEN else None


_EDGE = 20  # of the samples of a sweep, one part: its begin and its end


def _band(phase: np.ndarray, time: np.ndarray) -> tuple[float, float]:
    """The lowest and highest frequency in Hz; the phase, in rad, is known modulo 2 pi."""
    speed = np.mod(np.diff(phase), 2 * np.pi) / np.diff(time) / (2 * np.pi)
    part = max(1, speed.size // _EDGE)
    low, high = float(np.min(_medians(speed[:part]))), float(np.median(speed[-part:]))
    return max(low, 0.1), high


def _medians(speed: np.ndarray) -> np.ndarray:
    """Of short pieces: single steps are rounded, and those through 0 are wrong."""
    pieces = np.array_split(speed, max(1, speed.size // 50))
    return np.array([np.median(piece) for piece in pieces])
