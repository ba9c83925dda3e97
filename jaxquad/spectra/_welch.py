"""Responses by averages over windows: one length (Welch) or several (Composite)."""

import functools as ft
import itertools
from collections.abc import Sequence
from typing import Literal, NamedTuple

import jax
import numpy as np
from jaxtyping import ArrayLike, Bool, Complex, Float

from jaxquad._core import one_blas_thread, require_x64
from jaxquad.records import Record

from ._average import average, Averaged, Channels
from ._checks import check_band, check_excitation, in_hertz
from ._error_covariance import ErrorCovariance, place_windows, window_products
from ._estimators import Composite, Welch
from ._feedback import remarks_on_feedback
from ._fourier_sums import fourier_sums, Taper
from ._frequency_response import FrequencyResponse
from ._invariance import remarks_on_linearity
from ._leakage import cross_products, shows_leakage, Slopes
from ._noise import covariance_of_windows, smoothed
from ._remarks import Remark, Remarks
from ._windows import coefficients, lattice_windows, Layout, segment_starts


class Segments(NamedTuple):
    """Transforms of one set of windows for each length, in absolute phase.

    Channels are in the order of `Record.names`: inputs, outputs, references. `groups` are the
    lengths and starts in samples, of the records one after the other, with gaps wider than any
    window. `slopes` are those behind the derivatives of the windows.
    """

    transforms: tuple[Complex[np.ndarray, "frequencies windows channels"], ...]
    slopes: tuple[Slopes, ...]  # empty where nothing can be made of them, or nobody asked
    groups: Layout


def transform_records(
    records: Sequence[Record],
    omega: Float[np.ndarray, " frequencies"],
    members: Sequence[Welch],
    *,
    derivatives: int = 0,
) -> Segments:
    """Transform all channels of all records; no window spans two records.

    With two `derivatives`, behind those of the windows too.
    """
    require_x64("a frequency response")
    layouts = _layouts(records, omega, members)
    parts, starts, origin = [], [[] for _ in members], 0
    tapers = _tapers(records[0], members[0], layouts, derivatives)
    for record, layout in zip(records, layouts, strict=True):
        parts.append(_transform_record(record, omega, members[0], layout, origin, tapers))
        for mine, (_, local) in zip(starts, layout, strict=True):
            mine += [origin + start for start in local]
        origin += record.samples + max(length for length, _ in layout)
    lengths = [length for length, _ in layouts[0]]
    groups = tuple(zip(lengths, map(tuple, starts), strict=True))
    joined, *slopes = (
        tuple(_joined(part) for part in zip(*each, strict=True))
        for each in zip(*parts, strict=True)
    )
    none = Slopes(np.zeros((0, 0, 0), complex), np.zeros((0, 0, 0), complex))
    known = tuple(map(Slopes, *slopes)) if derivatives else ()
    return Segments(joined, (none,) * (len(joined) - len(known)) + known, groups)


def _tapers(
    record: Record, welch: Welch, layouts: Sequence[Layout], derivatives: int
) -> tuple[Taper, ...]:
    """The window on all channels, its derivatives on all but references, and on inputs.

    Derivatives from the first length on whose windows can tell leakage from noise.
    """
    inputs, outputs = len(record.input_names), len(record.output_names)
    counts = [sum(len(mine) for _, mine in each) for each in zip(*layouts, strict=True)]
    enough = [shows_leakage(count, inputs) for count in counts]
    first = enough.index(True) if any(enough) else len(counts)
    slopes = (
        Taper(f"{welch.shape}'", inputs + outputs, first),
        Taper(f"{welch.shape}''", inputs, first),
    )
    return Taper(welch.shape, len(record.names)), *slopes[:derivatives]


def _joined(
    parts: Sequence[Complex[np.ndarray, "frequencies _ channels"]],
) -> Complex[np.ndarray, "frequencies windows channels"]:
    # Windows stay neighbours in memory.
    rows = [np.swapaxes(part, 1, 2) for part in parts]
    return np.swapaxes(rows[0] if len(rows) == 1 else np.concatenate(rows, axis=2), 1, 2)


