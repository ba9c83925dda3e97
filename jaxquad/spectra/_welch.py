"""Responses and spectral densities by averages over windows: one length, or several (Composite)."""

import functools as ft
import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad._core import one_blas_thread, require_x64
from jaxquad.records import Record

from ._average import average, Averaged, Channels
from ._checks import check_band, check_compatible, check_excitation, in_hertz
from ._error_covariance import ErrorCovariance, place_windows, window_products
from ._estimators import Composite, Welch
from ._feedback import remarks_on_feedback
from ._fourier_sums import (
    coefficients,
    fourier_sums,
    lattice_windows,
    Layout,
    segment_starts,
    Taper,
)
from ._frequency_response import FrequencyResponse
from ._leakage import cross_products, shows_leakage, Slopes
from ._linearity import remarks_on_linearity
from ._noise import covariance_of_windows, smoothed
from ._remarks import Remark, Remarks


_ROUNDING = 1e-14  # of a Fourier sum, relative to the largest value summed
_CORRELATED = 0.5  # average coherence of inputs above which Tischler & Remple, ch. 9, warn
_LOST = 0.9999
_LEAKED = 3.0  # bias over random error, averaged over a third of an octave, that is remarked
_AVERAGED = 0.2  # in ln(omega)
_CYCLES = 2.0  # in a window, below which leakage outweighs what more averages gain
_FEW = (
    "only {count:.1f} independent windows: the coherence is near 1 for any signals, and the error "
    "bars are rough. Record longer, or use a shorter window"
)

Grid = Float[np.ndarray, " frequencies"]
Pairs = Float[np.ndarray, "frequencies outputs inputs"]
Method = Literal["direct", "joint"]


class Segments(NamedTuple):
    """Transforms of one set of windows for each length, in absolute phase.

    Channels are in the order of `Record.names`: inputs, outputs, references. `groups` are the
    lengths and starts in samples, of the records one after the other, with gaps wider than any
    window. `slopes` are those behind the derivatives of the windows.
    """

    transforms: tuple[Complex[np.ndarray, "frequencies windows channels"], ...]
    slopes: tuple[Slopes, ...]  # empty where they are not needed, or nothing follows from them
    groups: Layout


def transform_records(
    records: Sequence[Record], omega: Grid, members: Sequence[Welch], *, derivatives: int = 0
) -> Segments:
    """Transform all channels of all records; no window spans two records.

    With two `derivatives`, behind those of the windows too, from the first length on whose windows
    can tell leakage from noise: the first on all channels but references, the second on inputs.
    """
    require_x64("a frequency response")
    layouts, shape = _layouts(records, omega, members), members[0].shape
    inputs, outputs = len(records[0].input_names), len(records[0].output_names)
    counts = [sum(len(mine) for _, mine in groups) for groups in zip(*layouts, strict=True)]
    enough = [shows_leakage(count, inputs) for count in counts]
    first = enough.index(True) if any(enough) else len(counts)
    slopes = Taper(f"{shape}'", inputs + outputs, first), Taper(f"{shape}''", inputs, first)
    tapers = Taper(shape, len(records[0].names)), *slopes[:derivatives]
    parts, starts, origin = [], [[] for _ in members], 0
    for record, layout in zip(records, layouts, strict=True):
        parts.append(_transform_record(record, omega, members[0], layout, origin, tapers))
        for mine, (_, local) in zip(starts, layout, strict=True):
            mine += [origin + start for start in local]
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


def _layouts(records: Sequence[Record], omega: Grid, members: Sequence[Welch]) -> list[Layout]:
    """Lengths and starts for each record.

    A single window keeps its length to the sample; several take lengths that share blocks of
    samples, because their exact lengths do not matter.
    """
    lengths = tuple(member.length(records) for member in members)
    samples = [record.samples - members[0].integrators for record in records]
    overlap = members[0].overlap
    if len(members) == 1:
        return [((lengths[0], segment_starts(n, lengths[0], overlap)),) for n in samples]
    highest = float(np.max(omega)) * records[0].dt
    shared = tuple(n for n, _ in lattice_windows(min(samples), lengths, overlap, highest))
    return [lattice_windows(n, shared, overlap, highest) for n in samples]


