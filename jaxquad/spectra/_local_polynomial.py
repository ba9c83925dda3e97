"""The local polynomial method: responses with errors, from records as a whole.

Source: Pintelon and Schoukens, System Identification, 2nd ed., ch. 7; docs/identification.md.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

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
from ._joint import (
    check_count_of_references,
    coherence_of_references,
    DIVISIBLE,
    find_unmoved,
    joint_factors,
    joint_fit,
    share_of_inputs,
)
from ._local_fit import (
    Bins,
    local_fit,
    LocalFit,
    recolour,
    record_bins,
    transformed_columns,
    window_slices,
)
from ._local_noise import (
    coloured_gain,
    error_covariance,
    multiple_coherence,
    partial_coherence,
    unresolved,
)
from ._local_windows import (
    choose_widths,
    make_windows,
    reach,
    Respond,
    Shape,
    WIDENED,
    WIDENINGS,
    Windows,
)
from ._noise import covariance_of_bands, Noise, smooth_noise, smoothed
from ._remarks import Remark


_SHARPER = 0.5  # ratio of residual powers that noise alone seldom reaches
_MISSED = 100.0  # ratio of what a model leaves to the noise, from which it misses the response
_REPAIRS, _BETTER = 2, 0.1  # the most, and how little of that ratio a better model leaves

Grid = Float[np.ndarray, " frequencies"]
Where = Bool[np.ndarray, " frequencies"]
Pairs = Float[np.ndarray, "frequencies outputs inputs"]
Method = Literal["direct", "joint"]


class LocalEstimate(NamedTuple):
    """Result of the local polynomial method; nan and infinite errors where undetermined.

    `coherence` is the share of an output's power near each frequency that an input explains beyond
    the other inputs; in the joint estimate, the smaller of the shares of input and output that the
    references explain. `direct_coherence` is always from input to output.
    """

    response: Complex[np.ndarray, "frequencies outputs inputs"]
    coherence: Pairs
    direct_coherence: Pairs
    multiple_coherence: Float[np.ndarray, "frequencies outputs"]  # of an output with all inputs
    errors: ErrorCovariance
    half_width: Grid  # rad/s
    rational: Where  # where a rational function is used, at a resonance
    log_noise_covariance: Float[np.ndarray, "frequencies frequencies"]
    divided: Pairs | None  # of a joint estimate
    remarks: tuple[Remark, ...]


def estimate_local_polynomial(
    records: Sequence[Record], omega: Grid, options: LocalPolynomial, method: Method
) -> LocalEstimate:
    """Responses of all outputs to all inputs at increasing `omega` in rad/s, from all records.

    "joint" uses the references, of which there must be as many as inputs. Raises `ValueError` for
    records that are too short or do not cover the band, and for another number of references.
    """
    inputs, outputs = records[0].inputs.shape[1], records[0].outputs.shape[1]
    if method == "joint":
        check_count_of_references(records[0], inputs)
    bins, dt = record_bins(records, options.integrators, options.delay), records[0].dt
    windows = make_windows(omega, bins, options, inputs)
    looked_at = highest_looked_at(omega[-1], windows.grid)
    bins = bins.up_to(max(windows.furthest(options.width), looked_at))
    is_open = method == "direct" and not records[0].reference_names
    orders = options.order, options.global_order
    setup = Setup(bins, windows, inputs, outputs, *orders, method, is_open)
    narrow, at = fit_narrow(setup, omega[-1], dt), windows.at
    rest, sources = narrow.rest, narrow.sources
    if options.width is not None:
        width, rational = np.full(at.size, float(options.width)), np.zeros(at.size, bool)
    else:
        widest = reach(windows.grid, windows.narrow, windows.widest, rest.bins, rest.sources)
        respond = setup.to_plant(rest, sources)
        chosen = choose_widths(windows.grid, windows.least, widest, narrow.noise, respond)
        width, rational = (part[at] for part in chosen)
    respond = setup.to_moved(rest)
    moved = respond(omega, width, "polynomial")
    if np.any(rational):
        part = respond(omega[rational], width[rational], "rational")
        moved = moved.replace_rows(rational, part)
    # Where the fit leaves much more than the noise, and where an input hardly moves.
    far_off = unresolved(omega, moved, sources, at, bins, rest.moved) & (options.width is None)
    unmoved = np.zeros_like(far_off)
    if method == "joint":
        unmoved = find_unmoved(moved, sources, at, inputs)
    lost = far_off | unmoved
    blank = moved.rows(lost)
    blank = blank._replace(
        response=blank.response * np.nan,
        effect=blank.effect * np.nan,
        gain=blank.gain * np.nan,
        scatter=blank.scatter * np.nan,
        freedom=0 * blank.freedom,
    )
    moved = moved.replace_rows(lost, blank)
    plant = setup.plant(moved)
    back = recolour(omega, options.integrators, options.delay, dt)[:, None, None]
    coherence, direct, multiple = _coherence(setup, narrow)
    coherent = np.any(coherence >= COHERENT, axis=(1, 2))
    ringing = np.zeros(at.size, bool)
    if options.global_order:
        ends = [end_of(transformed_columns(record, options.integrators)) for record in records]
        ringing = left_moving(rest, ends, windows.grid, sources)[at]
    left, right = setup.factors(moved)
    models = shared_errors(rest, bins, omega, moved, sources, left, right)
    edges = window_slices(windows.grid, windows.narrow, bins)
    freedom = narrow.plant.freedom
    log_noise = smoothed(windows.grid, covariance_of_bands(*edges, freedom), freedom)
    finite = np.isfinite(plant.response)
    undetermined = ~np.all(finite, axis=(1, 2)) & ~lost
    return LocalEstimate(
        plant.response * back,
        np.where(finite, coherence, 0.0),
        np.where(finite, direct, 0.0),
        multiple,
        error_covariance(omega, plant, narrow.noise, at, bins, back, sources, left, models),
        width,
        rational,
        log_noise[np.ix_(at, at)],
        share_of_inputs(left, sources, at, inputs) if method == "joint" else None,
        _remark_on_lost(omega[undetermined], setup, options.width)
        + _remark_on_resolution(omega[far_off & coherent])
        + _remark_on_unmoved(unmoved, finite)
        + _remark_on_ringing(omega[ringing & coherent & ~far_off]),
    )


def _coherence(
    setup: "Setup", narrow: "Narrow"
) -> tuple[Pairs, Pairs, Float[np.ndarray, "frequencies outputs"]]:
    """That of the estimate, that from inputs to outputs, and the latter's multiple coherence."""
    windows, inputs, outputs = setup.windows, setup.inputs, setup.outputs
    plain = narrow.rest
    if setup.method == "joint":
        plain = Rest(setup.bins, (), slice(0, inputs), slice(inputs, inputs + outputs))
    fit = setup.to_moved(plain)(windows.grid, windows.narrow, "polynomial")
    power = smooth_noise(windows.grid, windows.narrow, fit.scatter, fit.freedom).power
    direct = partial_coherence(fit, power)[windows.at]
    multiple = multiple_coherence(fit, power)[windows.at]
    if setup.method == "direct":
        return direct, direct, multiple
    joint = coherence_of_references(windows.grid, windows.narrow, narrow.moved, inputs)
    return joint[windows.at], direct, multiple


