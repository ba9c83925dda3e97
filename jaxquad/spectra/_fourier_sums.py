"""Fourier sums of tapered windows of several lengths, at any frequencies; windows and their places.

A raised cosine is a constant and two waves: behind it, the sum at w is made of those of plain
windows at w and w +- 2 pi / length. Those are differences of running sums over blocks of samples,
so the cost depends neither on the overlap of windows nor on the number of tapers.
Of a block only the few even and odd functions count that these frequencies can tell apart: with
c = w block / 2, about 2 c / pi + O(log c) of them (Slepian; Landau and Widom, 1980).
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int


Grid = Float[np.ndarray, " frequencies"]
Layout = tuple[tuple[int, tuple[int, ...]], ...]  # length and starts of each set of windows

_BLOCKS = (32, 1024)  # samples to a block that windows of several lengths share
_SHORT = 128  # samples below which a window is summed directly
_AT_ONCE = 128  # blocks, about, whose sums stay in the processor's cache
_TOLERANCE = 6e-14  # of a block's waves; leaves 2e-13 of the largest Fourier sum
_THIN = 256  # samples that show a constant well enough
_TRENDS = ("none", "constant", "linear")

_SHAPES = {"hann": (0.5, 0.5), "hamming": (0.54, 0.46), "rectangular": (1.0, 0.0)}


def window(name: str, samples: int) -> Float[np.ndarray, " window"]:
    """A periodic raised-cosine window of `samples` points: "hann", "hamming" or "rectangular"."""
    level, cosine, sine = waves(name)
    angle = 2 * np.pi * np.arange(samples) / samples
    return level - cosine * np.cos(angle) - sine * np.sin(angle)


def waves(name: str) -> tuple[float, float, float]:
    """level - cosine cos a - sine sin a of a window, a = 2 pi n / samples; primes are d/da."""
    plain = name.rstrip("'")
    (level, cosine), sine = coefficients(plain), 0.0
    for _ in range(len(name) - len(plain)):
        level, cosine, sine = 0.0, sine, -cosine
    return level, cosine, sine


def coefficients(name: str) -> tuple[float, float]:
    """Level and cosine amplitude of a window: level - cosine cos(2 pi n / samples)."""
    if name not in _SHAPES:
        raise ValueError(f"there is no window {name!r}: use one of {', '.join(_SHAPES)}")
    return _SHAPES[name]


@ft.lru_cache(maxsize=256)
def segment_starts(samples: int, length: int, overlap: float) -> tuple[int, ...]:
    """First samples of windows that overlap by at least `overlap`, spread evenly to both ends."""
    step = max(int(round(length * (1 - overlap))), 1)
    count = -(-(samples - length) // step) + 1
    return tuple(int(start) for start in np.round(np.linspace(0, samples - length, count)))


@ft.lru_cache(maxsize=64)
def lattice_windows(
    samples: int, lengths: tuple[int, ...], overlap: float, highest: float
) -> Layout:
    """Windows near `lengths`, with about the `overlap`, of whole blocks that all share."""
    long = [length for length in lengths if length >= 16 * _BLOCKS[0]]
    common = 1
    if long:  # the block that divides all lengths, or else changes them by least
        ideal = min(50 / max(highest, 1e-9), min(long) / 8, _BLOCKS[1])
        sizes = np.arange(max(int(ideal / 2), _BLOCKS[0]), max(int(1.5 * ideal), _BLOCKS[0]) + 1)
        change = [max(abs(round(n / b) * b / n - 1) for n in long) for b in sizes]
        best = np.flatnonzero(np.array(change) <= min(change) + 1e-12)
        common = int(sizes[best[np.argmin(np.abs(sizes[best] - ideal))]])
    layout = []
    for length in lengths:
        block = common if length in long else 1
        length = min(round(length / block), samples // block) * block
        step, last = max(int(round(length * (1 - overlap))), 1), samples - length
        ideal = np.linspace(0, last, -(-last // step) + 1)
        starts = last - np.round((last - ideal) / block).astype(int) * block
        layout.append((length, tuple(sorted({max(int(s), 0) for s in (0, *starts[1:])}))))
    return tuple(layout)


class Taper(NamedTuple):
    """A window's shape and what it acts on: so many of the channels, windows from `first` on."""

    shape: str
    channels: int
    first: int = 0


