"""Responses, coherence and errors by averages over windows: one length, or several (Composite)."""

import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import ArrayLike, Complex, Float

from jaxquad._core import Message, one_blas_thread, require_x64
from jaxquad.records import Record

from ._error_covariance import ErrorCovariance, place_windows, window_products
from ._estimators import (
    adjoint,
    check_band,
    check_excitation,
    Composite,
    diagonal,
    Grid,
    in_hertz,
    Method,
    Pairs,
    power_of,
    Remark,
    Responses,
    Welch,
)
from ._fourier_sums import (
    coefficients,
    fourier_sums,
    lattice_windows,
    Layout,
    segment_starts,
    Taper,
)
from ._frequency_response import Estimate
from ._noise import (
    covariance_of_windows,
    noise_root,
    padded,
    Resolved,
    shows_leakage,
    smoothed,
    without_leakage,
)


_ROUNDING = 1e-14  # of a Fourier sum, relative to the largest value summed
_CORRELATED = 0.5  # average coherence of inputs above which Tischler & Remple, ch. 9, warn
_LOST = 0.9999
_LEAKED = 3.0  # bias over random error, averaged over a third of an octave, that is remarked
_AVERAGED = 0.2  # in ln(omega)
_FEW = (
    "only {count:.1f} independent windows: the coherence is near 1 for any signals, and the error "
    "bars are rough. Record longer, or use a shorter window"
)
_TINY = 1e-300
_COHERENCE_WEIGHT = 5.0
_STEPS = 5  # of Gauss-Newton; each gains two digits or more
_DEPENDENT = 1e-4  # share of an input's power below which it cannot be separated from the others
_CYCLES = 2.0  # in a window, below which leakage outweighs what more averages gain

Shares = Float[np.ndarray, "frequencies outputs inputs groups"]
Products = Complex[np.ndarray, "groups frequencies channels channels"]
Counts = Float[np.ndarray, " groups"]
_Powers = Float[np.ndarray, "*groups frequencies inputs"]
_Pairs = Float[np.ndarray, "*groups frequencies outputs inputs"]


