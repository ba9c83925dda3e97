"""Fourier sums of tapered windows of several lengths, at any frequencies.

A raised cosine is a constant and two waves: behind it, the sum at w is made of those of plain
windows at w and w +- 2 pi / length. Those are differences of running sums over blocks of samples,
which all windows share, so the cost depends neither on their overlap nor on the number of tapers.
Of a block only the few even and odd functions count that these frequencies can tell apart: with
c = w block / 2, about 2 c / pi + O(log c) of them (Slepian; Landau and Widom, 1980).
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxquad._core import require_x64

from ._windows import Layout, waves, window


_SHORT = 128  # samples below which a window is summed directly
_BLOCKS = (32, 1024)  # samples to a block
_TOLERANCE = 6e-14  # of a block's waves; leaves 2e-13 of the largest Fourier sum
_THIN = 256  # samples that show a constant well enough
_TRENDS = ("none", "constant", "linear")

Angles = Float[np.ndarray, " frequencies"]
Sums = Complex[np.ndarray, "frequencies _ windows"]


class Taper(NamedTuple):
    """A window's shape and what it acts on: so many of the channels, windows from `first` on."""

    shape: str
    channels: int
    first: int = 0


def fourier_sums(
    signals: tuple[Float[np.ndarray, "samples _"], ...],
    angle: Angles,
    windows: Layout,
    tapers: tuple[Taper, ...],
    *,
    detrend: str,
    origin: float,
) -> list[list[Complex[np.ndarray, "frequencies segments _"]]]:
    """`sum_n taper[n] x[start + n] exp(-j angle (origin + start + n))`, by taper and by length.

    `signals` lie side by side, `angle` is in rad per sample, and the phase is that of a record
    whose first sample is number `origin`. `detrend` removes the "constant" or the "linear"
    least-squares trend of every window before the taper, or "none". Accurate to about 2e-13 of the
    largest sum. Raises `ValueError` for windows outside the record or frequencies above the Nyquist
    frequency, `PrecisionError` in 32 bits. In memory, the windows of one channel are neighbours.
    """
    require_x64("a transform")
    angle = np.asarray(angle, float)
    samples = len(signals[0])
    _check(samples, angle, windows, detrend)
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
    long = [group for group in windows if group[0] >= _SHORT]
    blocks = _share_blocks(samples, angle, long) if long else None
    running = [_Channel(row, blocks, detrend) for row in rows] if blocks else []
    for number, (length, starts) in enumerate(windows):
        mine = [(t.shape, part[number - t.first]) for t, part in zip(tapers, sums, strict=True)
                if t.first <= number]  # fmt: skip
        if blocks is None or length < _SHORT:
            _sum_directly(rows, angle, length, starts, mine, detrend)
            continue
        placed = _place_windows(blocks, length, starts)
        for c, channel in enumerate(running):
            few = [(shape, part[:, c]) for shape, part in mine if c < part.shape[1]]
            channel.sum_windows(placed, few)
    if origin:
        turn = np.exp(-1j * origin * angle)[:, None, None]
        for part in (part for parts in sums for part in parts):
            part *= turn
    return [[np.swapaxes(part, 1, 2) for part in parts] for parts in sums]


def _check(samples: int, angle: Angles, windows: Layout, detrend: str) -> None:
    if detrend not in _TRENDS:
        raise ValueError(f"detrend is {detrend!r}: use none, constant or linear")
    if not angle.size or not np.all(np.abs(angle) <= np.pi):
        worst = max(angle.tolist(), key=abs, default=None)
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


class _Blocks(NamedTuple):
    """Blocks that cover a record: `size` samples each, `lead` of the first before the record."""

    size: int
    lead: int
    count: int
    angle: tuple[float, ...]  # rad per sample
    reach: float  # rad per sample, of the shifted frequencies


class _Waves(NamedTuple):
    """exp(-j w n) on blocks at some frequencies, as coefficients of the blocks' functions."""

    even: Float[np.ndarray, "frequencies even"]
    odd: Float[np.ndarray, "frequencies odd"]
    phase: Complex[np.ndarray, "frequencies blocks"]  # at the blocks' middles

    def sums(
        self, coefficients: Sequence[Float[np.ndarray, "_ blocks"]]
    ) -> Complex[np.ndarray, "_ blocks"]:
        """Fourier sums of blocks, but for the phase of their middles."""
        sums = np.empty((len(self.even), coefficients[0].shape[1]), complex)
        sums.real, sums.imag = self.even @ coefficients[0], self.odd @ coefficients[1]
        return sums