class Setup(NamedTuple):
    """What is estimated, from which bins. By references, `joint`, they move all other channels."""

    bins: Bins
    windows: Windows
    inputs: int
    outputs: int
    order: int  # of the local polynomials
    global_order: int  # the most
    method: Method
    open_loop: bool  # no references are known, and none is asked for

    @property
    def channels(self) -> tuple[slice, slice]:
        """The channels that move, and those that are moved."""
        first = self.inputs + self.outputs
        if self.method == "joint":
            return slice(first, first + self.inputs), slice(0, first)
        return slice(0, self.inputs), slice(self.inputs, first)

    def plant(self, moved: LocalFit) -> LocalFit:
        """The fit from inputs to outputs, from that of what is moved."""
        return joint_fit(moved, self.inputs) if self.method == "joint" else moved

    def factors(
        self, moved: LocalFit
    ) -> tuple[
        Complex[np.ndarray, "frequencies outputs moved"],
        Complex[np.ndarray, "frequencies sources inputs"],
    ]:
        """L and R in dG = L dT R, T from the sources to what they move."""
        if self.method == "joint":
            return joint_factors(moved, self.inputs)[1:]
        count, outputs = moved.response.shape[:2]
        left, right = np.eye(outputs, dtype=complex), np.eye(self.inputs, dtype=complex)
        return (
            np.broadcast_to(left, (count, outputs, outputs)),
            np.broadcast_to(right, (count, self.inputs, self.inputs)),
        )

    def to_moved(self, rest: Rest) -> Respond:
        """Fits from the sources of `rest` to what they move."""

        def respond(omega: Grid, half_width: Grid, shape: Shape) -> LocalFit:
            fit = local_fit(
                omega, half_width, rest.bins, rest.sources, rest.moved, self.order, shape
            )
            return rest.add_models(omega, fit)

        return respond

    def to_plant(self, rest: Rest, sources: Noise) -> Respond:
        """Fits from inputs to outputs, with the gain of the noise `sources` of what is moved."""
        to_moved = self.to_moved(rest)

        def respond(omega: Grid, half_width: Grid, shape: Shape) -> LocalFit:
            moved = to_moved(omega, half_width, shape)
            left = self.factors(moved)[0]
            return coloured_gain(self.plant(moved), sources, left, omega, rest.bins)

        return respond


class Narrow(NamedTuple):
    """What models leave, and the narrow fits of it on the grid of windows."""

    rest: Rest
    moved: LocalFit  # from the sources
    plant: LocalFit  # from inputs to outputs
    noise: Noise  # of the outputs
    sources: Noise  # of all that is moved


