"""Responses and spectral densities by averages over windows: one length, or several (Composite)."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad._core import Message, one_blas_thread, require_x64
from jaxquad.records import Record

from ._estimators import adjoint, check_band, check_compatible, Grid, in_hertz, Welch
from ._fourier_sums import (
    coefficients,
    fourier_sums,
    lattice_windows,
    Layout,
    segment_starts,
    Taper,
)
from ._noise import shows_leakage


class Slopes(NamedTuple):
    """Transforms behind the derivatives of the windows of one length."""

    first: Complex[np.ndarray, "frequencies _ channels"]  # derivative: inputs, then outputs
    second: Complex[np.ndarray, "frequencies _ inputs"]


class Segments(NamedTuple):
    """Transforms by `Record.names` for each length, in absolute phase; records have gaps."""

    transforms: tuple[Complex[np.ndarray, "frequencies windows channels"], ...]
    slopes: tuple[Slopes, ...]  # empty where they are not needed, or nothing follows from them
    groups: Layout


def transform_records(
    records: Sequence[Record], omega: Grid, members: Sequence[Welch], *, derivatives: int = 0
) -> Segments:
    """Transform all channels of all records; no window spans two records.

    With two `derivatives`, behind those of the windows too, from the first length on whose windows
    can tell leakage from noise: the first on inputs and outputs, the second on inputs.
    """
    require_x64("a frequency response")
    first, welch, dt = records[0], members[0], records[0].dt
    # A single window keeps its length to the sample; several share blocks of samples.
    lengths = tuple(member.length(records) for member in members)
    samples = [record.samples - welch.integrators for record in records]
    if len(members) == 1:
        n, overlap = lengths[0], welch.overlap
        layouts = [((n, segment_starts(count, n, overlap)),) for count in samples]
    else:
        options = welch.overlap, float(np.max(omega)) * dt
        lengths = tuple(n for n, _ in lattice_windows(min(samples), lengths, *options))
        layouts = [lattice_windows(count, lengths, *options) for count in samples]
    inputs = len(first.input_names)
    last = inputs + len(first.output_names)
    counts = [sum(len(mine) for _, mine in groups) for groups in zip(*layouts, strict=True)]
    enough = [shows_leakage(count, inputs) for count in counts]
    start = enough.index(True) if any(enough) else len(counts)
    shape = welch.shape
    slopes = Taper(f"{shape}'", last, start), Taper(f"{shape}''", inputs, start)
    tapers = Taper(shape, len(first.names)), *slopes[:derivatives]
    n, late, angle = welch.integrators, int(round(welch.delay / dt)), omega * dt
    factor = np.ones((omega.size, 1, len(first.names)), complex)
    recolour = np.exp(-1j * (late + n // 2) * angle) / (1 - np.exp(-1j * angle)) ** n
    factor[:, :, inputs:last] = recolour[:, None, None]
    parts, starts, origin = [], [[] for _ in members], 0
    for record, layout in zip(records, layouts, strict=True):
        # The outputs differenced, and earlier by the delay.
        outputs = np.diff(record.outputs, n, axis=0)
        if late:
            outputs = np.concatenate([outputs[late:], np.repeat(outputs[-1:], late, axis=0)])
        # A difference delays by n/2 samples, and the window would act on it like on any delay.
        centre = slice(n - n // 2, record.samples - n // 2)
        columns = record.inputs[centre], outputs, record.references[centre]
        options = {"detrend": welch.detrend, "origin": float(origin)}
        transforms, *derived = fourier_sums(columns, angle, layout, tapers, **options)
        if n or late:
            transforms = [part * factor for part in transforms]
        parts.append([transforms, *derived])
        for mine, (_, local) in zip(starts, layout, strict=True):
            mine += [origin + place for place in local]
        origin += record.samples + max(length for length, _ in layout)
    groups = tuple((n, tuple(mine)) for (n, _), mine in zip(layouts[0], starts, strict=True))

    def side_by_side(part: Sequence[np.ndarray]) -> np.ndarray:
        """The windows of all records, as neighbours in memory."""
        rows = [np.swapaxes(x, 1, 2) for x in part]
        return np.swapaxes(rows[0] if len(rows) == 1 else np.concatenate(rows, axis=2), 1, 2)

    joined, *slopes = (
        tuple(side_by_side(part) for part in zip(*lengths, strict=True))
        for lengths in zip(*parts, strict=True)
    )
    none = Slopes(np.zeros((0, 0, 0), complex), np.zeros((0, 0, 0), complex))
    derived = tuple(map(Slopes, *slopes)) if derivatives else ()
    return Segments(joined, (none,) * (len(joined) - len(derived)) + derived, groups)


def frequencies_for(
    omega: Float[ArrayLike, " frequencies"] | float | int | None,
    records: Sequence[Record],
    welch: Welch,
) -> Grid:
    """`omega` or the default of `welch`, rad/s; `ValueError` where the window is too short."""
    length, dt = welch.length(records), records[0].dt
    seconds = length * dt
    if omega is None:
        # Below three cycles in a window, leakage exceeds the random error of a good record.
        if length <= 30:
            raise ValueError(
                Message(
                    f"a window of {length} samples is too short for frequencies up to a tenth of "
                    "the sample rate: use a longer window («window_length=»)«, or give the "
                    "frequencies (omega=)»"
                )
            )
        return np.geomspace(6 * np.pi / seconds, 2 * np.pi / (10 * dt), 100)
    omega = np.atleast_1d(np.asarray(omega, dtype=float))
    check_band(omega, dt)
    lowest = 2 * np.pi / seconds
    if omega[0] < 0.999 * lowest:
        raise ValueError(
            f"{in_hertz(omega[:1])} is below the lowest frequency that the window of "
            f"{seconds:.4g} s resolves, {lowest:.4g} rad/s (one cycle). Raise it, or use a window "
            f"longer than {2 * np.pi / omega[0]:.4g} s"
        )
    return omega


class SpectralDensity(eqx.Module):
    """One-sided power and cross spectral densities of all channels of a record.

    `density[:, a, b]` is the average of conj(X_a) X_b, scaled so that its integral over the
    positive frequencies in Hz is a power; its unit is that of a times that of b, per Hz.
    """

    omega: Float[Array, " frequencies"]  # rad/s
    density: Complex[Array, "frequencies channels channels"]  # Hermitian
    names: tuple[str, ...] = eqx.field(static=True)

    def power(self, name: str) -> Float[Array, " frequencies"]:
        """Power spectral density of one channel."""
        return jnp.real(self.cross(name, name))

    def cross(self, a: str, b: str) -> Complex[Array, " frequencies"]:
        """Cross-spectral density of `a` and `b`: its phase is that of b minus that of a."""
        return self.density[:, self._position(a), self._position(b)]

    def coherence(self, a: str, b: str) -> Float[Array, " frequencies"]:
        """Magnitude-squared coherence, from 0 to 1."""
        return jnp.abs(self.cross(a, b)) ** 2 / (self.power(a) * self.power(b))

    def _position(self, name: str) -> int:
        if name not in self.names:
            raise ValueError(
                f"there is no channel {name!r}: the channels are {', '.join(self.names)}"
            )
        return self.names.index(name)


@one_blas_thread()
def spectral_density(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | float | int | None = None,
    *,
    welch: Welch | None = None,
) -> SpectralDensity:
    """Estimate the power and cross spectral densities of all channels.

    **Arguments:**

    - `record`: one `Record`, or several with the same channels and sample rate, which are taken
        together.
    - `omega`: frequencies in rad/s, increasing; by default 100 log-spaced ones from three cycles in
        a window to a tenth of the sample rate.
    - `welch`: window and overlap, by default `jq.spectra.Welch()`. Its integrators and delay apply
        to the outputs only.

    **Returns:** a `SpectralDensity`.

    **Raises:**

    - `ValueError`: for frequencies that the window does not resolve, and records that differ.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits; call `jq.enable_x64()` first.
    """
    records = [record] if isinstance(record, Record) else list(record)
    check_compatible(records)
    welch = Welch() if welch is None else welch
    omega = frequencies_for(omega, records, welch)
    segments = transform_records(records, omega, [welch])
    [transforms], [(length, _)] = segments.transforms, segments.groups
    level, cosine = coefficients(welch.shape)
    energy = length * (level**2 + cosine**2 / 2)
    scale = 2 * records[0].dt / (energy * transforms.shape[1])
    put = jax.device_put
    return SpectralDensity(
        put(omega), put(adjoint(transforms) @ transforms * scale), records[0].names
    )


_SECONDS = 0.5  # of a window: motors change their speed little meanwhile
_SHORTEST, _LONGEST = 64, 4096  # samples of a window
_MOST = 200  # windows that are looked at
_STANDS = 13.0  # dB above the floor: noise alone gets there once in a million
_ALSO = 8.0  # dB, of a harmonic, in the median of all windows
_OFTEN = 0.5  # share of the windows


class SpectralLine(NamedTuple):
    """The strongest narrow line of a channel, as `find_line` returns it."""

    omega: float  # rad/s, median of the windows in which it stands out
    low: float  # rad/s; it lies between this and `high` in 90 % of these windows
    high: float
    height: float  # dB above its surroundings, median
    share: float  # of the windows in which it stands out
    harmonics: tuple[int, ...]  # which multiples of it stand out, too
    follows: float  # rank correlation with another channel, -1 to 1; nan without one


def find_line(
    record: Record, channel: str, *, above: float = 0.0, over: str | None = None
) -> SpectralLine | None:
    """Find the strongest narrow line in the spectrum of a channel.

    In each window of half a second the line is the frequency that is highest above the running
    median of its surroundings. Motors and propellers make lines with harmonics that follow the
    throttle; a resonance of the frame stays where it is.

    **Arguments:**

    - `record`: what was flown.
    - `channel`: whose spectrum.
    - `above`: rad/s, below which no line is looked for, such as the top of the identified band.
    - `over`: a channel that the line may follow, such as the throttle.

    **Returns:** a `SpectralLine`; None where none stands 13 dB out of half of the windows.
    """
    size = int(2 ** np.round(np.log2(np.clip(_SECONDS / record.dt, _SHORTEST, _LONGEST))))
    if size > record.samples:
        return None
    starts = np.arange(0, record.samples - size + 1, size // 2)
    places = starts[:: -(-starts.size // _MOST), None] + np.arange(size)
    omega = 2 * np.pi * np.fft.rfftfreq(size, record.dt)
    parts = record.channel(channel)[places]
    spectra = np.fft.rfft((parts - parts.mean(axis=1, keepdims=True)) * np.hanning(size), axis=1)
    level = 10 * np.log10(np.maximum(np.abs(spectra) ** 2, 1e-300))
    reach = max(8, size // 32)
    padded = np.pad(level, ((0, 0), (reach, reach)), mode="reflect")
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1, axis=1)
    excess = level - np.median(around, axis=2)
    excess[:, :4] = -np.inf  # the mean, and what a taper makes of a trend
    searched = np.where(omega > above, excess, -np.inf)
    bins = np.argmax(searched, axis=1)
    heights = np.max(searched, axis=1)
    stands = heights > _STANDS
    if np.mean(stands) < _OFTEN:
        return None
    lines = omega[bins[stands]]
    low, middle, high = np.percentile(lines, [5, 50, 95])
    follows = np.nan
    if over is not None:
        levels = record.channel(over)[places].mean(axis=1)[stands]
        follows = 0.0
        if np.ptp(lines) and np.ptp(levels):  # Spearman's, without a correction for ties
            ranks = [
                np.argsort(np.argsort(x, kind="stable"), kind="stable") for x in (lines, levels)
            ]
            follows = float(np.asarray(np.corrcoef(ranks)).flat[1])
    harmonics, excess, bins = [], excess[stands], bins[stands]
    for multiple in (2, 3, 4):
        near = multiple * bins[:, None] + np.arange(-multiple, multiple + 1)
        if np.median(near[:, -1]) >= excess.shape[1]:
            break
        near = np.minimum(near, excess.shape[1] - 1)
        level = excess[np.arange(len(bins))[:, None], near].max(axis=1)
        harmonics += [multiple] if np.median(level) > _ALSO else []
    return SpectralLine(
        float(middle), float(low), float(high), float(np.median(heights[stands])),
        float(np.mean(stands)), tuple(harmonics), float(follows),
    )  # fmt: skip