def _share_blocks(samples: int, angle: Angles, windows: Sequence) -> _Blocks:
    """Blocks of about 50 rad, at whose ends as many windows as possible begin and end.

    But for the first of each length, windows lie on blocks where one divides all their steps.
    """
    highest = float(np.max(np.abs(angle)))
    ideal = int(np.clip(50 / max(highest, 1e-9), *_BLOCKS))
    origin = windows[0][1][-1]
    steps = [[length, *np.array((*starts[1:], origin)) - origin] for length, starts in windows]
    common = int(np.gcd.reduce(np.concatenate(steps).astype(int)))
    fitting = [n for n in range(max(ideal // 3, _BLOCKS[0]), 2 * ideal + 1) if common % n == 0]
    size = min(fitting, key=lambda n: abs(np.log(n / ideal)), default=ideal)
    lead = -origin % size if fitting else 0
    reach = highest + 2 * np.pi / min(length for length, _ in windows)
    return _Blocks(size, lead, -(-(lead + samples) // size), tuple(angle.tolist()), reach)


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


class _Channel:
    """One channel's blocks, their coefficients, and its running sums."""

    def __init__(self, row: Float[np.ndarray, " samples"], blocks: _Blocks, detrend: str):
        self.shared, self.trends = blocks, _TRENDS.index(detrend)
        padded = np.zeros(blocks.count * blocks.size)
        padded[blocks.lead : blocks.lead + row.size] = row
        self.blocks = padded.reshape(blocks.count, blocks.size)
        functions = _block_functions(blocks.size, blocks.reach)
        self.coefficients = [function.T @ self.blocks.T for function in functions]
        still = _block_waves(blocks, 0.0)
        self.still = np.zeros((len(still.even), blocks.count + 1), complex)  # running sums
        np.cumsum(still.sums(self.coefficients) * still.phase, axis=1, out=self.still[:, 1:])
        time = np.arange(row.size) - row.size / 2
        moments = [row, row * time][: self.trends]
        self.moments = [np.concatenate([[0.0], np.cumsum(part)]) for part in moments]

    def sum_windows(
        self,
        windows: "_Windows",
        into: Sequence[tuple[str, Complex[np.ndarray, "frequencies windows"]]],
    ) -> None:
        """Fill in the sums behind each taper."""
        still, below, above = self._plain(windows)
        below, above = below * windows.turn.conj(), above * windows.turn
        trends = self._trends(windows.start, windows.length)
        both, odd = below + above, 0.5j * (below - above)
        for shape, sums in into:
            level, cosine, sine = waves(shape)
            np.multiply(both, -cosine / 2, out=sums)
            if level:
                sums += level * still
            if sine:
                sums += sine * odd
            if self.trends:
                angle = self.shared.angle
                coefficients = _trend_sums(angle, windows.length, shape, self.trends)
                sums -= coefficients @ trends * windows.middle

    def _plain(self, windows: "_Windows") -> Complex[np.ndarray, "3 frequencies windows"]:
        """Sums without a taper: at all frequencies, at these less the shift, and more."""
        count, place, used = len(self.still), windows.place, windows.used
        still, shifted = (_block_waves(self.shared, d) for d in (0.0, windows.shift))
        running = np.zeros((3 * count, place.size), complex)
        running[:count] = self.still[:, place]
        if windows.steps.size:
            moving = shifted.sums([rows[:, used] for rows in self.coefficients])
            moving *= shifted.phase[:, used]
            sums = np.cumsum(np.add.reduceat(moving, windows.steps, axis=1), axis=1)
            later = windows.step > 0
            running[count:, later] = sums[:, windows.step[later] - 1]
        part = windows.part
        if part.size:
            samples = (self.blocks[place[part]] * windows.inside).T
            functions = _block_functions(self.shared.size, self.shared.reach)
            few = [function.T @ samples for function in functions]
            rest = [wave.sums(few) * wave.phase[:, place[part]] for wave in (still, shifted)]
            running[:, part] += np.concatenate(rest)
        plain = running[:, windows.last] - running[:, windows.first]
        return plain.reshape(3, count, -1)

    def _trends(
        self, start: Int[np.ndarray, " windows"], length: int
    ) -> Float[np.ndarray, "trends windows"]:
        """Mean and slope of each window."""
        parts = [part[start + length] - part[start] for part in self.moments]
        if self.trends > 1:
            middle = start + (length - 1) / 2 - (self.moments[0].size - 1) / 2
            parts[1] = (parts[1] - parts[0] * middle) * 12 / (length * (length**2 - 1.0))
        return np.stack([parts[0] / length, *parts[1:]]) if parts else np.zeros((0, start.size))


class _Windows(NamedTuple):
    """Where windows of one length begin and end in the blocks."""

    length: int
    start: Int[np.ndarray, " windows"]
    shift: float  # rad per sample, of the taper's waves
    turn: Complex[np.ndarray, " windows"]  # their phase at the starts
    middle: Complex[np.ndarray, "frequencies windows"]  # phase there
    place: Int[np.ndarray, " ends"]  # blocks with an end, rising
    part: Int[np.ndarray, " parts"]  # which ends lie within a block
    inside: Bool[np.ndarray, "parts samples"]  # the samples of these blocks before them
    used: slice  # blocks from the first to before the last end
    steps: Int[np.ndarray, " steps"]  # of these, at which new sums begin
    step: Int[np.ndarray, " ends"]  # number of each end's block among those with an end
    first: Int[np.ndarray, " windows"]  # number of each window's begin among the ends
    last: Int[np.ndarray, " windows"]


@ft.lru_cache(maxsize=16)
def _place_windows(blocks: _Blocks, length: int, starts: tuple[int, ...]) -> _Windows:
    start, shift = np.array(starts), 2 * np.pi / length
    ends, number = np.unique(
        np.concatenate([start, start + length]) + blocks.lead, return_inverse=True
    )
    place, beyond = np.divmod(ends, blocks.size)
    filled, step = np.unique(place, return_inverse=True)
    part = np.flatnonzero(beyond)
    inside = np.arange(blocks.size) < beyond[part, None]
    angle = np.array(blocks.angle)
    turn = np.exp(1j * shift * start)
    middle = np.exp(-1j * angle[:, None] * (start + length / 2))
    used, steps = slice(int(filled[0]), int(filled[-1])), filled[:-1] - filled[0]
    first, last = number[: start.size], number[start.size :]
    return _Windows(
        length, start, shift, turn, middle, place, part, inside, used, steps, step, first, last
    )


@ft.lru_cache(maxsize=32)
def _trend_sums(
    angle: tuple[float, ...], length: int, shape: str, trends: int
) -> Complex[np.ndarray, "frequencies trends"]:
    """Those of a tapered constant, and of a ramp of slope 1."""
    rows = np.stack([np.ones(length), np.arange(length) - (length - 1) / 2][:trends])
    return _from_middle(rows[:, None] * window(shape, length), np.array(angle))[:, :, 0]


def _sum_directly(
    rows: Float[np.ndarray, "channels samples"],
    angle: Angles,
    length: int,
    starts: tuple[int, ...],
    into: Sequence[tuple[str, Sums]],
    detrend: str,
) -> None:
    """The sums of short windows."""
    start = np.array(starts)
    segments = np.lib.stride_tricks.sliding_window_view(rows, length, axis=1)[:, start]
    if detrend != "none":
        segments = segments - np.mean(segments, axis=2, keepdims=True)
    if detrend == "linear":
        ramp = np.linspace(-1.0, 1.0, length)
        segments -= (segments @ ramp / np.sum(ramp**2))[:, :, None] * ramp
    middle = np.exp(-1j * angle[:, None] * (start + length / 2))[:, None]
    for shape, sums in into:
        tapered = segments[: sums.shape[1]] * window(shape, length)
        sums[...] = _from_middle(tapered, angle) * middle


def _from_middle(
    segments: Float[np.ndarray, "channels windows samples"], angle: Angles
) -> Complex[np.ndarray, "frequencies channels windows"]:
    """Fourier sums with phases from the middle of a window.

    Within short blocks and then over the blocks, so that few exponentials are needed.
    """
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