def fit_narrow(setup: Setup, highest: float, dt: float) -> Narrow:
    """With models of the bins up to five times `highest` in rad/s, of samples `dt` apart in s."""
    rest = subtract_models(setup.bins, *setup.channels, highest, dt, setup.global_order)
    rest, moved = _repair_models(setup, rest)
    plant = setup.plant(moved)
    noise = _noise_of(setup.windows, plant, open_loop=setup.open_loop)
    sources = _noise_of(setup.windows, moved) if setup.method == "joint" else noise
    return Narrow(rest, moved, plant, noise, sources)


def _noise_of(windows: Windows, fit: LocalFit, *, open_loop: bool = False) -> Noise:
    spread = fit.scatter, fit.freedom
    return smooth_noise(windows.grid, windows.narrow, *spread, open_loop=open_loop)


def _repair_models(setup: Setup, rest: Rest) -> tuple[Rest, LocalFit]:
    """What better models leave where those of `rest` miss the response, and the narrow fits of it.

    A model can fit the loud bins alone: what it leaves of the quiet ones counts as their noise, and
    they never matter. It may be many times the response there, which biases the local fits. The
    better models' bins count by the noise of the local fits.
    """
    fit, left = _narrowly(setup, rest)
    for _ in range(_REPAIRS):
        if not np.any(left > _MISSED):
            break
        noise = _noise_of(setup.windows, fit)
        models = weighted_models(rest, setup.bins, left > _MISSED, noise, setup.global_order)
        trial = take_off(setup.bins, rest.sources, rest.moved, models)
        repaired, after = _narrowly(setup, trial)
        better = after < _BETTER * left
        if not np.any(better):
            break
        if np.all(better | (left <= _MISSED)):
            rest, fit, left = trial, repaired, after
            continue
        kept = [new if b else old for b, old, new in zip(better, rest.models, models, strict=True)]
        rest = take_off(setup.bins, rest.sources, rest.moved, kept)
        fit, left = _narrowly(setup, rest)
    return rest, fit


def _narrowly(setup: Setup, rest: Rest) -> tuple[LocalFit, Float[np.ndarray, " moved"]]:
    """Fits from the sources to what they move, and what models leave, to what the fits leave.

    A window is widened where it determines nothing, as between the lines of a multisine; a rational
    fit counts where its residual is so much smaller that there must be a resonance.
    """
    grid, width = setup.windows.grid, setup.windows.narrow
    respond = setup.to_moved(rest)
    fit, wider = respond(grid, width, "polynomial"), width
    for _ in range(WIDENINGS):
        lost = ~fit.determined
        if not np.any(lost):
            break
        wider = np.where(lost, WIDENED * wider, wider)
        fit = fit.replace_rows(lost, respond(grid[lost], wider[lost], "polynomial"))
    rational = respond(grid, width, "rational")
    left = [np.real(np.diagonal(one.scatter, axis1=1, axis2=2)) for one in (fit, rational)]
    with np.errstate(invalid="ignore"):
        sharper = np.any(left[1] < _SHARPER * left[0], axis=1)
    if np.any(sharper):
        fit = fit.replace_rows(sharper, rational.rows(sharper))
    fit = rest.without_followed(grid, width, setup.order, fit)
    return fit, response_left(rest, grid, width, fit)


def _remark_on_lost(omega: Grid, setup: Setup, width: float | None) -> tuple[Remark, ...]:
    if omega.size == 0:
        return ()
    remark = (
        "undetermined {where}: the inputs "
        "are not excited there, or cannot be separated from each other or from transients. Excite "
        "them there, or leave these frequencies out"
    )
    if width is not None:
        enough = np.max(setup.windows.least[np.searchsorted(setup.windows.grid, omega)])
        remark += f"«wider|; or use a larger width: {enough:.4g} rad/s holds enough Fourier bins»"
    return (Remark(remark, omega, kind="undetermined"),)


def _remark_on_unmoved(
    unmoved: Where, finite: Bool[np.ndarray, "frequencies outputs inputs"]
) -> tuple[Remark, ...]:
    """Where no frequency is left, the reader needs to know why."""
    if np.any(finite) or not np.any(unmoved):
        return ()
    text = (
        "no response at any frequency: the references move the inputs too little to divide by "
        f"(random errors above {100 * DIVISIBLE:.0f} %). Excite by the references, record longer, "
        "or sample faster"
    )
    return (Remark(text, kind="no response"),)


def _remark_on_resolution(omega: Grid) -> tuple[Remark, ...]:
    if omega.size == 0:
        return ()
    text = (
        "no response {where}: the fit there leaves more than ten times the noise nearby, as beside "
        "a mode that rings or a line (a tone, as of a rotor or the mains). Record longer, and "
        "3 to 10 s of rest at the end"
    )
    return (Remark(text, omega, kind="no response"),)


def _remark_on_ringing(omega: Grid) -> tuple[Remark, ...]:
    if omega.size == 0:
        return ()
    text = (
        "the output still moves when the record ends, and a global model leaves more than ten "
        "times the noise {where}: a mode that rings there, or a line (a tone, as of a rotor or the "
        "mains), is mistaken for response. Record 3 to 10 s of rest at the end, sweep wider"
        "«, or raise global_order»; leave the frequencies of a line out"
    )
    return (Remark(text, omega, kind="ringing"),)
