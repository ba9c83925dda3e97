from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxquad.records import Record

from ._error_covariance import ErrorCovariance
from ._estimators import LocalPolynomial
from ._feedback import COHERENT
from ._global_rest import (
    end_of,
    highest_looked_at,
    left_moving,
    response_left,
    Rest,
    shared_errors,
    subtract_models,
    take_off,
    weighted_models,
)
from ._local_fit import (
    Bins,
    check_bins,
    local_fit,
    LocalFit,
    recolour,
    record_bins,
    replace_rows,
    smallest_widths,
    transformed_columns,
    window_slices,
)
from ._local_noise import (
    coloured_gain,
    error_covariance,
    multiple_coherence,
    Noise,
    partial_coherence,
    power_alone,
    smooth_noise,
    undetermined,
    unresolved,
)
from ._local_width import choose_widths, reach, Respond, Shape
from ._noise_freedom import covariance_of_bands, smoothed
from ._remarks import Remark


_DEPENDENT = 1e-6  # smallest singular value of the responses of the inputs, to the largest


def joint_factors(fit: LocalFit, inputs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where T_ru has an inverse, [-G, 1], and that inverse: dG = [-G, 1] dT T_ru^-1."""
    known = np.isfinite(fit.response[:, 0, 0])
    through = np.where(known[:, None, None], fit.response[:, :inputs], np.eye(inputs))
    strength = np.linalg.svd(through, compute_uv=False)
    known &= strength[:, -1] > _DEPENDENT * strength[:, 0]
    back = np.linalg.inv(np.where(known[:, None, None], through, np.eye(inputs)))
    response = fit.response[:, inputs:] @ back
    outputs = response.shape[1]
    ones = np.broadcast_to(np.eye(outputs), (len(back), outputs, outputs))
    return known, np.concatenate([-response, ones], axis=2), back


def joint_fit(fit: LocalFit, inputs: int) -> LocalFit:
    """The fit of the plant, G = T_ry T_ru^-1, from that of the references to [inputs, outputs].

    Its error is (dT_ry - G dT_ru) T_ru^-1: the noise is v = y - G u, and the effect that of the
    references taken through T_ru^-1. Source: Pintelon and Schoukens, System Identification,
    2nd ed., section 2.6 (several inputs: 7.2.7).
    """
    known, left, back = joint_factors(fit, inputs)
    through, response = fit.response[:, :inputs], -left[:, :, :inputs]
    blank = np.where(known, 1.0, np.nan)[:, None, None]
    effect = np.swapaxes(back, 1, 2) @ fit.effect * blank
    scatter = left @ fit.scatter @ _adjoint(left) * blank
    boosted = left * fit.boost[:, None, :]
    boosted = _diagonal(boosted @ fit.scatter @ _adjoint(boosted))
    boost = np.sqrt(boosted / np.maximum(_diagonal(scatter), 1e-300))
    gain = boost[:, :, None] ** 2 * np.vecdot(effect, effect).real[:, None, :]
    power = through @ fit.power @ _adjoint(through)
    freedom = np.where(known, fit.freedom, 0.0)
    return LocalFit(response * blank, effect, boost, gain, fit.first, scatter, freedom, power)


def coherence_of_references(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    fit: LocalFit,
    inputs: int,
) -> Float[np.ndarray, "frequencies outputs inputs"]:
    """Partial coherence of the joint estimate: the smaller of the shares of input and output.

    Of the input, what the references move of it and of no other input; of the output, what
    responds to that, beside the noise. Source: Bendat and Piersol, Random Data, ch. 7.
    """
    noise = smooth_noise(omega, half_width, fit.scatter, fit.freedom)
    moved = noise.power[:, None, :inputs]
    plant = joint_fit(fit, inputs)
    alone = power_alone(plant)[:, None, :]
    through = partial_coherence(plant, noise.power[:, inputs:])
    return np.minimum(through, alone / (alone + moved))


def share_of_inputs(
    left: Complex[np.ndarray, "frequencies outputs moved"],
    noise: Noise,
    at: Int[np.ndarray, " frequencies"],
    inputs: int,
) -> Float[np.ndarray, "frequencies outputs inputs"]:
    """Share of a joint estimate's squared error that the noise of T_ru makes, and not of T_ry.

    `left` is [-G, 1]; half of what both make together counts.
    """
    root = noise.root()[at]
    whole = left @ root
    of_inputs = left[:, :, :inputs] @ root[:, :inputs]
    power = np.vecdot(whole, whole).real
    mine = np.sum(np.real(of_inputs * np.conj(whole)), axis=2)
    share = np.clip(mine / np.maximum(power, 1e-300), 0.0, 1.0)
    return np.repeat(share[:, :, None], inputs, axis=2)


def _diagonal(x: Complex[np.ndarray, "frequencies a a"]) -> Float[np.ndarray, "frequencies a"]:
    return np.real(np.diagonal(x, axis1=1, axis2=2))


def _adjoint(x: np.ndarray) -> np.ndarray:
    return np.conj(np.swapaxes(x, 1, 2))


Grid = Float[np.ndarray, " frequencies"]


_DIVISIBLE = 0.15  # largest random error of an input's response to the references
_FREEDOM = 10  # complex degrees of freedom left over by the least window
_NARROW = 0.15  # half-width, relative to the frequency, at which noise and powers are estimated
_SHARPER = 0.5  # ratio of residual powers that noise alone seldom reaches
_WIDENED, _WIDENINGS = 1.5, 6  # ratio and number of the steps from a window that is undetermined
_WIDEST, _LEAST_SPAN = 1.2, 3.0  # widest: relative to the frequency, or to the least window
_MOST = 4096  # Fourier bins of a window, unless more lie around a frequency of the grid
_PER_OCTAVE = 4  # further frequencies, which help to choose the widths

Method = Literal["direct", "joint"]


class LocalEstimate(NamedTuple):
    """Result of the local polynomial method; nan and infinite errors where undetermined.

    `coherence` is the share of an output's power near each frequency that an input explains beyond
    the other inputs; in the joint estimate, the smaller of the shares of input and output that the
    references explain. `direct_coherence` is always from input to output.
    """

    response: Complex[np.ndarray, "frequencies outputs inputs"]
    coherence: Float[np.ndarray, "frequencies outputs inputs"]
    direct_coherence: Float[np.ndarray, "frequencies outputs inputs"]
    multiple_coherence: Float[np.ndarray, "frequencies outputs"]  # of an output with all inputs
    errors: ErrorCovariance
    half_width: Grid  # rad/s
    rational: Bool[np.ndarray, " frequencies"]  # where a rational function is used, at a resonance
    log_noise_covariance: Float[np.ndarray, "frequencies frequencies"]
    divided: Float[np.ndarray, "frequencies outputs inputs"] | None  # of a joint estimate
    remarks: tuple[Remark, ...]


def estimate_local_polynomial(
    records: Sequence[Record], omega: Grid, options: LocalPolynomial, method: Method
) -> LocalEstimate:
    """Responses of all outputs to all inputs at increasing `omega` in rad/s, from all records.

    "joint" uses the references, of which there must be as many as inputs. Raises `ValueError` for
    records that are too short or do not cover the band, and for another number of references.
    """
    bins = record_bins(records, options.integrators, options.delay)
    inputs, outputs = records[0].inputs.shape[1], records[0].outputs.shape[1]
    if method == "joint":
        _check_references(records[0], inputs)
    coefficients, order = inputs * (options.order + 1), options.order
    check_bins(omega, bins, coefficients, order + 1, _FREEDOM)
    grid, at = _with_neighbours(omega, bins)
    least = smallest_widths(grid, bins, coefficients, order + 1, _FREEDOM)
    whole = _whole(bins, inputs, outputs, method)
    most = np.maximum(least, _most(grid, bins))
    narrow_width = np.clip(_NARROW * grid, least, most)
    furthest = _furthest(grid, narrow_width, most, options)
    bins = bins.up_to(max(furthest, highest_looked_at(omega[-1], grid)))
    rest = subtract_models(bins, *whole, omega[-1], records[0].dt, options.global_order)
    rest, stack = _repair_models(grid, narrow_width, rest, bins, inputs, options)
    narrow = joint_fit(stack, inputs) if method == "joint" else stack
    noise = smooth_noise(grid, narrow_width, narrow.scatter, narrow.freedom)
    edges = window_slices(grid, narrow_width, bins)
    bands = covariance_of_bands(*edges, narrow.freedom)
    noise_freedom = smoothed(grid, bands, narrow.freedom)
    sources = noise
    if method == "joint":
        sources = smooth_noise(grid, narrow_width, stack.scatter, stack.freedom)
    respond = _responder(rest, inputs, order, method, sources)
    widest = reach(grid, narrow_width, np.minimum(_widest(grid, least), most), bins, rest.sources)
    chosen = _widths(grid, least, widest, noise, respond, options)
    width, rational = (each[at] for each in chosen)
    moved = _fit_chosen(omega, width, rational, _responder(rest, inputs, order, "direct"))
    ringing = np.zeros(omega.size, bool)
    if options.global_order:
        columns = (transformed_columns(record, options.integrators) for record in records)
        ringing = left_moving(rest, [end_of(each) for each in columns], grid, sources)[at]
    doubtful = unresolved(omega, moved, sources, at, bins, rest.moved) & (options.width is None)
    lost = unmoved = doubtful
    if method == "joint":
        unmoved = _unmoved(moved, sources, at, inputs)
        lost = doubtful | unmoved
    moved = replace_rows(moved, lost, undetermined(_rows(moved, lost)))
    fit = joint_fit(moved, inputs) if method == "joint" else moved
    plain = rest
    if method == "joint":
        plain = rest._replace(
            bins=bins, models=(), sources=slice(0, inputs), moved=slice(inputs, inputs + outputs)
        )
    direct, multiple = _direct_coherence(plain, inputs, order, grid, narrow_width)
    direct = direct[at]
    coherence = direct
    if method == "joint":
        coherence = coherence_of_references(grid, narrow_width, stack, inputs)[at]
    coherent = np.any(coherence >= COHERENT, axis=(1, 2))
    left, right = _factors(moved, inputs, method)
    models = shared_errors(rest, bins, omega, moved, sources, left, right)
    back = recolour(omega, options.integrators, options.delay, records[0].dt)[:, None, None]
    known = np.isfinite(fit.response)
    return LocalEstimate(
        fit.response * back,
        np.where(known, coherence, 0.0),
        np.where(known, direct, 0.0),
        multiple[at],
        error_covariance(omega, fit, noise, at, bins, back, sources, left, models),
        width,
        rational,
        noise_freedom[np.ix_(at, at)],
        share_of_inputs(left, sources, at, inputs) if method == "joint" else None,
        _remark_on_lost(omega, np.all(known, axis=(1, 2)) | lost, least[at], options)
        + _remark_on_resolution(omega[doubtful & coherent])
        + _remark_on_unmoved(unmoved if method == "joint" else np.zeros(1, bool))
        + _remark_on_ringing(omega[ringing & coherent & ~doubtful]),
    )


def _unmoved(
    moved: LocalFit, noise: Noise, at: Int[np.ndarray, " frequencies"], inputs: int
) -> Bool[np.ndarray, " frequencies"]:
    """Where the references move an input too little to divide by.

    There the joint ratio is that of two noises: -1 over the controller, with hardly any residual.
    """
    known, _, back = joint_factors(moved, inputs)
    effect = np.sum(np.abs(np.swapaxes(back, 1, 2) @ moved.effect) ** 2, axis=2)
    relative = np.sqrt(noise.power[at][:, :inputs] * effect / 2)
    return known & np.any(relative > _DIVISIBLE, axis=1)


def _check_references(record: Record, inputs: int) -> None:
    count = record.references.shape[1]
    if count != inputs:
        raise ValueError(
            f"the joint estimate of {inputs} inputs {list(record.input_names)} needs as many "
            f"external references; the record has {count}: {list(record.reference_names)}"
        )


def _with_neighbours(
    omega: Grid, bins: Bins
) -> tuple[Float[np.ndarray, " grid"], Int[np.ndarray, " frequencies"]]:
    """A grid of `omega` and others to an octave beyond, and the places of `omega` in it."""
    first, last = max(omega[0] / 2, bins.omega[0]), min(omega[-1] * 2, bins.omega[-1])
    steps = _PER_OCTAVE * np.log2([first, last])
    lattice = 2 ** (np.arange(np.ceil(steps[0]), np.floor(steps[1]) + 1) / _PER_OCTAVE)
    grid = np.union1d(omega, lattice)
    return grid, np.searchsorted(grid, omega)


def _whole(bins: Bins, inputs: int, outputs: int, method: Method) -> tuple[slice, slice]:
    """The channels that move, and those that are moved: by references, all others."""
    first = inputs + outputs
    if method == "joint":
        return slice(first, first + inputs), slice(0, first)
    return slice(0, inputs), slice(inputs, first)


def _factors(
    moved: LocalFit, inputs: int, method: Method
) -> tuple[
    Complex[np.ndarray, "frequencies outputs moved"],
    Complex[np.ndarray, "frequencies sources inputs"],
]:
    """L and R in dG = L dT R, T from the sources to what they move."""
    if method == "joint":
        return joint_factors(moved, inputs)[1:]
    count, outputs = moved.response.shape[:2]
    left, right = np.eye(outputs, dtype=complex), np.eye(inputs, dtype=complex)
    return (
        np.broadcast_to(left, (count, outputs, outputs)),
        np.broadcast_to(right, (count, inputs, inputs)),
    )


def _responder(
    rest: Rest, inputs: int, order: int, method: Method, sources: Noise | None = None
) -> Respond:
    """From the sources to what they move, or in the joint estimate from inputs to outputs.

    With the noise of what they move, the fits have its gain instead of that of white noise.
    """

    def respond(omega: Grid, half_width: Grid, shape: Shape) -> LocalFit:
        moved = local_fit(omega, half_width, rest.bins, rest.sources, rest.moved, order, shape)
        moved = rest.add_models(omega, moved)
        fit = joint_fit(moved, inputs) if method == "joint" else moved
        if sources is None:
            return fit
        left = _factors(moved, inputs, method)[0]
        return coloured_gain(fit, sources, left, omega, rest.bins)

    return respond


def _fit_narrow(grid: Grid, width: Grid, rest: Rest, inputs: int, order: int) -> LocalFit:
    """From the sources to what they move, within `width`: its residuals are the noise."""
    respond = _responder(rest, inputs, order, "direct")
    fit = _fit_widened(grid, width, respond)
    fit = _smaller_residual(fit, respond(grid, width, "rational"))
    return rest.without_followed(grid, width, order, fit)


_MISSED = 100.0  # ratio of what a model leaves to the noise, from which it misses the response
_REPAIRS, _BETTER = 2, 0.1  # the most, and how little of that ratio a better model leaves


def _repair_models(
    grid: Grid, width: Grid, rest: Rest, bins: Bins, inputs: int, options: LocalPolynomial
) -> tuple[Rest, LocalFit]:
    """What better models leave where those of `rest` miss the response, and the narrow fits of it.

    A model can fit the loud bins alone: what it leaves of the quiet ones counts as their noise, and
    they never matter. It may be many times the response there, which biases the local fits. The
    better models' bins count by the noise of the local fits.
    """
    stack = _fit_narrow(grid, width, rest, inputs, options.order)
    left = response_left(rest, grid, width, stack)
    for _ in range(_REPAIRS):
        if not np.any(left > _MISSED):
            break
        noise = smooth_noise(grid, width, stack.scatter, stack.freedom)
        models = weighted_models(rest, bins, left > _MISSED, noise, options.global_order)
        trial = take_off(bins, rest.sources, rest.moved, models)
        fit = _fit_narrow(grid, width, trial, inputs, options.order)
        after = response_left(trial, grid, width, fit)
        better = after < _BETTER * left
        if not np.any(better):
            break
        if np.all(better | (left <= _MISSED)):
            rest, stack, left = trial, fit, after
            continue
        kept = [new if b else old for b, old, new in zip(better, rest.models, models, strict=True)]
        rest = take_off(bins, rest.sources, rest.moved, kept)
        stack = _fit_narrow(grid, width, rest, inputs, options.order)
        left = response_left(rest, grid, width, stack)
    return rest, stack


def _smaller_residual(polynomial: LocalFit, rational: LocalFit) -> LocalFit:
    """The rational fit where its residual is so much smaller that there must be a resonance."""
    left = [np.real(np.diagonal(fit.scatter, axis1=1, axis2=2)) for fit in (polynomial, rational)]
    with np.errstate(invalid="ignore"):
        sharper = np.any(left[1] < _SHARPER * left[0], axis=1)
    return (
        replace_rows(polynomial, sharper, _rows(rational, sharper))
        if np.any(sharper)
        else polynomial
    )


def _rows(fit: LocalFit, rows: Bool[np.ndarray, " frequencies"]) -> LocalFit:
    return LocalFit(*(field[rows] for field in fit))


def _fit_widened(grid: Grid, width: Grid, respond: Respond) -> LocalFit:
    """The fit within `width`, widened where it is undetermined, as between multisine lines."""
    fit = respond(grid, width, "polynomial")
    for _ in range(_WIDENINGS):
        lost = ~np.isfinite(fit.response[:, 0, 0])
        if not np.any(lost):
            break
        width = np.where(lost, _WIDENED * width, width)
        fit = replace_rows(fit, lost, respond(grid[lost], width[lost], "polynomial"))
    return fit


def _widest(grid: Grid, least: Grid) -> Grid:
    return np.maximum(_WIDEST * grid, _LEAST_SPAN * least)


def _most(grid: Grid, bins: Bins) -> Grid:
    """Half-widths beyond which a window of a long record only costs memory and time.

    Windows that reach half of the way to the next frequency leave nothing of the record out.
    """
    density = bins.omega.size / (bins.omega[-1] - bins.omega[0])
    steps = np.diff(grid)
    spacing = np.maximum(np.append(steps, steps[-1:]), np.insert(steps, 0, steps[:1]))
    return np.maximum(spacing, _MOST / density) / 2


def _furthest(grid: Grid, narrow: Grid, most: Grid, options: LocalPolynomial) -> float:
    """The end in rad/s of the windows that reach furthest: no bin beyond it matters."""
    width = np.maximum(narrow * _WIDENED**_WIDENINGS, most)
    return float(np.max(grid + np.maximum(width, options.width or 0.0)))


def _widths(
    grid: Grid, least: Grid, widest: Grid, noise: Noise, respond: Respond, options: LocalPolynomial
) -> tuple[Grid, Bool[np.ndarray, " frequencies"]]:
    if options.width is None:
        return choose_widths(grid, least, widest, noise, respond)
    return np.full(grid.size, float(options.width)), np.zeros(grid.size, bool)


def _fit_chosen(
    omega: Grid, width: Grid, rational: Bool[np.ndarray, " frequencies"], respond: Respond
) -> LocalFit:
    """Polynomials, and rational functions where `rational`."""
    fit = respond(omega, width, "polynomial")
    if not np.any(rational):
        return fit
    return replace_rows(fit, rational, respond(omega[rational], width[rational], "rational"))


def _direct_coherence(
    rest: Rest, inputs: int, order: int, grid: Grid, half_width: Grid
) -> tuple[
    Float[np.ndarray, "frequencies outputs inputs"], Float[np.ndarray, "frequencies outputs"]
]:
    """Partial and multiple."""
    fit = _responder(rest, inputs, order, "direct")(grid, half_width, "polynomial")
    noise = smooth_noise(grid, half_width, fit.scatter, fit.freedom)
    return partial_coherence(fit, noise.power), multiple_coherence(fit, noise.power)


def _remark_on_lost(
    omega: Grid, known: Bool[np.ndarray, " frequencies"], least: Grid, options: LocalPolynomial
) -> tuple[Remark, ...]:
    lost = omega[~known]
    if lost.size == 0:
        return ()
    remark = (
        "undetermined {where}: the inputs "
        "are not excited there, or cannot be separated from each other or from transients. Excite "
        "them there, or leave these frequencies out"
    )
    if options.width is not None:
        enough = np.max(least[~known])
        remark += f"; or use a larger width: {enough:.4g} rad/s holds enough Fourier bins"
    return (Remark(remark, lost),)


def _remark_on_unmoved(unmoved: Bool[np.ndarray, " frequencies"]) -> tuple[Remark, ...]:
    """Where no frequency is left, the reader needs to know why."""
    if not np.all(unmoved):
        return ()
    text = (
        "no response at any frequency: the references move the inputs too little to divide by "
        f"(random errors above {100 * _DIVISIBLE:.0f} %). Excite by the references, record longer, "
        "or sample faster"
    )
    return (Remark(text),)


def _remark_on_resolution(omega: Grid) -> tuple[Remark, ...]:
    if omega.size == 0:
        return ()
    text = (
        "no response {where}: the fit there leaves more than ten times the noise nearby, as beside "
        "a mode that rings or a narrow line in the noise. Record longer, and 3 to 10 s of rest at "
        "the end"
    )
    return (Remark(text, omega),)


def _remark_on_ringing(omega: Grid) -> tuple[Remark, ...]:
    if omega.size == 0:
        return ()
    text = (
        "the output still moves when the record ends, and a global model leaves more than ten "
        "times the noise {where}: a mode that rings there is mistaken for response. Record 3 to "
        "10 s of rest at the end, sweep wider, or raise global_order"
    )
    return (Remark(text, omega),)
