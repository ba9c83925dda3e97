"""Fourier sums of tapered windows of several lengths, in NumPy: nothing is compiled."""

import functools as ft
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from jaxquad._core import require_x64

from ._basis import Basis, merged_basis, sample_basis
from ._blocks import band_edges, choose_lattice, choose_levels, Lattice, Level, rank
from ._half_windows import (
    Columns,
    Fold,
    fold_anywhere,
    fold_blocks,
    fold_of,
    fold_samples,
    make_tables,
    Table,
)
from ._window import window


_SHORT = 128  # samples below which a window is summed directly
_FULL = 0.7  # functions to a sample of a block, beyond which compression does not pay
_AT_ONCE = 2**17  # samples of windows that lie anywhere
_IN_CACHE = 2**16  # samples that are compressed at once
_THIN = 256  # samples that show a constant well enough

Angles = Float[np.ndarray, " frequencies"]
Rows = Float[np.ndarray, "channels samples"]
Windows = tuple[tuple[int, tuple[int, ...]], ...]  # length and starts


class Taper(NamedTuple):
    """A window's shape and what it acts on: so many of the channels, windows from `first` on."""

    shape: str
    channels: int
    first: int = 0


def _present(tapers: Sequence[Taper], number: int) -> list[Taper]:
    """Those that act on the windows of this number."""
    return [each for each in tapers if each.first <= number]


def _alike(tapers: Sequence[Taper]) -> list[list[Taper]]:
    """Neighbours that act on the same channels: they share products."""
    return [list(few) for _, few in itertools.groupby(tapers, key=lambda each: each.channels)]


class Part(NamedTuple):
    """Windows of one length that are folded in the same way, with the tables of each taper."""

    places: Int[np.ndarray, " windows"]  # among the windows of this length
    fold: Fold
    level: int | None  # of the blocks that they are made of, if any
    starts: tuple[int, ...]  # in these blocks, or in samples
    tables: tuple[tuple[Table, ...], ...]  # one to a band, for each set of `_alike` tapers


class Plan(NamedTuple):
    """Tables and layout of a transform; frequencies in ascending order of magnitude."""

    lattice: Lattice
    levels: tuple[Level, ...]
    bases: tuple[Basis, ...]  # one for each level, the blocks of samples first
    windows: Windows
    parts: tuple[tuple[Part, ...], ...]  # for each length
    turns: tuple[Complex[np.ndarray, "frequencies windows"], ...]  # phases of their middles
    angle: Angles
    bands: tuple[Angles, ...]  # the frequencies that compression serves
    order: Int[np.ndarray, " frequencies"] | None  # back to the caller's, if it differs


@ft.lru_cache(maxsize=12)
def plan_transform(
    samples: int,
    angle: tuple[float, ...],  # rad per sample
    windows: Windows,
    tapers: tuple[Taper, ...],
    detrend: str,
) -> Plan:
    """The tables of a transform, cached: they depend on the layout of a record, not on samples."""
    _check(samples, angle, windows, detrend)
    forward = np.argsort(np.abs(angle), kind="stable")
    omega = np.asarray(angle, float)[forward]
    lattice, bands = _bands(samples, omega, windows)
    long = [each for each in windows if each[0] >= _SHORT] if bands else []
    served = np.concatenate(bands) if bands else omega[:0]
    levels = choose_levels(lattice, long, np.abs(served))
    reach = [float(np.max(np.abs(band))) + _spread(windows) for band in bands]
    bases = [sample_basis(lattice.block, reach)] if bands else []
    bases += [merged_basis(bases[0], level.many, reach) for level in levels[1:]]
    trends = ("none", "constant", "linear").index(detrend)
    parts = [
        _parts(number, each, lattice, levels, bases, bands, trends, tapers)
        for number, each in enumerate(windows)
    ]
    turns = [
        np.exp(-1j * omega[:, None] * (np.asarray(starts) + length / 2))
        for length, starts in windows
    ]
    straight = np.array_equal(forward, np.arange(omega.size))
    return Plan(
        lattice, levels, tuple(bases), windows, tuple(parts), tuple(turns), omega, tuple(bands),
        None if straight else np.argsort(forward),
    )  # fmt: skip


