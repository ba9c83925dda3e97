"""Least squares of polynomials around each frequency: the core of the local polynomial method."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ._local_bins import Bins, window_slices
from ._local_solve import products, Solution, solve_polynomial, solve_rational


_SILENT = 1e-12  # of an input's largest bin: below, it is rounding errors
_CHUNK = 32  # frequencies solved at once, padded to the longest window among them


class LocalFit(NamedTuple):
    """Responses at the centre of each window, and what noise does to them.

    The error of output o to input i at f is `boost[f, o] sum_k effect[f, i, k] V_o[first[f] + k]`,
    V the transform of the output's noise. Where the inputs do not determine it, all is nan.
    """

    response: Complex[np.ndarray, "frequencies outputs inputs"]
    effect: Complex[np.ndarray, "frequencies inputs window"]
    boost: Float[np.ndarray, "frequencies outputs"]
    gain: Float[np.ndarray, "frequencies outputs inputs"]  # mean squared error for unit noise
    first: Int[np.ndarray, " frequencies"]
    scatter: Complex[np.ndarray, "frequencies outputs outputs"]  # residual products over freedom
    freedom: Float[np.ndarray, " frequencies"]  # complex degrees of freedom
    power: Complex[np.ndarray, "frequencies inputs inputs"]  # of the inputs, mean over the window


def local_fit(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    bins: Bins,
    inputs: slice,
    outputs: slice,
    order: int,
    shape: Literal["polynomial", "rational"],
) -> LocalFit:
    """Fit the response and each record's transient around every frequency.

    `shape` says whether both are polynomials of `order`, or such polynomials over a common
    denominator of the first degree.
    """
    first, last = window_slices(omega, half_width, bins)
    loudest = np.max(np.abs(bins.values[:, inputs]), axis=0)
    longest = max(int(np.max(last - first)), 1)
    parts, places = [], np.argsort(last - first, kind="stable")
    for chunk in np.array_split(places, -(-omega.size // _CHUNK)):
        window = _gather(omega[chunk], half_width[chunk], first[chunk], last[chunk], bins)
        values = bins.values[window.index]
        used, own = _own_records(window, order, bins.records)
        u, y = (values[:, :, each] * used[:, :, None] for each in (inputs, outputs))
        solve = solve_polynomial if shape == "polynomial" else solve_rational
        solution = solve(window.place, u, y, own, order)
        excited = np.all(np.max(np.abs(u), axis=1) > _SILENT * loudest, axis=1)
        size = np.maximum(np.sum(used, axis=1), 1)[:, None, None]
        parts.append((*_padded(solution, excited, longest), products(u) / size))
    back = np.argsort(places)
    response, effect, boost, scatter, freedom, power = (
        np.concatenate(field)[back] for field in zip(*parts, strict=True)
    )
    gain = boost[:, :, None] ** 2 * np.sum(np.abs(effect) ** 2, axis=2)[:, None, :]
    return LocalFit(response, effect, boost, gain, first, scatter, freedom, power)


def replaced(fit: LocalFit, rows: Bool[np.ndarray, " frequencies"], part: LocalFit) -> LocalFit:
    """`fit`, but at the frequencies `rows` it is `part`."""
    longest = max(fit.effect.shape[2], part.effect.shape[2])
    whole, part = (
        each._replace(
            effect=np.pad(each.effect, ((0, 0), (0, 0), (0, longest - each.effect.shape[2])))
        )
        for each in (fit, part)
    )
    fields = [np.array(field) for field in whole]
    for field, new in zip(fields, part, strict=True):
        field[rows] = new
    return LocalFit(*fields)


def _padded(
    solution: Solution, excited: Bool[np.ndarray, " frequencies"], longest: int
) -> tuple[np.ndarray, ...]:
    """Response, effect, boost, scatter and freedom, nan where nothing determines them."""
    fine = solution.fine & excited
    blank = np.where(fine, 1.0, np.nan)[:, None, None]
    effect = solution.effect
    padded = np.zeros((*effect.shape[:2], longest), complex)
    padded[:, :, : effect.shape[2]] = effect
    freedom = np.where(fine, solution.freedom, 0.0)
    scatter = products(solution.residual) / np.maximum(freedom, 1.0)[:, None, None]
    return solution.response * blank, padded * blank, solution.boost, scatter * blank, freedom


class _Window(NamedTuple):
    index: Int[np.ndarray, "frequencies window"]
    inside: Bool[np.ndarray, "frequencies window"]  # false for padding
    place: Float[np.ndarray, "frequencies window"]  # -1 to 1
    record: Int[np.ndarray, "frequencies window"]


def _gather(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    first: Int[np.ndarray, " frequencies"],
    last: Int[np.ndarray, " frequencies"],
    bins: Bins,
) -> _Window:
    step = np.arange(max(int(np.max(last - first)), 1))
    inside = step < (last - first)[:, None]
    index = np.minimum(first[:, None] + step, bins.omega.size - 1)
    place = (bins.omega[index] - omega[:, None]) / half_width[:, None]
    return _Window(index, inside, place, bins.record[index])


def _own_records(
    window: _Window, order: int, records: int
) -> tuple[Bool[np.ndarray, "frequencies window"], Bool[np.ndarray, "frequencies window records"]]:
    """Bins that tell about the response, and which record each is of.

    A record with no more bins here than its transient has coefficients tells nothing.
    """
    own = window.inside[:, :, None] & (window.record[:, :, None] == np.arange(records))
    own &= (np.sum(own, axis=1) > order + 1)[:, None, :]
    return np.any(own, axis=2), own
