"""The local polynomial method: responses with errors, from records as a whole.

Source: Pintelon and Schoukens, System Identification, 2nd ed., ch. 7; docs/identification.md.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad.records import Record

from ._error_covariance import ErrorCovariance
from ._estimators import LocalPolynomial
from ._feedback import COHERENT
from ._global_rest import end_of, highest_looked_at, left_moving, Rest, shared_errors
from ._joint import (
    check_count_of_references,
    coherence_of_references,
    DIVISIBLE,
    find_unmoved,
    share_of_inputs,
)
from ._local_fit import (
    LocalFit,
    recolour,
    record_bins,
    transformed_columns,
    window_slices,
)
from ._local_noise import (
    error_covariance,
    multiple_coherence,
    partial_coherence,
    unresolved,
)
from ._local_windows import choose_widths, Grid, make_windows, reach, Respond
from ._narrow_fit import fit_narrow, Method, Narrow, Setup
from ._noise import covariance_of_bands, smooth_noise, smoothed
from ._remarks import Remark


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
    setup, dt = _set_up(records, omega, options, method), records[0].dt
    narrow = fit_narrow(setup, omega[-1], dt)
    width, rational = _choose(setup, narrow, options.width)
    moved = _fit_chosen(omega, width, rational, setup.to_moved(narrow.rest))
    doubts = _doubt(setup, narrow, moved, options.width)
    lost = moved.rows(doubts.lost)
    blank = {
        name: getattr(lost, name) * np.nan for name in ("response", "effect", "gain", "scatter")
    }
    moved = moved.replace_rows(doubts.lost, lost._replace(**blank, freedom=0 * lost.freedom))
    plant = setup.plant(moved)
    back = recolour(omega, options.integrators, options.delay, dt)[:, None, None]
    coherence, direct, multiple = _coherence(setup, narrow)
    coherent = np.any(coherence >= COHERENT, axis=(1, 2))
    ringing = _ringing(setup, narrow, records, options) & coherent & ~doubts.unresolved
    known, at = np.isfinite(plant.response), setup.windows.at
    return LocalEstimate(
        plant.response * back,
        np.where(known, coherence, 0.0),
        np.where(known, direct, 0.0),
        multiple,
        _errors(setup, narrow, moved, plant, back),
        width,
        rational,
        _freedom_of_noise(setup, narrow)[np.ix_(at, at)],
        _divided(setup, narrow, moved),
        _remark_on_lost(omega[~np.all(known, axis=(1, 2)) & ~doubts.lost], setup, options.width)
        + _remark_on_resolution(omega[doubts.unresolved & coherent])
        + _remark_on_unmoved(doubts.unmoved, known)
        + _remark_on_ringing(omega[ringing]),
    )


def _set_up(
    records: Sequence[Record], omega: Grid, options: LocalPolynomial, method: Method
) -> Setup:
    inputs, outputs = records[0].inputs.shape[1], records[0].outputs.shape[1]
    if method == "joint":
        check_count_of_references(records[0], inputs)
    bins = record_bins(records, options.integrators, options.delay)
    windows = make_windows(omega, bins, options, inputs)
    looked_at = highest_looked_at(omega[-1], windows.grid)
    bins = bins.up_to(max(windows.furthest(options.width), looked_at))
    is_open = method == "direct" and not records[0].reference_names
    orders = options.order, options.global_order
    return Setup(bins, windows, inputs, outputs, *orders, method, is_open)


def _choose(
    setup: Setup, narrow: Narrow, given: float | None
) -> tuple[Grid, Bool[np.ndarray, " frequencies"]]:
    """Half-widths at the frequencies asked for, and where a rational function is used."""
    windows, rest = setup.windows, narrow.rest
    if given is not None:
        return np.full(windows.at.size, float(given)), np.zeros(windows.at.size, bool)
    widest = reach(windows.grid, windows.narrow, windows.widest, rest.bins, rest.sources)
    respond = setup.to_plant(rest, narrow.sources)
    width, rational = choose_widths(windows.grid, windows.least, widest, narrow.noise, respond)
    return width[windows.at], rational[windows.at]


def _fit_chosen(
    omega: Grid, width: Grid, rational: Bool[np.ndarray, " frequencies"], respond: Respond
) -> LocalFit:
    """Polynomials, and rational functions where `rational`."""
    fit = respond(omega, width, "polynomial")
    if not np.any(rational):
        return fit
    return fit.replace_rows(rational, respond(omega[rational], width[rational], "rational"))


class _Doubts(NamedTuple):
    """Frequencies without a response, and why."""

    unresolved: Bool[np.ndarray, " frequencies"]  # the fit leaves much more than the noise
    unmoved: Bool[np.ndarray, " frequencies"]  # of the joint estimate: an input hardly moves

    @property
    def lost(self) -> Bool[np.ndarray, " frequencies"]:
        """Those of both."""
        return self.unresolved | self.unmoved


def _doubt(setup: Setup, narrow: Narrow, moved: LocalFit, given: float | None) -> _Doubts:
    omega, at = setup.windows.omega, setup.windows.at
    noise, rest = narrow.sources, narrow.rest
    far = unresolved(omega, moved, noise, at, setup.bins, rest.moved) & (given is None)
    if setup.method == "direct":
        return _Doubts(far, np.zeros_like(far))
    return _Doubts(far, find_unmoved(moved, noise, at, setup.inputs))


def _coherence(
    setup: Setup, narrow: Narrow
) -> tuple[
    Float[np.ndarray, "frequencies outputs inputs"],
    Float[np.ndarray, "frequencies outputs inputs"],
    Float[np.ndarray, "frequencies outputs"],
]:
    """That of the estimate, that from inputs to outputs, and the latter's multiple coherence."""
    windows, inputs, outputs = setup.windows, setup.inputs, setup.outputs
    plain = narrow.rest
    if setup.method == "joint":
        sources, moved = slice(0, inputs), slice(inputs, inputs + outputs)
        plain = Rest(setup.bins, (), sources, moved)
    fit = setup.to_moved(plain)(windows.grid, windows.narrow, "polynomial")
    power = smooth_noise(windows.grid, windows.narrow, fit.scatter, fit.freedom).power
    direct = partial_coherence(fit, power)[windows.at]
    multiple = multiple_coherence(fit, power)[windows.at]
    if setup.method == "direct":
        return direct, direct, multiple
    joint = coherence_of_references(windows.grid, windows.narrow, narrow.moved, inputs)
    return joint[windows.at], direct, multiple