def _transform_record(
    record: Record,
    omega: Grid,
    welch: Welch,
    layout: Layout,
    origin: int,
    tapers: tuple[Taper, ...],
) -> list[list[Complex[np.ndarray, "frequencies _ _"]]]:
    """By taper and then by length; the outputs differenced, and earlier by the delay."""
    n, late = welch.integrators, welch.delay_samples(record)
    outputs = np.diff(record.outputs, n, axis=0)
    if late:
        outputs = np.concatenate([outputs[late:], np.repeat(outputs[-1:], late, axis=0)])
    # A difference delays by n/2 samples, and the window would act on it like on any delay.
    centre = slice(n - n // 2, record.samples - n // 2)
    columns, angle = (record.inputs[centre], outputs, record.references[centre]), omega * record.dt
    transforms, *slopes = fourier_sums(
        columns, angle, layout, tapers, detrend=welch.detrend, origin=float(origin)
    )
    if n or late:
        factor = np.ones((omega.size, len(record.names)), complex)
        first = len(record.input_names)
        recolour = np.exp(-1j * (late + n // 2) * angle) / (1 - np.exp(-1j * angle)) ** n
        factor[:, first : first + record.outputs.shape[1]] = recolour[:, None]
        transforms = [part * factor[:, None] for part in transforms]
    return [transforms, *slopes]


def frequencies_for(
    omega: Float[ArrayLike, " frequencies"] | float | int | None,
    records: Sequence[Record],
    welch: Welch,
) -> Grid:
    """`omega` or the default of `welch`, rad/s; `ValueError` where the window is too short."""
    if omega is None:
        return welch.default_omega(records)
    omega = np.atleast_1d(np.asarray(omega, dtype=float))
    check_band(omega, records[0].dt)
    seconds = welch.length(records) * records[0].dt
    lowest = 2 * np.pi / seconds
    if omega[0] < 0.999 * lowest:
        raise ValueError(
            f"{in_hertz(omega[:1])} is below the lowest frequency that the window of "
            f"{seconds:.4g} s resolves, {lowest:.4g} rad/s (one cycle). Raise it, or use a window "
            f"longer than {2 * np.pi / omega[0]:.4g} s"
        )
    return omega


def _check_windows(
    independent: Sequence[float],
    segments: Segments,
    channels: Channels,
    sums: Complex[np.ndarray, "groups frequencies channels channels"],
    omega: Grid,
    records: Sequence[Record],
    welch: Welch,
) -> None:
    """Raise `ValueError` for too few windows, a constant channel, or rounding errors only."""
    for count, (_, starts) in zip(independent, segments.groups, strict=True):
        if len(starts) <= channels.inputs or count < channels.inputs:
            raise ValueError(
                f"{count:.1f} independent windows are too few for {channels.inputs} inputs: use "
                f"a window shorter than 1/{channels.inputs + 2} of the record, or record longer"
            )
    # Mean power of the inputs and of the instruments, in the longest windows.
    power = np.real(np.diagonal(sums[0], axis1=1, axis2=2)).T / len(segments.groups[0][1])
    first, last = channels.inputs, channels.inputs + channels.outputs
    power = np.concatenate([power[:first], power[last : last + channels.instruments]])
    names = records[0].input_names + records[0].reference_names[: channels.instruments]
    largest = check_excitation(records, "joint" if channels.instruments else "direct")
    gain = coefficients(welch.shape)[0] * welch.length(records)
    for name, level in zip(names, np.sqrt(power), strict=False):
        lost = np.flatnonzero(~(level > _ROUNDING * gain * largest[records[0].names.index(name)]))
        if lost.size:
            raise ValueError(
                f"no excitation at {in_hertz(omega[lost[:1]])}: the spectrum of {name!r} is zero "
                "there. Keep the frequencies within the band that was excited"
            )


@one_blas_thread()
def average_windows(
    records: Sequence[Record], omega: Grid | None, spectra: Welch | Composite, method: Method
) -> FrequencyResponse:
    """Response by averages over tapered windows of one or several lengths."""
    single = isinstance(spectra, Welch)
    members = (spectra,) if single else spectra.windowed(records, omega)
    omega, welch = frequencies_for(omega, records, members[0]), members[0]
    segments = transform_records(records, omega, members, derivatives=2)
    first, dt, groups = records[0], records[0].dt, segments.groups
    instruments = len(first.reference_names) if method == "joint" else 0
    channels = Channels(len(first.input_names), len(first.output_names), instruments)
    independent = _independent(records, groups)
    sums = np.stack([cross_products(part) for part in segments.transforms])
    _check_windows(independent, segments, channels, sums, omega, records, welch)
    lengths = [length for length, _ in groups]
    level, cosine = coefficients(welch.shape)
    energy = level**2 + cosine**2 / 2
    resolving = np.array([np.inf, *lengths[1:]])  # the longest window is used everywhere
    averaged = average(
        segments.transforms,
        sums,
        segments.slopes,
        channels,
        omega,
        window_products(groups, welch.shape),
        np.array([2 * dt / (energy * length) for length in lengths]),  # to one-sided densities
        (omega * dt)[None, :] * resolving[:, None] >= 2 * np.pi * _CYCLES,
        np.maximum(np.array(independent) - channels.inputs + 1, 0.5),
    )
    weights = np.mean(averaged.share, axis=(1, 2))
    freedom = np.mean(averaged.freedom, axis=1)
    levels = weights / np.sqrt(freedom)
    noise = covariance_of_windows(omega * dt, levels, welch.shape, tuple(lengths))
    windows = place_windows(groups, welch.shape, dt, omega[-1] - omega[0])
    counts = tuple(len(starts) for _, starts in groups)
    # Each array once, in one go.
    fields = (omega, averaged.response, averaged.coherence, averaged.random_error,
              averaged.direct_coherence, averaged.multiple_coherence)  # fmt: skip
    on_device = jax.device_put({id(field): field for field in fields})
    grid, response, coherence, random_error, direct, multiple = (
        on_device[id(field)] for field in fields
    )
    return FrequencyResponse(
        omega=grid,
        response=response,
        coherence=coherence,
        random_error=random_error,
        errors=ErrorCovariance(
            omega, averaged.effect, averaged.noise, averaged.share, windows, counts
        ),
        direct_coherence=direct,
        multiple_coherence=multiple,
        method=method,
        input_names=first.input_names,
        output_names=first.output_names,
        remarks=Remarks(ft.partial(_remarks, records, omega, groups, averaged, method)),
        integrators=welch.integrators,
        log_noise_covariance=smoothed(omega, noise, np.sum(weights * freedom, axis=1)),
        resolution=2 * np.pi / (lengths[0] * dt),
        dt=dt,
        hold=first.hold,
        fed_back=bool(first.reference_names),
        input_units=first.input_units,
        output_units=first.output_units,
    )


def _independent(records: Sequence[Record], groups: Layout) -> list[float]:
    """Windows that do not overlap, for each length (n_d)."""
    return [sum(record.samples for record in records) / length for length, _ in groups]


def _remarks(
    records: Sequence[Record], omega: Grid, groups: Layout, averaged: Averaged, method: Method
) -> tuple[Remark, ...]:
    first, most = records[0], max(_independent(records, groups))
    response, coherence, error = averaged.response, averaged.coherence, averaged.random_error
    names, direct = (first.output_names, first.input_names), averaged.direct_coherence
    measured = omega, response, error, coherence, direct
    remarks = remarks_on_feedback(records, method, *measured, names)
    remarks += remarks_on_linearity(records, omega, response, coherence, method)
    remarks += _remarks_on_inputs(omega, 1 - np.nan_to_num(averaged.alone), first.input_names)
    remarks += _remarks_on_leakage(omega, averaged.leakage(), error, names)
    return remarks + ((Remark(_FEW.format(count=most), kind="few windows"),) if most < 3 else ())


def _remarks_on_inputs(
    omega: Grid, coherence: Float[np.ndarray, "frequencies inputs"], names: Sequence[str]
) -> tuple[Remark, ...]:
    """`coherence` is the multiple coherence of each input with all others."""
    if len(names) < 2:
        return ()
    remarks = []
    for i, name in enumerate(names):
        lost = coherence[:, i] > _LOST
        if np.any(lost):
            text = (
                f"input {name} cannot be separated from the other inputs {{where}}; they are left "
                "out. Excite the inputs independently, one after the other or with interleaved "
                "multisines"
            )
            remarks.append(Remark(text, omega[lost], kind="undetermined"))
        elif np.mean(coherence[:, i]) > _CORRELATED:
            text = (
                f"input {name} is correlated with the other inputs: their average coherence is "
                f"{coherence[:, i].mean():.2f} (limit {_CORRELATED}), so the errors of conditioned "
                f"responses are larger. Excite the inputs independently"
            )
            remarks.append(Remark(text, kind="correlated inputs"))
    return tuple(remarks)


def _remarks_on_leakage(
    omega: Grid,
    leakage: Float[np.ndarray, "2 frequencies outputs inputs"],
    error: Pairs,
    names: tuple[Sequence[str], Sequence[str]],
) -> tuple[Remark, ...]:
    """Remarks on pairs whose response leakage biases, clearly and beyond the random error."""
    kernel = np.exp(-0.5 * (np.log(omega[:, None] / omega) / _AVERAGED) ** 2)
    bias, remarks = leakage[0], []
    least = np.maximum(leakage[1], error)
    with np.errstate(invalid="ignore"):
        ratio = np.where(np.isfinite(least) & np.isfinite(bias), bias / least, 0.0)
    for (o, output), (i, source) in itertools.product(*map(enumerate, names)):
        leaked = kernel @ ratio[:, o, i] ** 2 > _LEAKED**2 * np.sum(kernel, axis=1)
        if np.any(leaked):
            text = (
                f"leakage through the window biases the response by about "
                f"{100 * np.median(bias[leaked, o, i]):.2g} % {{where}}; the random error does not "
                "include it. Use «jq.spectra.LocalPolynomial()», which estimates leakage, a longer "
                "window, or «integrators=» where the plant integrates"
            )
            remarks.append(Remark(text, omega[leaked], (output, source), "leakage"))
    return tuple(remarks)


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
    return SpectralDensity(put(omega), put(cross_products(transforms) * scale), records[0].names)