def _check(samples: int, angle: tuple[float, ...], windows: Windows, detrend: str) -> None:
    if detrend not in ("none", "constant", "linear"):
        raise ValueError(f"detrend is {detrend!r}: use none, constant or linear")
    if not angle or not np.all(np.abs(angle) <= np.pi):
        worst = max(angle, key=abs, default=None)
        raise ValueError(
            f"angle {worst} rad per sample is not within -pi to pi, the Nyquist frequency: give at "
            "least one frequency, and none above half the sample rate"
        )
    if not windows:
        raise ValueError("there are no windows: give at least one pair (length, starts)")
    for length, starts in windows:
        if length < 2 or not starts or min(starts) < 0 or max(starts) + length > samples:
            raise ValueError(
                f"windows of {length} samples that start at {min(starts, default=None)} to "
                f"{max(starts, default=None)} do not fit a record of {samples} samples: starts "
                f"must lie between 0 and {samples - length}, and a window must hold 2 samples"
            )


def _spread(windows: Windows) -> float:
    """By which a raised cosine shifts frequencies: one cycle of the shortest window."""
    return 2 * np.pi / min((n for n, _ in windows if n >= _SHORT), default=1)


def _bands(
    samples: int, omega: Angles, windows: Windows
) -> tuple[Lattice, list[Float[np.ndarray, " _"]]]:
    """Blocks of samples, and bands of the frequencies that compression serves."""
    long = [each for each in windows if each[0] >= _SHORT]
    if not long:
        return Lattice(1, 0, samples), []
    lattice = choose_lattice(samples, long, np.abs(omega))
    ranks = rank(lattice.block, np.abs(omega) + _spread(windows))
    served = int(np.count_nonzero(ranks <= _FULL * lattice.block))
    if not served:
        return lattice, []
    return lattice, np.split(omega[:served], band_edges(ranks[:served])[:-1])