def _ringing(
    setup: Setup, narrow: Narrow, records: Sequence[Record], options: LocalPolynomial
) -> Bool[np.ndarray, " frequencies"]:
    """Where a mode rings when a record ends that no model describes."""
    if not options.global_order:
        return np.zeros(setup.windows.at.size, bool)
    columns = (transformed_columns(record, options.integrators) for record in records)
    ends = [end_of(each) for each in columns]
    return left_moving(narrow.rest, ends, setup.windows.grid, narrow.sources)[setup.windows.at]


def _errors(
    setup: Setup,
    narrow: Narrow,
    moved: LocalFit,
    plant: LocalFit,
    back: Complex[np.ndarray, "frequencies 1 1"],
) -> ErrorCovariance:
    omega, at, sources = setup.windows.omega, setup.windows.at, narrow.sources
    left, right = setup.factors(moved)
    models = shared_errors(narrow.rest, setup.bins, omega, moved, sources, left, right)
    return error_covariance(omega, plant, narrow.noise, at, setup.bins, back, sources, left, models)


def _freedom_of_noise(setup: Setup, narrow: Narrow) -> Float[np.ndarray, "grid grid"]:
    """Covariance of the logarithm of the noise's power."""
    windows, freedom = setup.windows, narrow.plant.freedom
    edges = window_slices(windows.grid, windows.narrow, setup.bins)
    return smoothed(windows.grid, covariance_of_bands(*edges, freedom), freedom)


def _divided(
    setup: Setup, narrow: Narrow, moved: LocalFit
) -> Float[np.ndarray, "frequencies outputs inputs"] | None:
    """Of a joint estimate: the share of the squared error that its division makes."""
    if setup.method == "direct":
        return None
    left = setup.factors(moved)[0]
    return share_of_inputs(left, narrow.sources, setup.windows.at, setup.inputs)


def _remark_on_lost(omega: Grid, setup: Setup, given: float | None) -> tuple[Remark, ...]:
    if omega.size == 0:
        return ()
    remark = (
        "undetermined {where}: the inputs "
        "are not excited there, or cannot be separated from each other or from transients. Excite "
        "them there, or leave these frequencies out"
    )
    if given is not None:
        enough = np.max(setup.windows.least[np.searchsorted(setup.windows.grid, omega)])
        remark += f"«wider|; or use a larger width: {enough:.4g} rad/s holds enough Fourier bins»"
    return (Remark(remark, omega),)


def _remark_on_unmoved(
    unmoved: Bool[np.ndarray, " frequencies"],
    known: Bool[np.ndarray, "frequencies outputs inputs"],
) -> tuple[Remark, ...]:
    """Where no frequency is left, the reader needs to know why."""
    if np.any(known) or not np.any(unmoved):
        return ()
    text = (
        "no response at any frequency: the references move the inputs too little to divide by "
        f"(random errors above {100 * DIVISIBLE:.0f} %). Excite by the references, record longer, "
        "or sample faster"
    )
    return (Remark(text),)


def _remark_on_resolution(omega: Grid) -> tuple[Remark, ...]:
    if omega.size == 0:
        return ()
    text = (
        "no response {where}: the fit there leaves more than ten times the noise nearby, as beside "
        "a mode that rings or a line (a tone, as of a rotor or the mains). Record longer, and "
        "3 to 10 s of rest at the end"
    )
    return (Remark(text, omega),)


def _remark_on_ringing(omega: Grid) -> tuple[Remark, ...]:
    if omega.size == 0:
        return ()
    text = (
        "the output still moves when the record ends, and a global model leaves more than ten "
        "times the noise {where}: a mode that rings there, or a line (a tone, as of a rotor or the "
        "mains), is mistaken for response. Record 3 to 10 s of rest at the end, sweep wider"
        "«, or raise global_order»; leave the frequencies of a line out"
    )
    return (Remark(text, omega),)
