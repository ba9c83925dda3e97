"""The local polynomial method: responses with errors, from records as a whole.

Source: Pintelon and Schoukens, System Identification, 2nd ed., ch. 7; docs/identification.md.
"""

import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad._core import one_blas_thread
from jaxquad.records import Record

from ._estimators import (
    adjoint,
    COHERENT,
    diagonal,
    Grid,
    LocalPolynomial,
    Method,
    Pairs,
    Places,
    Remark,
    Where,
)
from ._frequency_response import Estimate
from ._global_model import (
    highest_looked_at,
    left_moving,
    response_left,
    Rest,
    subtract_models,
    take_off,
    weighted_models,
    with_models,
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
from ._local_windows import (
    choose_widths,
    coloured_gain,
    error_covariance,
    make_windows,
    multiple_coherence,
    partial_coherence,
    power_alone,
    reach,
    Respond,
    Shape,
    unresolved,
    WIDENED,
    WIDENINGS,
    Windows,
)
from ._noise import covariance_of_bands, Noise, smooth_noise, smoothed


_ROUNDING = 1e-12  # of the power of references, added so that it has an inverse
_DEPENDENT = 1e-6  # smallest singular value of the responses of the inputs, to the largest
_DIVISIBLE = 0.15  # largest random error of an input's response to the references
_SHARPER = 0.5  # ratio of residual powers that noise alone seldom reaches
_MISSED = 100.0  # ratio of what a model leaves to the noise, from which it misses the response
_REPAIRS, _BETTER = 2, 0.1  # the most, and how little of that ratio a better model leaves

_END, _FEWEST = 0.05, 20  # share of a record, and samples, that count as its end
_CYCLES = 2.0  # of the longest record, in the lowest frequency by default

_SHARP, _COHERENT = 0.3, 0.6  # random error and coherence of frequencies that fits rest on
_GRID = 6.0  # frequencies that a record could tell apart in a grid that is not narrow by choice
# Frequencies that a record tells apart, at least, where it holds fewer cycles of the lowest: below,
# responses of sweeps in a closed loop were off by up to 180 claimed errors, above by 3 at most.
_LEAST = {5.0: 15.0, 10.0: 2.0}


@one_blas_thread()
def estimate_local_polynomial(
    records: Sequence[Record], omega: Grid | None, options: LocalPolynomial, method: Method
) -> Estimate:
    """Responses of all outputs to all inputs at increasing `omega` in rad/s, from all records.

    Coherence is that near each frequency; of the joint estimate, the smaller of input and output.
    """
    inputs, outputs = records[0].inputs.shape[1], records[0].outputs.shape[1]
    joint = method == "joint"
    moving = records[0].references.shape[1] if joint else inputs
    bins, dt = record_bins(records, options.integrators, options.delay), records[0].dt
    if omega is None:
        lowest = 2 * np.pi * _CYCLES / max(record.duration for record in records)
        omega = np.geomspace(lowest, 2 * np.pi / (10 * dt), 100)
    windows = make_windows(omega, bins, options, moving)
    furthest = max(windows.furthest(options.width), highest_looked_at(omega[-1], windows.grid))
    bins, at = bins.up_to(furthest), windows.at
    orders = options.order, options.global_order
    setup = Setup(bins, windows, inputs, outputs, moving, *orders, joint)
    # Models, and narrow fits on the grid of windows of what they leave.
    rest = subtract_models(bins, *setup.channels, omega[-1], dt, options.global_order)
    rest, from_sources = _repair_models(setup, rest)
    narrow, open_loop = setup.plant(from_sources), not joint and not records[0].reference_names
    noise = setup.noise_of(narrow, open_loop=open_loop)
    sources = setup.noise_of(from_sources) if joint else noise
    if options.width is not None:
        width, rational = np.full(at.size, float(options.width)), np.zeros(at.size, bool)
    else:
        widest = reach(windows.grid, windows.narrow, windows.widest, rest.bins, rest.sources)
        to_moved = setup.to_moved(rest)

        def to_plant(omega: Grid, half_width: Grid, shape: Shape) -> LocalFit:
            moved = to_moved(omega, half_width, shape)
            left = setup.factors(moved)[0]
            return coloured_gain(setup.plant(moved), sources, left, omega, rest.bins)

        chosen = choose_widths(windows.grid, windows.least, widest, noise, to_plant)
        width, rational = (part[at] for part in chosen)
    respond = setup.to_moved(rest)
    moved = respond(omega, width, "polynomial")
    if np.any(rational):
        part = respond(omega[rational], width[rational], "rational")
        moved = moved.replace_rows(rational, part)
    # Where the fit leaves much more than the noise, and where an input hardly moves.
    far_off = unresolved(omega, moved, sources, at, bins, rest.moved) & (options.width is None)
    unmoved = np.zeros_like(far_off)
    if joint:  # there the ratio is that of two noises: -1 over the controller
        invertible, _, turn = joint_factors(moved, inputs)
        effect = np.sum(np.abs(np.swapaxes(turn, 1, 2) @ moved.effect) ** 2, axis=2)
        relative = np.sqrt(sources.power[at][:, :inputs] * effect / 2)
        unmoved = invertible & np.any(relative > _DIVISIBLE, axis=1)
    lost = far_off | unmoved
    blank = moved.rows(lost)
    names = "response", "effect", "gain", "scatter"
    blank = blank._replace(
        **{name: getattr(blank, name) * np.nan for name in names}, freedom=0 * blank.freedom
    )
    moved = moved.replace_rows(lost, blank)
    plant = setup.plant(moved)
    back = recolour(omega, options.integrators, options.delay, dt)[:, None, None]
    plain = setup._replace(joint=False, sources=inputs)
    respond = plain.to_moved(Rest(bins, (), *plain.channels) if joint else rest)
    fit = respond(windows.grid, windows.narrow, "polynomial")  # from inputs to outputs
    power = setup.noise_of(fit).power
    direct, multiple = (of(fit, power)[at] for of in (partial_coherence, multiple_coherence))
    coherence, finite = direct, np.isfinite(plant.response)
    if joint:
        # The smaller of the shares of input and output (Bendat and Piersol, Random Data, ch. 7).
        power, alone = sources.power, power_alone(narrow)[:, None, :]
        coherence = partial_coherence(narrow, power[:, inputs:])
        coherence = np.minimum(coherence, alone / (alone + power[:, None, :inputs]))[at]
    coherent = np.any(coherence >= COHERENT, axis=(1, 2))
    coherence = np.where(finite, coherence, 0.0)
    ringing = np.zeros(at.size, bool)
    if options.global_order:
        columns = (transformed_columns(record, options.integrators) for record in records)
        ends = [x[-max(int(_END * len(x)), _FEWEST) :].copy() for x in columns]
        ringing = left_moving(rest, ends, windows.grid, sources)[at]
    left, right = setup.factors(moved)
    edges, freedom = window_slices(windows.grid, windows.narrow, bins), narrow.freedom
    log_noise = smoothed(windows.grid, covariance_of_bands(*edges, freedom), freedom)
    parts = error_covariance(omega, plant, noise, at, bins, back, sources, left)
    right = right * np.where(plant.determined[:, None, None], back, 0)
    errors = with_models(*parts, rest, bins, moved, sources, left, right)
    response = plant.response * back
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(finite, np.sqrt(errors.variance() / 2) / np.abs(response), np.inf)
    sharp = finite & (error <= _SHARP) & (coherence >= _COHERENT)
    remarks = ft.partial(
        _remarks, sum(record.duration for record in records), omega,
        np.any(sharp if sharp.any() else finite, axis=(1, 2)),
        ~np.all(finite, axis=(1, 2)) & ~lost, far_off & coherent,
        bool(np.any(unmoved) and not np.any(finite)), ringing & coherent & ~far_off,
        None if options.width is None else windows.least[at],
    )  # fmt: skip
    direct, log_noise = np.where(finite, direct, 0.0), log_noise[np.ix_(at, at)]
    return Estimate(
        omega, response, coherence, direct, multiple, errors, error, log_noise, remarks,
        divided=share_of_inputs(left, sources, at, inputs) if joint else None,
    )  # fmt: skip


class Setup(NamedTuple):
    """What is estimated, from which bins. By references, `joint`, they move all other channels."""

    bins: Bins
    windows: Windows
    inputs: int
    outputs: int
    sources: int  # that move all other channels: the references, or else the inputs
    order: int  # of the local polynomials
    global_order: int  # the most
    joint: bool

    @property
    def channels(self) -> tuple[slice, slice]:
        """The channels that move, and those that are moved."""
        first = self.inputs + self.outputs
        if self.joint:
            return slice(first, first + self.sources), slice(0, first)
        return slice(0, self.inputs), slice(self.inputs, first)

    def plant(self, moved: LocalFit) -> LocalFit:
        """The fit from inputs to outputs, from that of what is moved."""
        return joint_fit(moved, self.inputs) if self.joint else moved

    def factors(self, moved: LocalFit) -> tuple[np.ndarray, np.ndarray]:
        """L and R in dG = L dT R, T from the sources to what they move."""
        if self.joint:
            return joint_factors(moved, self.inputs)[1:]
        count, *sizes = moved.response.shape
        left, right = (np.broadcast_to(np.eye(n, dtype=complex), (count, n, n)) for n in sizes)
        return left, right

    def noise_of(self, fit: LocalFit, *, open_loop: bool = False) -> Noise:
        """Of what narrow fits on the grid leave."""
        windows, spread = self.windows, (fit.scatter, fit.freedom)
        return smooth_noise(windows.grid, windows.narrow, *spread, open_loop=open_loop)

    def to_moved(self, rest: Rest) -> Respond:
        """Fits from the sources of `rest` to what they move."""

        def respond(omega: Grid, half_width: Grid, shape: Shape) -> LocalFit:
            fit = local_fit(
                omega, half_width, rest.bins, rest.sources, rest.moved, self.order, shape
            )
            return rest.add_models(omega, fit)

        return respond


def _repair_models(setup: Setup, rest: Rest) -> tuple[Rest, LocalFit]:
    """What better models leave where those of `rest` miss the response, and the narrow fits of it.

    A model can fit the loud bins alone, and be many times the response at quiet ones, which biases
    the local fits. The better models' bins count by the noise of the local fits.
    """
    fit, left = _narrowly(setup, rest)
    for _ in range(_REPAIRS):
        if not np.any(left > _MISSED):
            break
        noise = setup.noise_of(fit)
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
    """Fits from the sources to what they move; what models leave, to what the fits leave."""
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
    left = [diagonal(one.scatter) for one in (fit, rational)]
    with np.errstate(invalid="ignore"):
        sharper = np.any(left[1] < _SHARPER * left[0], axis=1)
    if np.any(sharper):
        fit = fit.replace_rows(sharper, rational.rows(sharper))
    fit = rest.without_followed(grid, width, setup.order, fit)
    return fit, response_left(rest, grid, width, fit)


def _remarks(
    seconds: float,
    omega: Grid,
    used: Where,
    undetermined: Where,
    far_off: Where,
    unmoved: bool,
    ringing: Where,
    least: Grid | None,
) -> tuple[Remark, ...]:
    """On a record too short for the frequencies in use, and on those that are lost and why."""
    remarks, spacing = [], 2 * np.pi / seconds
    if used.any() and omega[-1] - omega[0] >= _GRID * spacing:
        low, high = float(omega[used][0]), float(omega[used][-1])
        count, cycles = (high - low) / spacing, low / spacing
        for least_cycles, least_count in _LEAST.items():
            if cycles >= least_cycles or count >= least_count:
                continue
            needed = seconds * max(least_cycles / cycles, least_count / max(count, 1.0))
            text = (
                f"the record is too short: its {seconds:.3g} s tell {count:.1f} frequencies apart "
                f"from {low:.3g} to {high:.3g} rad/s ({low / (2 * np.pi):.3g} to "
                f"{high / (2 * np.pi):.3g} Hz; at least {least_count:.0f}), and hold {cycles:.1f} "
                f"cycles of the lowest (at least {least_cycles:.0f}): 95 % intervals are too "
                f"narrow there. Record at least {needed:.2g} s, or a wider band"
            )
            remarks.append(Remark(text, omega[used], kind="short record"))
            break
    if np.any(undetermined):
        text = (
            "undetermined {where}: the inputs "
            "are not excited there, or cannot be separated from each other or from transients. "
            "Excite them there, or leave these frequencies out"
        )
        if least is not None:
            enough = np.max(least[undetermined])
            text += f"«wider|; or use a larger width: {enough:.4g} rad/s holds enough Fourier bins»"
        remarks.append(Remark(text, omega[undetermined], kind="undetermined"))
    if np.any(far_off):
        text = (
            "no response {where}: the fit there leaves more than ten times the noise nearby, as "
            "beside a mode that rings or a line (a tone, as of a rotor or the mains). Record "
            "longer, and 3 to 10 s of rest at the end"
        )
        remarks.append(Remark(text, omega[far_off], kind="no response"))
    if unmoved:  # Where no frequency is left, the reader needs to know why.
        text = (
            "no response at any frequency: the references move the inputs too little to divide by "
            f"(random errors above {100 * _DIVISIBLE:.0f} %). Excite by the references, record "
            "longer, or sample faster"
        )
        remarks.append(Remark(text, kind="no response"))
    if np.any(ringing):
        text = (
            "the output still moves when the record ends, and a global model leaves more than ten "
            "times the noise {where}: a mode that rings there, or a line (a tone, as of a rotor or "
            "the mains), is mistaken for response. Record 3 to 10 s of rest at the end, sweep wider"
            "«, or raise global_order»; leave the frequencies of a line out"
        )
        remarks.append(Remark(text, omega[ringing], kind="ringing"))
    return tuple(remarks)


def joint_factors(fit: LocalFit, inputs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where T_ru has an inverse, [-G, 1], and that inverse: dG = [-G, 1] dT T_ru^-1.

    References beyond one for each input move input and output, too: T_ru is without them.
    """
    invertible = fit.determined
    moved = fit.response[:, :inputs, :inputs]
    through = np.where(invertible[:, None, None], moved, np.eye(inputs))
    strength = np.linalg.svd(through, compute_uv=False)
    invertible &= strength[:, -1] > _DEPENDENT * strength[:, 0]
    back = np.linalg.inv(np.where(invertible[:, None, None], through, np.eye(inputs)))
    response = fit.response[:, inputs:, :inputs] @ back
    further = fit.response.shape[2] - inputs
    back = np.pad(back, ((0, 0), (0, further), (0, 0)))
    outputs = response.shape[1]
    ones = np.broadcast_to(np.eye(outputs), (len(back), outputs, outputs))
    return invertible, np.concatenate([-response, ones], axis=2), back


def joint_fit(fit: LocalFit, inputs: int) -> LocalFit:
    """G = T_ry T_ru^-1 of the fit from references to [inputs, outputs], with the error of v = y - G
    u.

    Source: Pintelon and Schoukens, System Identification, 2nd ed., section 2.6 and 7.2.7.
    """
    invertible, left, back = joint_factors(fit, inputs)
    through, response = fit.response[:, :inputs, :inputs], -left[:, :, :inputs]
    blank = np.where(invertible, 1.0, np.nan)[:, None, None]
    effect = np.swapaxes(back, 1, 2) @ fit.effect * blank
    scatter = left @ fit.scatter @ adjoint(left) * blank
    boosted = left * fit.boost[:, None, :]
    boosted = diagonal(boosted @ fit.scatter @ adjoint(boosted))
    boost = np.sqrt(boosted / np.maximum(diagonal(scatter), 1e-300))
    gain = boost[:, :, None] ** 2 * np.vecdot(effect, effect).real[:, None, :]
    power = through @ _power_beside(fit.power, inputs) @ adjoint(through)
    freedom = np.where(invertible, fit.freedom, 0.0)
    return LocalFit(response * blank, effect, boost, gain, fit.first, scatter, freedom, power)


def _power_beside(power: np.ndarray, inputs: int) -> np.ndarray:
    """That of the first references, less what the others explain of it."""
    first, crossed = power[:, :inputs, :inputs], power[:, :inputs, inputs:]
    others = power[:, inputs:, inputs:]
    if not others.shape[1]:
        return first
    size = np.trace(others, axis1=1, axis2=2).real[:, None, None]
    others = others + _ROUNDING * size * np.eye(others.shape[1])
    return first - crossed @ np.linalg.solve(others, adjoint(crossed))


def share_of_inputs(left: np.ndarray, noise: Noise, at: Places, inputs: int) -> Pairs:
    """Share of the squared error by noise of T_ru, with half of what both make."""
    root = noise.root()[at]
    total = left @ root
    of_inputs = left[:, :, :inputs] @ root[:, :inputs]
    power = np.vecdot(total, total).real
    mine = np.sum(np.real(of_inputs * np.conj(total)), axis=2)
    share = np.clip(mine / np.maximum(power, 1e-300), 0.0, 1.0)
    return np.repeat(share[:, :, None], inputs, axis=2)