def _parts(
    number: int,
    windows: tuple[int, tuple[int, ...]],
    lattice: Lattice,
    levels: Sequence[Level],
    bases: Sequence[Basis],
    bands: Sequence[Float[np.ndarray, " _"]],
    trends: int,
    tapers: Sequence[Taper],
) -> tuple[Part, ...]:
    """Windows of whole blocks, of the longest blocks that suit them, and all others."""
    length, starts = windows
    if length < _SHORT or not bands:
        return ()
    shapes = [[each.shape for each in few] for few in _alike(_present(tapers, number))]
    on = np.array([lattice.holds(length, start) for start in starts])
    parts, where = [], np.flatnonzero(on)
    if where.size:
        blocks = [(starts[k] - lattice.offset) // lattice.block for k in where]
        fitting = [
            k for k, each in enumerate(levels) if each.holds(length // lattice.block, blocks)
        ]
        most = max(fitting, key=lambda k: levels[k].many)
        mine, basis = levels[most], bases[most]
        fold = fold_of(length, basis.samples, trends)
        first = tuple((block - mine.offset) // mine.many for block in blocks)
        tables = tuple(make_tables(fold, basis, bands, few) for few in shapes)
        parts.append(Part(where, fold, most, first, tables))
    astray = np.flatnonzero(~on)
    if astray.size:
        fold = fold_anywhere(length, lattice.block, trends)
        tables = tuple(make_tables(fold, bases[0], bands, few) for few in shapes)
        first = tuple(starts[k] for k in astray)
        parts.append(Part(astray, fold, None, first, tables))
    return tuple(parts)


def transform_windows(
    signals: Float[np.ndarray, "samples channels"],
    angle: Angles,
    windows: Windows,
    *,
    shape: str = "hann",
    detrend: str = "constant",
    origin: float = 0.0,
) -> list[Complex[np.ndarray, "frequencies segments channels"]]:
    """Fourier sums of tapered windows of several lengths, at any frequencies at once.

    `sum_n taper[n] x[start + n] exp(-j angle (origin + start + n))`, one array for each pair
    (length, starts) of `windows`, with `angle` in rad per sample: the phase is absolute, of a
    record whose first sample is number `origin`. `detrend` removes the "constant" or the "linear"
    least-squares trend of every window before the taper, or "none". Tables are made at the first
    call for a layout and cached. Raises `ValueError` for windows outside the record or frequencies
    above the Nyquist frequency, `PrecisionError` in 32 bits.

    Blocks of samples are compressed once, for all windows, to the few functions that these
    frequencies can distinguish, and each window is folded about its middle; each length is then a
    small matrix product. Accurate to about 2e-13 of the largest sum. Fast where lengths are
    multiples of a block: see `lattice_windows`.
    """
    tapers = (Taper(shape, signals.shape[1]),)
    return transform_tapers((signals,), angle, windows, tapers, detrend=detrend, origin=origin)[0]


def transform_tapers(
    signals: tuple[Float[np.ndarray, "samples _"], ...],
    angle: Angles,
    windows: Windows,
    tapers: tuple[Taper, ...],
    *,
    detrend: str,
    origin: float,
) -> list[list[Complex[np.ndarray, "frequencies segments _"]]]:
    """`transform_windows` of signals side by side, for several tapers.

    In memory, the windows of one channel are neighbours.
    """
    require_x64("a transform")
    angles = tuple(np.asarray(angle, float).tolist())
    plan = plan_transform(len(signals[0]), angles, windows, tapers, detrend)
    source = _Source(plan, signals, detrend)
    phase = np.exp(-1j * origin * plan.angle)[:, None] if origin else None
    found = _empty_sums(plan, tapers)
    for number, turn in enumerate(plan.turns):
        mine = [k for k, each in enumerate(tapers) if each.first <= number]
        sums = [found[k][number - tapers[k].first] for k in mine]
        _fill_window_sums(plan, source, number, [tapers[k] for k in mine], sums)
        for each in sums:
            each *= (turn if phase is None else turn * phase)[:, None]
    if plan.order is not None:
        found = [[each[plan.order] for each in mine] for mine in found]
    return [[np.swapaxes(each, 1, 2) for each in mine] for mine in found]


_PAGES = 2**18  # complex numbers, from which on NumPy asks for large pages


def _empty_sums(
    plan: Plan, tapers: Sequence[Taper]
) -> list[list[Complex[np.ndarray, "frequencies _ _"]]]:
    """Room for the sums of all windows, in one piece: memory in small pages takes as long to get
    as half of the products."""
    counts = [len(starts) for _, starts in plan.windows]
    sizes = [(each.channels, many) for each in tapers for many in counts[each.first :]]
    ends = list(itertools.accumulate(plan.angle.size * channels * n for channels, n in sizes))
    room = np.empty(max(ends[-1], min(_PAGES, 2 * ends[-1])), complex)
    parts = [
        room[begin:end].reshape(plan.angle.size, *size)
        for begin, end, size in zip([0, *ends[:-1]], ends, sizes, strict=True)
    ]
    return [[parts.pop(0) for _ in counts[each.first :]] for each in tapers]


class _Source:
    """The samples of a record less a constant, and the coefficients of its blocks."""

    def __init__(self, plan: Plan, signals: Sequence[np.ndarray], detrend: str):
        self._plan, self._detrend = plan, detrend
        self._columns = [np.asarray(each, float).T for each in signals]
        self._levels = [_constant(each, detrend) for each in self._columns]
        ends = np.cumsum([0, *map(len, self._columns)]).tolist()
        self.channels, self._places = ends[-1], list(map(slice, ends[:-1], ends[1:]))

    def _samples(self, where: slice, into: np.ndarray | None = None) -> np.ndarray:
        """Those samples of all channels."""
        views = [columns[:, where] for columns in self._columns]
        if into is None:
            into = np.empty((self.channels, views[0].shape[1]))
        shape = into.shape[1:]
        for place, view, level in zip(self._places, views, self._levels, strict=True):
            constant = level.reshape(-1, *[1] * len(shape))
            np.subtract(view.reshape(-1, *shape), constant, out=into[place])
        return into

    @ft.cached_property
    def rows(self) -> Rows:
        return self._samples(slice(None))

    @ft.cached_property
    def _posts(self) -> Float[np.ndarray, "channels ends"]:
        """The samples where blocks begin, and that after the last block: 0 where there is none."""
        block, offset, count = self._plan.lattice
        known = self._samples(slice(offset, offset + count * block + 1, block))
        found = np.zeros((self.channels, count + 1))
        found[:, : known.shape[1]] = known
        return found

    @ft.cached_property
    def _coefficients(self) -> list[Float[np.ndarray, "channels blocks rank"]]:
        plan = self._plan
        found = [self._compressed(plan.bases[0])]
        for level, basis in zip(plan.levels[1:], plan.bases[1:], strict=True):
            used = found[0][:, level.offset :]
            count = used.shape[1] // level.many
            together = used[:, : count * level.many].reshape(len(used), count, -1)
            found.append(_products(together, basis))
        return found

    def _compressed(self, basis: Basis) -> Float[np.ndarray, "channels blocks rank"]:
        """Block by block, a few at once, so that they stay in the processor's cache."""
        block, offset, count = self._plan.lattice
        posts, many = self._posts, max(_IN_CACHE // (block * self.channels), 1)
        found = np.empty((self.channels, count, basis.signs.size))
        for begin in range(0, count, many):
            end = min(begin + many, count)
            few = np.empty((self.channels, end - begin, block + 1))
            self._samples(slice(offset + begin * block, offset + end * block), few[:, :, :-1])
            few[:, :, -1] = posts[:, begin + 1 : end + 1]
            found[:, begin:end] = _products(few, basis)
        return found

    def folded(self, part: Part) -> Iterator[tuple[np.ndarray, Columns, Columns]]:
        """Places of windows, with the sums and differences of their halves."""
        plan, block = self._plan, self._plan.lattice.block
        if part.level is not None:
            level, basis = plan.levels[part.level], plan.bases[part.level]
            first = np.array(part.starts) * level.many + level.offset
            ends = np.stack([self._posts[:, k] for k in (first, first + part.fold.length // block)])
            found = self._coefficients[part.level]
            yield part.places, *fold_blocks(part.fold, basis, found, part.starts, ends)
            return
        for few, segments in self.segments(part.fold.length, part.starts):
            yield part.places[few], *fold_samples(part.fold, plan.bases[0], segments)

    def segments(
        self, length: int, starts: Sequence[int]
    ) -> Iterator[tuple[slice, Float[np.ndarray, "channels windows samples"]]]:
        """Windows without their trends, a few at once."""
        views = np.lib.stride_tricks.sliding_window_view(self.rows, length, axis=1)
        many = max(_AT_ONCE // (length * self.channels), 1)
        for begin in range(0, len(starts), many):
            few = slice(begin, begin + many)
            yield few, _without_trend(views[:, np.array(starts[few])], self._detrend)


def _constant(columns: Float[np.ndarray, "_ samples"], detrend: str) -> Float[np.ndarray, " _"]:
    """Near each channel's mean: no trend is left of it, but its rounding errors would be."""
    if detrend == "none":
        return np.zeros(len(columns))
    return np.mean(columns[:, :: max(columns.shape[1] // _THIN, 1)], axis=1)


def _products(
    blocks: Float[np.ndarray, "channels blocks places"], basis: Basis
) -> Float[np.ndarray, "channels blocks rank"]:
    # A product with few rows is quicker than one with few columns.
    flat = basis.weights.T @ blocks.reshape(-1, blocks.shape[2]).T
    return np.ascontiguousarray(flat.T).reshape(*blocks.shape[:2], -1)


def _without_trend(
    segments: Float[np.ndarray, "channels windows samples"], detrend: str
) -> Float[np.ndarray, "channels windows samples"]:
    if detrend == "none":
        return segments
    segments = segments - np.mean(segments, axis=2, keepdims=True)
    if detrend == "linear":
        ramp = np.linspace(-1.0, 1.0, segments.shape[2])
        segments -= (segments @ ramp / np.sum(ramp**2))[:, :, None] * ramp
    return segments


def _fill_window_sums(
    plan: Plan,
    source: _Source,
    number: int,
    tapers: Sequence[Taper],
    sums: Sequence[Complex[np.ndarray, "frequencies _ windows"]],
) -> None:
    """Those of one length behind each taper, with phases from the middle of a window."""
    length, starts = plan.windows[number]
    for part in plan.parts[number]:
        for places, *halves in source.folded(part):
            whole = len(places) == len(starts)
            made = sums
            if not whole:
                made = [np.empty((*each.shape[:2], len(places)), complex) for each in sums]
            rest = iter(made)
            for tables, few in zip(part.tables, _alike(tapers), strict=True):
                mine = [each[: few[0].channels] for each in halves]
                _apply_tables(tables, mine, [next(rest) for _ in few])
            if not whole:
                for found, each in zip(sums, made, strict=True):
                    found[:, :, places] = each
    served = sum(map(len, plan.bands)) if plan.parts[number] else 0
    if served < plan.angle.size:
        above = plan.angle[served:]
        for few, segments in source.segments(length, starts):
            for found, taper in zip(sums, tapers, strict=True):
                tapered = segments[: taper.channels] * window(taper.shape, length)
                found[served:, :, few] = _fourier_sums(tapered, above)


def _apply_tables(
    tables: Sequence[Table],
    halves: Sequence[Columns],
    into: Sequence[Complex[np.ndarray, "frequencies channels windows"]],
) -> None:
    channels, windows, _ = halves[0].shape
    flat, begin = [each.reshape(channels * windows, -1) for each in halves], 0
    for table in tables:
        end = begin + len(table.of_sums) // len(into)
        parts = (
            (own @ part[:, : own.shape[1]].T).reshape(len(into), -1, channels, windows)
            for own, part in zip(table[:2], flat, strict=True)
        )
        for each, odd, sums, differences in zip(into, table.odd, *parts, strict=True):
            each.real[begin:end] = differences if odd else sums
            each.imag[begin:end] = sums if odd else differences
        begin = end


def _fourier_sums(
    segments: Float[np.ndarray, "channels windows samples"], angle: Angles
) -> Complex[np.ndarray, "frequencies channels windows"]:
    """Two levels, within short blocks and over the blocks, so that few exponentials are needed."""
    *many, length = segments.shape
    block = max(int(np.sqrt(length)), 1)
    count = -(-length // block)
    padded = np.pad(segments, ((0, 0), (0, 0), (0, count * block - length)))
    inner = np.exp(-1j * np.arange(block)[:, None] * angle)
    outer = np.exp(-1j * (np.arange(count)[:, None] * block - length / 2) * angle)
    # Real factors: a product of a real with a complex array would double the arithmetic.
    parts = padded.reshape(-1, block) @ np.hstack([np.real(inner), np.imag(inner)])
    real, imag = np.split(parts.reshape(*many, count, -1), 2, axis=3)
    return np.einsum("cwbf,bf->fcw", real + 1j * imag, outer)