class Channels(NamedTuple):
    """How many channels are inputs, outputs and instruments; without instruments, inputs serve."""

    inputs: int
    outputs: int
    instruments: int

    def split(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Instruments, inputs and outputs along the last axis."""
        n, m = self.inputs, self.inputs + self.outputs
        x = rows[..., :n]
        return (rows[..., m : m + n] if self.instruments else x), x, rows[..., n:m]


class Conditioned(NamedTuple):
    """Responses of each window length, and the spectra of each pair without the other inputs."""

    response: Complex[np.ndarray, "*groups frequencies outputs inputs"]
    solver: Complex[np.ndarray, "*groups frequencies inputs inputs"]  # (Z* X)^-1
    power: _Powers  # of an input that no other input explains
    alone: _Powers  # share of the input's power that no other input explains
    output_power: _Pairs  # less the other inputs'
    coherence: _Pairs  # partial
    instrument_share: _Powers  # of an input's power
    multiple: Float[np.ndarray, "*groups frequencies outputs"]  # coherence with all inputs


def condition(products: Products, channels: Channels, counts: Counts) -> Conditioned:
    """`(Z* X)^-1 Z* Y` from sums of `conj(a) b` (Bendat, Piersol ch. 7; Tischler, Remple ch. 9)."""

    def inverse(matrix: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """That of matrices in any units, which `rows` and `columns` are."""
        if matrix.shape[-1] == 1:
            return 1 / matrix
        units = columns[..., :, None] * rows[..., None, :]
        scaled = matrix / np.swapaxes(units, 2, 3)
        try:
            return np.linalg.inv(scaled) / units
        except np.linalg.LinAlgError:  # One of many is singular to the last digit: make it huge.
            return np.linalg.inv(scaled + 1e-15 * np.eye(matrix.shape[-1])) / units

    z, x, y = channels.split(np.arange(products.shape[-1]))
    power = diagonal(products)
    size = np.sqrt(np.maximum(power, _TINY))
    from_z = products[:, :, z]
    solver = inverse(from_z[..., x], size[..., z], size[..., x])
    response = np.swapaxes(solver @ from_z[..., y], 2, 3)
    # What the instruments move of the inputs, and the diagonal of its inverse.
    if channels.instruments:
        inverted = solver @ from_z[..., z] @ adjoint(solver)
        least = np.maximum(diagonal(inverted), _TINY)
        moving = inverse(inverted, np.sqrt(least), np.sqrt(least))
    else:  # Rounding may make what is singular negative.
        least, moving = np.maximum(np.abs(diagonal(solver)), _TINY), from_z[..., x]
    explained = np.sum(np.conj(response) * (response @ np.swapaxes(moving, 2, 3)), axis=3).real
    total = power[..., y]
    through = power_of(response) / least[:, :, None]
    rest = np.maximum(total - explained, 0.0)
    answer = rest[..., None] + through
    count = counts[:, None, None]
    share = 1 / (least * np.maximum(diagonal(moving), _TINY))
    moved = np.minimum(diagonal(moving) / np.maximum(power[..., x], _TINY), 1.0)
    multiple = np.clip(1 - rest / np.maximum(total, _TINY), 0.0, 1.0)
    return Conditioned(
        response, solver, 1 / (least * count), share, answer / count[..., None],
        through / np.maximum(answer, _TINY), moved, multiple,
    )  # fmt: skip


def combine(
    parts: Conditioned, scales: Counts, freedom: Counts, resolved: Resolved
) -> tuple[Responses, Pairs, Shares]:
    """Response, coherence and the share of each window length in the response.

    The spectra are weighted by W_i = (eps_i / eps_min)^-4, and one set is fitted to them.

    The cost (Tischler & Remple eq. 10.4), each part relative to its mean under W_i^2 (G_xx~ ...),
    is

        sum_i W_i {(G_xx - G_xx,i)^2 + (G_yy - G_yy,i)^2 + |G_xy - G_xy,i|^2 + 5 (g^2 - g_i^2)^2}

    with |G_xy~| for Re G_xy~ and Im G_xy~, one of which may be zero. The phase is that of the mean.
    """
    averages = 2 * freedom[:, None, None, None]
    error = (1 - parts.coherence + 1e-12) / (np.maximum(parts.coherence, 1e-12) * averages)
    weight = (np.min(error, axis=0, keepdims=True) / error) ** 2
    weight = np.where(resolved[:, :, None, None], weight, 0.0)
    scale = scales[:, None, None, None]
    gain, answer = parts.power[:, :, None, :] * scale, parts.output_power * scale
    cross = parts.response * gain
    pilot, mean = (w / np.sum(w, axis=0, keepdims=True) for w in (weight**2, weight))
    xx, yy, gg = (np.sum(pilot * part, axis=0) for part in (gain, answer, parts.coherence))
    xy = np.abs(np.sum(pilot * cross, axis=0))
    along = np.sum(mean * cross, axis=0)
    size = np.abs(along)
    targets = np.stack([
        np.sum(mean * gain, axis=0) / xx,
        np.sum(mean * answer, axis=0) / yy,
        size / xy,
        np.sum(mean * parts.coherence, axis=0) / gg,
    ])  # fmt: skip
    level = xy**2 / (xx * yy)
    # Minimise (a - a0)^2 + (b - b0)^2 + (r - r0)^2 + 5 (level r^2 / (a b) - q0)^2.
    u, level_q = targets[:3], level / gg
    for _ in range(_STEPS):
        q = level_q * u[2] ** 2 / (u[0] * u[1])
        slopes = np.stack([-q / u[0], -q / u[1], 2 * q / u[2]])
        # Normal equations of identity plus one rank, by Sherman and Morrison.
        norm, away = np.sum(slopes**2, axis=0), np.sum((targets[:3] - u) * slopes, axis=0)
        correction = _COHERENCE_WEIGHT * (targets[3] - q - away) / (1 + _COHERENCE_WEIGHT * norm)
        u = targets[:3] + correction[None] * slopes
    a, b, r = u
    moved = np.sum(mean * parts.instrument_share[:, :, None, :], axis=0)
    share = mean * gain / np.sum(mean * gain, axis=0, keepdims=True)
    response = along * (r / a * xy / xx / size)
    return response, np.minimum(r**2 / (a * b) * level, moved), np.moveaxis(share, 0, -1)


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


@one_blas_thread()
@np.errstate(divide="ignore", invalid="ignore", over="ignore")
def average_windows(
    records: Sequence[Record], omega: Grid | None, spectra: Welch | Composite, method: Method
) -> Estimate:
    """Response by averages over tapered windows of one or several lengths."""
    single = isinstance(spectra, Welch)
    members = (spectra,) if single else spectra.windowed(records, omega)
    omega, welch = frequencies_for(omega, records, members[0]), members[0]
    segments = transform_records(records, omega, members, derivatives=2)
    first, dt, groups = records[0], records[0].dt, segments.groups
    instruments = len(first.reference_names) if method == "joint" else 0
    channels = Channels(len(first.input_names), len(first.output_names), instruments)
    lengths, starts = zip(*groups, strict=True)
    many = tuple(map(len, starts))
    independent = sum(record.samples for record in records) / np.array(lengths)  # n_d
    sums = np.stack([adjoint(part) @ part for part in segments.transforms])
    for count, windows in zip(independent, many, strict=True):
        if windows <= channels.inputs or count < channels.inputs:
            raise ValueError(
                f"{count:.1f} independent windows are too few for {channels.inputs} inputs: use "
                f"a window shorter than 1/{channels.inputs + 2} of the record, or record longer"
            )
    # Mean power of the inputs and of the instruments, in the longest windows.
    power = diagonal(sums[0]) / many[0]
    largest = check_excitation(records, method)
    for name in first.input_names + first.reference_names[:instruments]:
        place = first.names.index(name)
        least = _ROUNDING * coefficients(welch.shape)[0] * welch.length(records) * largest[place]
        lost = np.flatnonzero(~(np.sqrt(power[:, place]) > least))
        if lost.size:
            raise ValueError(
                f"no excitation at {in_hertz(omega[lost[:1]])}: the spectrum of {name!r} is zero "
                "there. Keep the frequencies within the band that was excited"
            )
    transforms, counts = segments.transforms, np.array(many, float)
    overlap = window_products(groups, welch.shape)
    averages = np.maximum(independent - channels.inputs + 1, 0.5)
    level, cosine = coefficients(welch.shape)
    scales = 2 * dt / ((level**2 + cosine**2 / 2) * np.array(lengths))  # to one-sided densities
    resolving = np.array([np.inf, *lengths[1:]])  # the longest window is used everywhere
    resolved = (omega * dt)[None, :] * resolving[:, None] >= 2 * np.pi * _CYCLES
    parts = condition(sums, channels, counts)
    if len(many) > 1:
        response, coherence, share = combine(parts, scales, averages, resolved)
    else:
        response, moved = parts.response[0], parts.instrument_share[0][:, None, :]
        coherence, share = np.minimum(parts.coherence[0], moved), np.ones((*response.shape, 1))
    alone = np.einsum("fig,gfi->fi", np.mean(share, axis=1), parts.alone)
    inseparable = ~(alone >= _DEPENDENT)
    lost = np.any(inseparable, axis=1)
    if np.any(lost):  # finite placeholders, which are marked as nan below
        gone = lost[:, None, None]
        solver, multiple = np.where(gone, 0.0, parts.solver), parts.multiple
        multiple = np.where(lost[:, None], 0.0, multiple)
        parts = parts._replace(solver=solver, multiple=multiple)
        equal = (resolved / np.sum(resolved, axis=0)).T[:, None, None]
        response, coherence = np.where(gone, 1e-300, response), np.where(gone, 0.0, coherence)
        share = np.where(gone[..., None], equal, share)
    instruments = [adjoint(channels.split(part)[0]) for part in transforms]
    effect = np.concatenate(list(map(np.matmul, parts.solver, instruments)), axis=2)
    # Variance of the responses under noise of unit power: pair of lengths by pair, since their
    # shares differ between outputs.
    begins, gain = np.cumsum((0, *many[:-1])), np.zeros(share.shape[:3])
    rows = effect.reshape(-1, len(overlap))
    rows = np.concatenate([np.real(rows), np.imag(rows)])
    for g, (start, end) in enumerate(zip(begins, (*begins[1:], len(overlap)), strict=True)):
        products = (rows[:, start:end] @ overlap[start:end, start:]) * rows[:, start:]
        both = np.add.reduceat(products, begins[g:] - start, axis=1)
        pairs = np.sum(both.reshape(2, *effect.shape[:2], -1), axis=0)
        pairs[..., 1:] *= 2.0  # each pair of lengths once
        gain += share[..., g] * np.einsum("fih,foih->foi", pairs, share[..., g:])
    windows = [channels.split(part)[1:] for part in transforms]
    rest = without_leakage(windows, response, segments.slopes, overlap, resolved)
    weights = np.mean(share, axis=2)
    trust = np.where(lost, 1e-9, 1.0)[:, None, None]
    outputs = np.moveaxis(channels.split(diagonal(sums))[2], 0, 2)
    noise = noise_root(omega, rest, outputs, weights * trust)
    power = np.sum(power_of(noise), axis=2)
    error = np.sqrt(power[:, :, None] * gain / 2) / np.abs(response)
    direct, finite = coherence, response
    if channels.instruments:  # partial coherence of inputs and outputs, without the instruments
        plain = condition(sums, channels._replace(instruments=0), counts).coherence
        direct = np.einsum("foig,gfoi->foi", share, plain)
    if np.any(lost):
        none = (response, np.nan), (coherence, 0.0), (error, np.inf)
        mask = inseparable[:, None, :]
        response, coherence, error = (np.where(mask, blank, field) for field, blank in none)

    def leakage() -> Float[np.ndarray, "2 frequencies outputs inputs"]:
        biases = [fit.bias(*finite.shape[1:]) for fit in rest.fits]
        bias, square = (padded(part, omega.size) for part in zip(*biases, strict=True))
        added = np.abs(np.sum(bias * share, axis=3))
        spread = np.sum(share * np.sqrt(square), axis=3)
        doubt = np.sqrt(power / 2)[:, :, None] * spread
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.stack([added, doubt]) / np.abs(finite)

    multiple = np.einsum("fog,gfo->fo", weights, parts.multiple)
    weights, freedom = np.mean(weights, axis=1), np.mean(rest.freedom, axis=1)
    levels = weights / np.sqrt(freedom)
    log_noise = covariance_of_windows(omega * dt, levels, welch.shape, lengths)
    log_noise = smoothed(omega, log_noise, np.sum(weights * freedom, axis=1))
    placement = place_windows(groups, welch.shape, dt, omega[-1] - omega[0])
    errors = ErrorCovariance(omega, effect, noise, share, placement, many)
    most = float(np.max(independent))
    return Estimate(
        omega, response, coherence, direct, multiple, errors, error, log_noise,
        ft.partial(_remarks, first, omega, error, alone, leakage, most),
        resolution=2 * np.pi / (lengths[0] * dt),
    )  # fmt: skip


def _remarks(
    record: Record,
    omega: Grid,
    error: Pairs,
    alone: Float[np.ndarray, "frequencies inputs"],
    leakage: Callable[[], Float[np.ndarray, "2 frequencies outputs inputs"]],
    independent: float,
) -> tuple[Remark, ...]:
    """On inputs that are alike, on leakage with its standard error, and on few windows."""
    remarks, names = [], record.input_names
    coherence = 1 - np.nan_to_num(alone)  # of each input with all others
    for i, name in enumerate(names if len(names) > 1 else ()):
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
    # Pairs whose response leakage biases, clearly and beyond the random error.
    kernel = np.exp(-0.5 * (np.log(omega[:, None] / omega) / _AVERAGED) ** 2)
    bias, doubt = leakage()
    least = np.maximum(doubt, error)
    with np.errstate(invalid="ignore"):
        ratio = np.where(np.isfinite(least) & np.isfinite(bias), bias / least, 0.0)
    for (o, output), (i, source) in itertools.product(
        enumerate(record.output_names), enumerate(names)
    ):
        leaked = kernel @ ratio[:, o, i] ** 2 > _LEAKED**2 * np.sum(kernel, axis=1)
        if np.any(leaked):
            text = (
                f"leakage through the window biases the response by about "
                f"{100 * np.median(bias[leaked, o, i]):.2g} % {{where}}; the random error does not "
                "include it. Use «jq.spectra.LocalPolynomial()», which estimates leakage, a longer "
                "window, or «integrators=» where the plant integrates"
            )
            remarks.append(Remark(text, omega[leaked], (output, source), "leakage"))
    if independent < 3:
        remarks.append(Remark(_FEW.format(count=independent), kind="few windows"))
    return tuple(remarks)