def fourier_sums(
    signals: tuple[Float[np.ndarray, "samples _"], ...],
    angle: Grid,
    windows: Layout,
    tapers: tuple[Taper, ...],
    *,
    detrend: str,
    origin: float,
) -> list[list[Complex[np.ndarray, "frequencies segments _"]]]:
    """`sum_n taper[n] x[start + n] exp(-j angle (origin + start + n))`, by taper and by length.

    `signals` lie side by side, `angle` is in rad per sample. `detrend` removes the "constant" or
    the "linear" trend of every window before the taper, or "none". Accurate to about 2e-13 of the
    largest sum. In memory, the windows of one channel are neighbours.
    """
    angle, samples = np.asarray(angle, float), len(signals[0])
    rows, end = np.empty((sum(x.shape[1] for x in signals), samples)), 0
    for part in signals:
        columns = np.asarray(part, float).T
        begin, end = end, end + len(columns)
        # Near each channel's mean: no trend is left of it, but its rounding errors would be.
        few = columns[:, :: max(samples // _THIN, 1)] if detrend != "none" else np.zeros((1, 1))
        np.subtract(columns, np.mean(few, axis=1, keepdims=True), out=rows[begin:end])
    sums = [
        [np.empty((angle.size, taper.channels, len(s)), complex) for _, s in windows[taper.first :]]
        for taper in tapers
    ]
    long = tuple(group for group in windows if group[0] >= _SHORT)
    blocks = _share_blocks(samples, tuple(angle.tolist()), long) if long else None
    trends = _TRENDS.index(detrend)
    running = _Running(rows, blocks, long, trends) if blocks else None
    for number, (length, starts) in enumerate(windows):
        mine = [(t.shape, part[number - t.first]) for t, part in zip(tapers, sums, strict=True)
                if t.first <= number]  # fmt: skip
        if running is None or length < _SHORT:
            start = np.array(starts)
            segments = np.lib.stride_tricks.sliding_window_view(rows, length, axis=1)[:, start]
            if trends:
                segments = segments - np.mean(segments, axis=2, keepdims=True)
            if trends > 1:
                ramp = np.linspace(-1.0, 1.0, length)
                segments -= (segments @ ramp / np.sum(ramp**2))[:, :, None] * ramp
            middle = np.exp(-1j * angle[:, None] * (start + length / 2))[:, None]
            for shape, part in mine:
                tapered = segments[: part.shape[1]] * window(shape, length)
                part[...] = _from_middle(tapered, angle) * middle
        else:
            running.sum_windows(_place_windows(running.shared, length, starts), mine)
    if origin:
        turn = np.exp(-1j * origin * angle)[:, None, None]
        for part in (part for parts in sums for part in parts):
            part *= turn
    return [[np.swapaxes(part, 1, 2) for part in parts] for parts in sums]


class _Blocks(NamedTuple):
    """Blocks that cover a record: `size` samples each, `lead` of the first before the record."""

    size: int
    lead: int
    count: int
    angle: tuple[float, ...]  # rad per sample
    reach: float  # rad per sample, of the shifted frequencies


@ft.lru_cache(maxsize=16)
def _share_blocks(samples: int, angle: tuple[float, ...], windows: Layout) -> _Blocks:
    """Blocks of about 130 rad, at whose ends as many windows as possible begin and end."""
    highest = float(np.max(np.abs(angle)))
    ideal = int(np.clip(130 / max(highest, 1e-9), *_BLOCKS))
    origin = windows[0][1][-1]
    steps = [[length, *np.array((*starts[1:], origin)) - origin] for length, starts in windows]
    common = int(np.gcd.reduce(np.concatenate(steps).astype(int)))
    fitting = [n for n in range(max(ideal // 3, _BLOCKS[0]), 2 * ideal + 1) if common % n == 0]
    size = min(fitting, key=lambda n: abs(np.log(n / ideal)), default=ideal)
    lead = -origin % size if fitting else 0
    reach = highest + 2 * np.pi / min(length for length, _ in windows)
    return _Blocks(size, lead, -(-(lead + samples) // size), angle, reach)


@ft.lru_cache(maxsize=8)
def _block_functions(size: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal even and odd functions on a block that span all waves up to `reach`."""
    place, nodes = np.arange(size) - (size - 1) / 2, int(reach * size / 2) + 20
    grid = reach * np.cos(np.pi / 2 * np.arange(nodes) / nodes)
    functions = []
    for wave in (np.cos, np.sin):
        vectors, strength, _ = np.linalg.svd(wave(place[:, None] * grid), full_matrices=False)
        few = strength > _TOLERANCE * np.sqrt(size * nodes)
        functions.append(np.ascontiguousarray(vectors[:, few]))
    return functions[0], functions[1]


class _Waves(NamedTuple):
    """exp(-j w n) on blocks at some frequencies."""

    even: Float[np.ndarray, "waves even"]  # coefficients of the blocks' functions
    odd: Float[np.ndarray, "waves odd"]
    phase: Complex[np.ndarray, "waves blocks"]  # at the blocks' middles

    def sums(
        self, coefficients: Sequence[np.ndarray], blocks: slice | np.ndarray
    ) -> Complex[np.ndarray, "waves channels blocks"]:
        """Fourier sums of blocks with these coefficients."""
        even, odd = (part.reshape(len(part), -1) for part in coefficients)
        sums = np.empty((len(self.even), *coefficients[0].shape[1:]), complex)
        sums.real = (self.even @ even).reshape(sums.shape)
        sums.imag = (self.odd @ odd).reshape(sums.shape)
        sums *= self.phase[:, None, blocks]
        return sums


@ft.lru_cache(maxsize=16)
def _block_waves(blocks: _Blocks, shift: float) -> _Waves:
    """At all frequencies; with a shift, at these less it and then at these and it."""
    angle = np.array(blocks.angle)
    angle = np.concatenate([angle - shift, angle + shift]) if shift else angle
    even, odd = _block_functions(blocks.size, blocks.reach)
    place = angle[:, None] * (np.arange(blocks.size) - (blocks.size - 1) / 2)
    # Powers of one turn, whose errors grow slowly: a large angle is rounded before its sine.
    first = np.exp(-1j * angle * ((blocks.size - 1) / 2 - blocks.lead))
    turn = np.repeat(np.exp(-1j * angle * blocks.size)[:, None], blocks.count - 1, axis=1)
    phase = np.cumprod(np.concatenate([first[:, None], turn], axis=1), axis=1)
    return _Waves(np.cos(place) @ even, -np.sin(place) @ odd, phase)


class _Windows(NamedTuple):
    """Where windows of one length begin and end in the blocks."""

    length: int
    start: Int[np.ndarray, " windows"]
    shift: float  # rad per sample, of the taper's waves
    ends: Int[np.ndarray, " ends"]  # samples at which windows begin or end, rising
    turn: Complex[np.ndarray, " windows"]  # phase of the taper's waves at the starts
    middle: Complex[np.ndarray, "frequencies windows"]  # phase there
    place: Int[np.ndarray, " ends"]  # the blocks of the ends
    part: Int[np.ndarray, " parts"]  # which ends lie within a block
    inside: Bool[np.ndarray, "parts samples"]  # the samples of these blocks before them
    first: Int[np.ndarray, " windows"]  # number of each window's begin among the ends
    last: Int[np.ndarray, " windows"]


@ft.lru_cache(maxsize=16)
def _place_windows(blocks: _Blocks, length: int, starts: tuple[int, ...]) -> _Windows:
    start, shift = np.array(starts), 2 * np.pi / length
    ends, number = np.unique(np.concatenate([start, start + length]), return_inverse=True)
    place, beyond = np.divmod(ends + blocks.lead, blocks.size)
    part = np.flatnonzero(beyond)
    inside = np.arange(blocks.size) < beyond[part, None]
    middle = np.exp(-1j * np.array(blocks.angle)[:, None] * (start + length / 2))
    first, last = number[: start.size], number[start.size :]
    turn = np.exp(1j * shift * start)
    return _Windows(length, start, shift, ends, turn, middle, place, part, inside, first, last)


class _Running:
    """The blocks of all channels, their coefficients, and their sums without a taper."""

    def __init__(self, rows: np.ndarray, blocks: _Blocks, windows: Layout, trends: int):
        self.rows, self.shared, self.trends = rows, blocks, trends
        padded = np.zeros((len(rows), blocks.count * blocks.size))
        padded[:, blocks.lead : blocks.lead + rows.shape[1]] = rows
        self.blocks = padded.reshape(len(rows), blocks.count, blocks.size)
        self.coefficients = self._compress(self.blocks)
        placed = [_place_windows(blocks, *group).place for group in windows]
        self.edges = np.unique(np.concatenate(placed))
        self.still = self._sums_to(self.edges, _block_waves(blocks, 0.0))

    def sum_windows(self, windows: _Windows, into: Sequence[tuple[str, np.ndarray]]) -> None:
        """Fill in the sums behind each taper, by frequency, channel and window."""
        still, below, above = self._plain(windows)
        below, above = below * windows.turn.conj(), above * windows.turn
        both, odd = below + above, 0.5j * (below - above)
        trends = self._trends(windows)
        for shape, sums in into:
            level, cosine, sine = waves(shape)
            few = slice(sums.shape[1])
            np.multiply(both[:, few], -cosine / 2, out=sums)
            if level:
                sums += level * still[:, few]
            if sine:
                sums += sine * odd[:, few]
            if self.trends:
                angle = self.shared.angle
                of_trends = _trend_sums(angle, windows.length, shape, self.trends)
                sums -= np.tensordot(of_trends, trends[:, few], 1) * windows.middle[:, None]

    def _compress(self, blocks: np.ndarray) -> list[Float[np.ndarray, "rank channels blocks"]]:
        flat = blocks.reshape(-1, self.shared.size).T
        functions = _block_functions(self.shared.size, self.shared.reach)
        return [(part.T @ flat).reshape(-1, *blocks.shape[:2]) for part in functions]

    def _sums_to(
        self, edges: np.ndarray, waves: _Waves
    ) -> Complex[np.ndarray, "waves channels edges"]:
        """Sums from the first of these blocks to before each of them."""
        channels, count = len(self.rows), edges.size - 1
        running = np.zeros((len(waves.even), channels, edges.size), complex)
        groups = min(-(-channels * (edges[-1] - edges[0]) // _AT_ONCE), count)
        for few in np.array_split(np.arange(count), groups) if count else ():
            used = slice(edges[few[0]], edges[few[-1] + 1])
            sums = waves.sums([part[:, :, used] for part in self.coefficients], used)
            running[:, :, few + 1] = np.add.reduceat(sums, edges[few] - used.start, axis=2)
        return np.cumsum(running, axis=2)

    def _plain(self, windows: _Windows) -> Complex[np.ndarray, "3 frequencies channels windows"]:
        """Sums without a taper: at all frequencies, and at these less and plus the shift."""
        still, shifted = (_block_waves(self.shared, d) for d in (0.0, windows.shift))
        edges, step = np.unique(windows.place, return_inverse=True)
        at_rest = self.still[:, :, np.searchsorted(self.edges, windows.place)]
        running = np.concatenate([at_rest, self._sums_to(edges, shifted)[:, :, step]])
        if windows.part.size:
            place = windows.place[windows.part]
            parts = self._compress(self.blocks[:, place] * windows.inside)
            sums = [wave.sums(parts, place) for wave in (still, shifted)]
            running[:, :, windows.part] += np.concatenate(sums)
        plain = running[:, :, windows.last] - running[:, :, windows.first]
        return plain.reshape(3, -1, *plain.shape[1:])

    def _trends(self, windows: _Windows) -> Float[np.ndarray, "trends channels windows"]:
        """Mean and slope of each window."""
        length, ends, middle = windows.length, windows.ends, self.rows.shape[1] / 2
        parts, moment = [], self.rows[:, : ends[-1]]
        for k in range(self.trends):
            moment = moment * (np.arange(ends[-1]) - middle) if k else moment
            running = np.cumsum(np.add.reduceat(moment, ends[:-1], axis=1), axis=1)
            running = np.pad(running, ((0, 0), (1, 0)))
            parts.append(running[:, windows.last] - running[:, windows.first])
        if self.trends > 1:
            centre = windows.start + (length - 1) / 2 - middle
            parts[1] = (parts[1] - parts[0] * centre) * 12 / (length * (length**2 - 1.0))
        return np.stack([parts[0] / length, *parts[1:]]) if parts else np.zeros((0, 1, 1))


@ft.lru_cache(maxsize=32)
def _trend_sums(
    angle: tuple[float, ...], length: int, shape: str, trends: int
) -> Complex[np.ndarray, "frequencies trends"]:
    """Those of a tapered constant, and of a ramp of slope 1."""
    rows = np.stack([np.ones(length), np.arange(length) - (length - 1) / 2][:trends])
    return _from_middle(rows[:, None] * window(shape, length), np.array(angle))[:, :, 0]


def _from_middle(
    segments: Float[np.ndarray, "channels windows samples"], angle: Grid
) -> Complex[np.ndarray, "frequencies channels windows"]:
    """Fourier sums with phases from the middle of a window, in two steps: few exponentials."""
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