def _layouts(
    records: Sequence[Record], omega: Float[np.ndarray, " frequencies"], members: Sequence[Welch]
) -> list[Layout]:
    """Lengths and starts for each record.

    A single window keeps its length to the sample; several take lengths that share blocks of
    samples, because their exact lengths do not matter.
    """
    # By way of the class: a method bound to a module takes as long to make as a product.
    lengths = tuple(Welch.length(member, records) for member in members)
    samples = [record.samples - members[0].integrators for record in records]
    overlap = members[0].overlap
    if len(members) == 1:
        return [((lengths[0], segment_starts(n, lengths[0], overlap)),) for n in samples]
    highest = float(np.max(omega)) * records[0].dt
    shared = tuple(n for n, _ in lattice_windows(min(samples), lengths, overlap, highest))
    return [lattice_windows(n, shared, overlap, highest) for n in samples]


def _transform_record(
    record: Record,
    omega: Float[np.ndarray, " frequencies"],
    welch: Welch,
    layout: Layout,
    origin: int,
    tapers: tuple[Taper, ...],
) -> list[list[Complex[np.ndarray, "frequencies _ _"]]]:
    """By taper and then by length."""
    columns = _columns(record, welch)
    made = fourier_sums(
        columns, omega * record.dt, layout, tapers, detrend=welch.detrend, origin=float(origin)
    )
    n, late = welch.integrators, Welch.delay_samples(welch, record)
    if not (n or late):
        return made
    found, *slopes = made
    angle = omega * record.dt
    factor = np.ones((omega.size, len(record.names)), complex)
    first = len(record.input_names)
    recolour = np.exp(-1j * (late + n // 2) * angle) / (1 - np.exp(-1j * angle)) ** n
    factor[:, first : first + record.outputs.shape[1]] = recolour[:, None]
    return [[part * factor[:, None] for part in found], *slopes]


def _columns(record: Record, welch: Welch) -> tuple[Float[np.ndarray, "samples _"], ...]:
    """Inputs, outputs, references; the outputs differenced and earlier by the delay."""
    n, late = welch.integrators, Welch.delay_samples(welch, record)
    outputs = np.diff(record.outputs, n, axis=0)
    if late:
        outputs = np.concatenate([outputs[late:], np.repeat(outputs[-1:], late, axis=0)])
    # A difference delays by n/2 samples, and the window would act on it like on any delay.
    centre = slice(n - n // 2, record.samples - n // 2)
    return record.inputs[centre], outputs, record.references[centre]


_ROUNDING = 1e-14  # of a Fourier sum, relative to the largest value summed


def check_windows(independent: Sequence[float], segments: Segments, channels: Channels) -> None:
    """Raise `ValueError` where there are too few windows to separate the inputs."""
    for count, (_, starts) in zip(independent, segments.groups, strict=True):
        if len(starts) <= channels.inputs or count < channels.inputs:
            raise ValueError(
                f"{count:.1f} independent windows are too few for {channels.inputs} inputs: use "
                f"a window shorter than 1/{channels.inputs + 2} of the record, or record longer"
            )


def check_spectrum(
    omega: Float[np.ndarray, " frequencies"],
    power: Float[np.ndarray, "channels frequencies"],
    records: Sequence[Record],
    welch: Welch,
    method: Literal["direct", "joint"],
) -> None:
    """Raise `ValueError` for a constant channel, or a spectrum of rounding errors only."""
    first = records[0]
    names = first.input_names + (first.reference_names if method == "joint" else ())
    largest = check_excitation(records, method)
    gain = coefficients(welch.shape)[0] * Welch.length(welch, records)
    for name, level in zip(names, np.sqrt(power), strict=False):
        lost = np.flatnonzero(~(level > _ROUNDING * gain * largest[first.names.index(name)]))
        if lost.size:
            raise ValueError(
                f"no excitation at {in_hertz(omega[lost[:1]])}: the spectrum of {name!r} is zero "
                "there. Keep the frequencies within the band that was excited"
            )


def frequencies_for(
    omega: Float[ArrayLike, " frequencies"] | float | int | None,
    records: Sequence[Record],
    welch: Welch,
) -> Float[np.ndarray, " frequencies"]:
    """`omega` or the default of `welch`, rad/s; `ValueError` where the window is too short."""
    if omega is None:
        return Welch.default_omega(welch, records)
    omega = np.atleast_1d(np.asarray(omega, dtype=float))
    check_band(omega, records[0].dt)
    seconds = Welch.length(welch, records) * records[0].dt
    lowest = 2 * np.pi / seconds
    if omega[0] < 0.999 * lowest:
        raise ValueError(
            f"{in_hertz(omega[:1])} is below the lowest frequency that the window of "
            f"{seconds:.4g} s resolves, {lowest:.4g} rad/s (one cycle). Raise it, or use a window "
            f"longer than {2 * np.pi / omega[0]:.4g} s"
        )
    return omega


_TOGETHER = 0.5  # average coherence between inputs above which Tischler & Remple, ch. 9, warn
_LOST = 0.9999


def remarks_on_inputs(
    omega: Float[np.ndarray, " frequencies"],
    coherence: Float[np.ndarray, "frequencies inputs"],
    names: Sequence[str],
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
            remarks.append(Remark(text, omega[lost]))
        elif np.mean(coherence[:, i]) > _TOGETHER:
            text = (
                f"input {name} is correlated with the other inputs: their average coherence is "
                f"{coherence[:, i].mean():.2f} (limit {_TOGETHER}), so the errors of conditioned "
                f"responses are larger. Excite the inputs independently"
            )
            remarks.append(Remark(text))
    return tuple(remarks)


_LEAKED = 3.0  # bias over random error, averaged over a third of an octave, that is remarked
_AVERAGED = 0.2  # in ln(omega)


def remarks_on_leakage(
    omega: Float[np.ndarray, " frequencies"],
    leakage: Float[np.ndarray, "2 frequencies outputs inputs"],
    error: Float[np.ndarray, "frequencies outputs inputs"],
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
            remarks.append(Remark(text, omega[leaked], (output, source)))
    return tuple(remarks)


Method = Literal["direct", "joint"]
_CYCLES = 2.0  # in a window, below which leakage outweighs what more averages gain
_FEW = (
    "only {count:.1f} independent windows: the coherence is near 1 for any signals, and the error "
    "bars are rough. Record longer, or use a shorter window"
)


@one_blas_thread()
def average_windows(
    records: Sequence[Record],
    omega: Float[np.ndarray, " frequencies"] | None,
    spectra: Welch | Composite,
    method: Method,
) -> FrequencyResponse:
    """Response by averages over tapered windows of one or several lengths."""
    members = (
        (spectra,) if isinstance(spectra, Welch) else Composite.windowed(spectra, records, omega)
    )
    omega = frequencies_for(omega, records, members[0])
    segments = transform_records(records, omega, members, derivatives=2)
    channels = _channels(records[0], method)
    independent = _independent(records, segments.groups)
    check_windows(independent, segments, channels)
    sums = np.stack([cross_products(part) for part in segments.transforms])
    check_spectrum(omega, _excitation(sums, segments, channels), records, members[0], method)
    overlap = window_products(segments.groups, members[0].shape)
    found = average(
        segments.transforms, sums, segments.slopes, channels, omega, overlap,
        _scales(segments, members[0], records[0].dt), _resolved(segments, omega * records[0].dt),
        np.maximum(np.array(independent) - channels.inputs + 1, 0.5),
    )  # fmt: skip
    return _result(records, omega, members, segments, found, method)


def _channels(record: Record, method: Method) -> Channels:
    instruments = len(record.reference_names) if method == "joint" else 0
    return Channels(len(record.input_names), len(record.output_names), instruments)


def _excitation(
    sums: Complex[np.ndarray, "groups frequencies channels channels"],
    segments: Segments,
    channels: Channels,
) -> Float[np.ndarray, "moving frequencies"]:
    """Mean power of the inputs and of the instruments, in the longest windows."""
    windows = len(segments.groups[0][1])
    power = np.real(np.diagonal(sums[0], axis1=1, axis2=2)).T / windows
    first, last = channels.inputs, channels.inputs + channels.outputs
    return np.concatenate([power[:first], power[last : last + channels.instruments]])


def _independent(records: Sequence[Record], groups: Layout) -> list[float]:
    """Windows that do not overlap, for each length (n_d)."""
    return [sum(record.samples for record in records) / length for length, _ in groups]


def _scales(segments: Segments, welch: Welch, dt: float) -> Float[np.ndarray, " groups"]:
    """From mean squared transforms to one-sided densities."""
    level, cosine = coefficients(welch.shape)
    energy = level**2 + cosine**2 / 2
    return np.array([2 * dt / (energy * length) for length, _ in segments.groups])


def _resolved(
    segments: Segments, angle: Float[np.ndarray, " frequencies"]
) -> Bool[np.ndarray, "groups frequencies"]:
    """Where a window holds `_CYCLES` cycles; the longest window is used everywhere."""
    lengths = np.array([length for length, _ in segments.groups], float)
    lengths[0] = np.inf
    return angle[None, :] * lengths[:, None] >= 2 * np.pi * _CYCLES


def _result(
    records: Sequence[Record],
    omega: Float[np.ndarray, " frequencies"],
    members: Sequence[Welch],
    segments: Segments,
    found: Averaged,
    method: Method,
) -> FrequencyResponse:
    first, dt = records[0], records[0].dt
    counts = tuple(len(starts) for _, starts in segments.groups)
    windows = place_windows(segments.groups, members[0].shape, dt, omega[-1] - omega[0])
    parts = (
        omega, found.response, found.coherence, found.random_error,
        found.direct_coherence, found.multiple_coherence,
    )  # fmt: skip
    grid, response, coherence, random_error, direct, multiple = _on_device(parts)
    return FrequencyResponse(
        omega=grid,
        response=response,
        coherence=coherence,
        random_error=random_error,
        errors=ErrorCovariance(omega, found.effect, found.noise, found.share, windows, counts),
        direct_coherence=direct,
        multiple_coherence=multiple,
        method=method,
        input_names=first.input_names,
        output_names=first.output_names,
        remarks=Remarks(ft.partial(_remarks, records, omega, segments.groups, found, method)),
        integrators=members[0].integrators,
        log_noise_covariance=_log_noise_covariance(omega, dt, members[0], segments, found),
        resolution=2 * np.pi / (segments.groups[0][0] * dt),
        dt=dt,
        hold=first.hold,
        fed_back=bool(first.reference_names),
        input_units=first.input_units,
        output_units=first.output_units,
    )


def _on_device(parts: Sequence[np.ndarray]) -> list[jax.Array]:
    """Each once, in one go."""
    once = {id(part): part for part in parts}
    put = jax.device_put(once)
    return [put[id(part)] for part in parts]


def _remarks(
    records: Sequence[Record],
    omega: Float[np.ndarray, " frequencies"],
    groups: Layout,
    found: Averaged,
    method: Method,
) -> tuple[Remark, ...]:
    first, independent = records[0], _independent(records, groups)
    response, coherence, error = found.response, found.coherence, found.random_error
    names, direct = (first.output_names, first.input_names), found.direct_coherence
    measured = omega, response, error, coherence, direct
    remarks = remarks_on_feedback(records, method, *measured, names)
    remarks += remarks_on_linearity(records, omega, response, coherence, method)
    shared = 1 - np.nan_to_num(found.alone)
    remarks += remarks_on_inputs(omega, shared, first.input_names)
    remarks += remarks_on_leakage(omega, found.leakage(), error, names)
    few = max(independent) < 3
    return remarks + ((Remark(_FEW.format(count=max(independent))),) if few else ())


def _log_noise_covariance(
    omega: Float[np.ndarray, " frequencies"],
    dt: float,
    welch: Welch,
    segments: Segments,
    found: Averaged,
) -> Float[np.ndarray, "frequencies frequencies"]:
    weights, freedom = np.mean(found.share, axis=(1, 2)), np.mean(found.freedom, axis=1)
    lengths = tuple(length for length, _ in segments.groups)
    single = covariance_of_windows(omega * dt, weights / np.sqrt(freedom), welch.shape, lengths)
    return smoothed(omega, single, np.sum(weights * freedom, axis=1))
