"""A rational model of whole records with the transients of their ends, from all bins at once.

Local fits follow what it leaves, and the errors are those of both together.
"""

import dataclasses
import functools as ft
import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ._error_covariance import ErrorCovariance
from ._estimators import diagonal, Grid, sums_between
from ._local_fit import Bins, left_power, LocalFit, window_slices
from ._noise import Noise
from ._rational_fit import (
    Basis,
    columns_of,
    descend,
    Equations,
    next_order,
    parts_of,
    powers_of,
    PRICE,
    refine_orders,
    search_orders,
    Solved,
)


_BEYOND = 5.0  # ratio of the highest bin that is modelled to the highest frequency asked for
_MOST_BINS = 20000  # that a model is fitted to
_TRIAL_BINS = 4000  # with which its order is chosen
_SETTLED = 1e-6  # relative gain of a step at which the descent ends
_EVEN = 4.0  # ratio of the noise's powers below which it counts as white
_BANDWIDTH, _NEIGHBOURS = 0.2, 12  # of running powers: in ln(omega), and bins a side at least
_LEAST = 1e-6  # input, or noise, to its root mean square over the bins
_LIKELIER = 10.0  # twice the logarithm of a ratio of likelihoods that chance seldom reaches
_NEAR, _AROUND = 0.05, 0.7  # a mode's neighbourhood and beyond, in ln(omega)
_MOST_FOLLOWED = 0.8  # share of the residuals' freedom
_PIECE = 8192  # bins whose slopes are taken at once
_TOGETHER = 1024  # bins whose drives are taken at a time: those of a long record are many
_MOVING, _LARGE = 4.0, 10.0  # ratios of powers to the noise's: of the end, and of what models leave

Places = Int[np.ndarray, " places"]
Levels = Float[np.ndarray, " bins"]


class GlobalModel(NamedTuple):
    """Y = (sum_i B_i U_i + C_r) / A, of x = (exp(-j omega dt) - 1) / scale; C is of both ends."""

    solved: Solved
    fixed: int  # the power whose coefficient in A sets the common factor
    drive: Complex[np.ndarray, "parameters places"]  # errors are Re(drive V), V the noise
    follow: Complex[np.ndarray, "places parameters"]  # orthonormal: what the model takes of noise
    noise: Float[np.ndarray, " places"]  # its power, smoothed, from what the model leaves
    scale: float
    dt: float  # s
    places: Places
    reach: int  # number of bins, the lowest, that it describes

    @property
    def order(self) -> int:
        """Degree of the denominator."""
        return self.solved.order

    def response(self, omega: Grid, inputs: int) -> tuple[np.ndarray, np.ndarray]:
        """B_i / A by frequency and input, and its derivatives with respect to the parameters."""
        transients = len(self.solved.linear) - inputs * (self.order + 1)
        none = np.zeros((transients // max(self.order, 1), omega.size))
        single = np.eye(inputs, dtype=complex)[:, :, None] * np.ones(omega.size)
        parts = [self._output(omega, u, none) for u in single]
        output, slopes = (np.stack(part, axis=1) for part in zip(*parts, strict=True))
        return output, slopes

    def at_bins(self, bins: Bins, inputs: slice, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """The modelled output at some bins, and its derivatives with respect to the parameters."""
        return self._output(bins.omega[rows], bins.values[rows, inputs].T, _owner(bins, rows))

    def _output(
        self, omega: Grid, u: np.ndarray, owner: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        powers = powers_of((np.exp(-1j * omega * self.dt) - 1) / self.scale, self.order + 1)
        powers /= self.solved.denominator @ powers
        columns = columns_of(powers, u, owner)
        output = self.solved.linear @ columns
        turned = -np.delete(powers, self.fixed, axis=0)
        return output, np.concatenate([columns, output * turned]).T


def _equations(
    bins: Bins, places: Places, inputs: slice, output: int, scale: float, dt: float
) -> Equations:
    lag = np.exp(-1j * dt * bins.omega[places]) - 1
    u = np.ascontiguousarray(bins.values[places, inputs].T)
    return Equations(lag / scale, u, _owner(bins, places), bins.values[places, output])


def _owner(bins: Bins, rows: Places | slice) -> Float[np.ndarray, "records bins"]:
    """1 in the row of each bin's record."""
    return (bins.record[rows] == np.arange(bins.records)[:, None]).astype(float)


def _thin(count: int, most: int) -> Places:
    """At most so many of `count` bins, one of each n neighbours, not every n-th."""
    step = -(-count // most)
    first = np.arange(0, count, step)
    shift = np.floor(step * (0.6180339887 * np.arange(first.size) % 1.0)).astype(int)
    return np.minimum(first + shift, count - 1)


# A solution, the fixed power, the drive of errors, what follows noise, and the noise's power.
Settled = tuple[Solved, int, np.ndarray, np.ndarray, np.ndarray]


@ft.lru_cache(maxsize=2)
def _kept_models(content: tuple) -> list[Settled | None]:
    """Room for the model of such equations; another delay asks again. One takes 20 MB."""
    return []


def _identify(equations: Equations, omega: Levels, most: int) -> Settled | None:
    """A model whose bins count by what a first one leaves."""
    every = _thin(len(omega), _TRIAL_BINS)
    few, grid = equations.pick(every), omega[every]
    # Unweighted, it would fit the loud bins alone.
    rough = rough_noise(few, grid)
    first = search_orders(few.weighted(1 / np.sqrt(rough)), most)
    if first.best == 0:
        return None

    def value(order: int) -> float:
        """Price and likelihood together with the noise: gusts through a light mode peak in it."""
        left = first.solved[order].left * np.sqrt(rough)
        noise = noise_left(grid, left, first.solved[order].below, np.ones_like(grid))
        return PRICE * equations.parameters(order) - 2 * _log_likelihood(left, noise)

    first = first._replace(best=min((order for order in first.solved if order > 0), key=value))
    solved = first.solved[first.best]
    basis = Basis.of(equations, len(solved.denominator))
    below = solved.denominator @ basis.powers
    left = equations.y - solved.linear @ basis.columns / below
    noise = noise_left(omega, left, below, np.ones_like(omega))
    weight = 1 / np.sqrt(noise)
    if np.max(noise) < _EVEN * np.min(noise):
        weight = np.full_like(noise, np.mean(weight))
    white = few.weighted(weight[every])
    orders = refine_orders(white, first, most)
    if orders.best == 0:
        return None
    return _settle(equations, omega, weight, next_order(white, orders, most))


def _settle(
    equations: Equations, omega: Levels, weight: Levels, start: Float[np.ndarray, " powers"]
) -> Settled:
    """A descent from `start`, and how noise moves its parameters."""
    white = equations.weighted(weight)
    solved, basis = descend(white, start, _SETTLED)
    fixed = basis.largest(solved.denominator)
    slopes = np.concatenate([basis.columns / solved.below, basis.slopes(solved, fixed)])
    slopes = parts_of(slopes)
    length = np.linalg.norm(slopes, axis=1, keepdims=True)
    left, size, right = np.linalg.svd(slopes / length, full_matrices=False)
    inverse = np.where(size > 1e-12 * size[0], 1 / np.maximum(size, 1e-300), 0.0)
    follow = right.view(complex)
    drive = (left * inverse / length) @ np.conj(follow)
    taken = np.sum(np.abs(follow) ** 2, axis=0) / 2
    noise = noise_left(omega, solved.left / weight, solved.below, 1 - taken)
    return solved, fixed, drive * weight, follow.T, noise


def rough_noise(equations: Equations, omega: Levels) -> Levels:
    """Power that local rational functions leave; without a pole a light mode leaves much."""
    factors = np.concatenate([equations.u, equations.owner])
    count, columns = omega.size, 2 * len(factors) + 1
    length = min(2 * columns, count)
    blocks = np.arange(-(-count // length) * length).reshape(-1, length)
    inside = np.minimum(blocks, count - 1)
    # What the factors, and all times the bin's place, span in each block.
    y, driven = equations.y[inside][:, :, None], np.moveaxis(factors[:, inside], 0, 2)
    place = np.linspace(-1.0, 1.0, length)[:, None]
    rows = np.concatenate([driven, driven * place, y * place], axis=2)
    # Where no input moves the bins, their rounding must not count as one.
    least = np.diag(_LEAST * np.sqrt(np.mean(np.abs(rows) ** 2, axis=(0, 1))))
    ridge = np.broadcast_to(least, (len(rows), *least.shape))
    basis = np.linalg.qr(np.concatenate([rows, ridge], axis=1))[0][:, :length]
    left = y - basis @ (np.conj(np.swapaxes(basis, 1, 2)) @ y)
    freedom = 1 - np.sum(np.abs(basis) ** 2, axis=2)
    power = running_power(omega, left.ravel()[:count], freedom.ravel()[:count])
    return power + _LEAST**2 * np.mean(np.abs(equations.y) ** 2)


def noise_left(
    omega: Levels,
    left: Complex[np.ndarray, " bins"],
    below: Complex[np.ndarray, " bins"],
    freedom: Levels,
) -> Levels:
    """Running power of what a model leaves; that before its poles where clearly likelier."""
    after = running_power(omega, left, freedom)
    before = running_power(omega, left * below, freedom) / np.abs(below) ** 2
    gain = _log_likelihood(left, before) - _log_likelihood(left, after)
    return before if 2 * gain > _LIKELIER else after


def _log_likelihood(left: Complex[np.ndarray, " bins"], power: Levels) -> float:
    """Of circular normal noise of this power, but for a constant."""
    power = np.maximum(power, np.finfo(float).tiny)
    return -float(np.sum(np.log(power) + np.abs(left) ** 2 / power))


def running_power(omega: Levels, values: Complex[np.ndarray, " bins"], freedom: Levels) -> Levels:
    """Sum of |values|^2 over that of `freedom`, within a fifth of a neper of each bin."""
    place = np.arange(omega.size)
    first = np.searchsorted(omega, omega * np.exp(-_BANDWIDTH))
    last = np.searchsorted(omega, omega * np.exp(_BANDWIDTH), "right")
    first = np.maximum(np.minimum(first, place - _NEIGHBOURS), 0)
    last = np.minimum(np.maximum(last, place + _NEIGHBOURS + 1), omega.size)
    power, count = (sums_between(part, first, last) for part in (np.abs(values) ** 2, freedom))
    return power / np.maximum(count, 1.0)


class Rest(NamedTuple):
    """Bins without what the models of the `moved` channels explain by the `sources`."""

    bins: Bins
    models: tuple[GlobalModel | None, ...]  # one for each moved channel
    sources: slice
    moved: slice

    def without_followed(
        self, omega: Grid, half_width: Grid, order: int, fit: LocalFit
    ) -> LocalFit:
        """The fit, its residuals corrected for noise that only models have followed."""
        scatter, freedom = np.array(fit.scatter), fit.freedom
        # A long record has many times the bins that the windows reach.
        reach = int(np.max(window_slices(omega, half_width, self.bins)[1]))
        sources = Bins(
            self.bins.omega[:reach], self.bins.record[:reach],
            self.bins.values[:reach, self.sources], self.bins.records,
            self.bins.largest[self.sources],
        )  # fmt: skip
        for c, model in enumerate(self.models):
            if model is None:
                continue
            inside = model.places < reach
            follow = np.zeros((reach, model.follow.shape[1]), complex)
            follow[model.places[inside]] = model.follow[inside]
            lost = 0.5 * left_power(omega, half_width, sources, follow, order)
            share = np.minimum(lost / np.maximum(fit.freedom, 1.0), _MOST_FOLLOWED)
            scatter[:, c] /= np.sqrt(1 - share)[:, None]
            scatter[:, :, c] /= np.sqrt(1 - share)[:, None]
            freedom = np.minimum(freedom, fit.freedom * (1 - share))
        return fit._replace(scatter=scatter, freedom=freedom)

    def add_models(self, omega: Grid, fit: LocalFit) -> LocalFit:
        """The fit with the models' responses added back."""
        inputs, response = fit.response.shape[2], np.array(fit.response)
        for c, model in enumerate(self.models):
            if model is not None:
                response[:, c] += model.response(omega, inputs)[0]
        return fit._replace(response=response)


def subtract_models(
    bins: Bins, sources: slice, moved: slice, highest: float, dt: float, most: int
) -> Rest:
    """Take a model off each moved channel, of one order more than has the least criterion; 0: none.

    The criterion lies between Akaike's, under which a pole and a zero settle where the noise of
    single bins rises, and a Bayesian one, which stops where what is left hides in that noise. It
    cannot see what is of the size of the noise, as half a sample of a delay: so the order is the
    next one. Of many bins one of each n is taken: each is an equation of its own, so that costs
    precision alone.
    """
    reach = int(np.searchsorted(bins.omega, _BEYOND * highest, "right"))
    places = _thin(reach, _MOST_BINS)
    scale = float(np.abs(np.exp(-1j * dt * bins.omega[places[-1]]) - 1)) / 2
    models = []
    for channel in range(moved.start, moved.stop):
        settled = None
        if most:
            equations = _equations(bins, places, sources, channel, scale, dt)
            data = b"".join(part.tobytes() for part in (*equations, bins.omega[places]))
            kept = _kept_models((hashlib.blake2b(data).digest(), equations.owner.shape, most))
            if not kept:
                kept.append(_identify(equations, bins.omega[places], most))
            settled = kept[0]
        models.append(None if settled is None else GlobalModel(*settled, scale, dt, places, reach))
    return take_off(bins, sources, moved, models)


def take_off(
    bins: Bins, sources: slice, moved: slice, models: Sequence[GlobalModel | None]
) -> Rest:
    """The bins without what `models` explain of the moved channels."""
    values = np.array(bins.values)
    for channel, model in enumerate(models, start=moved.start):
        if model is None:
            continue
        for start in range(0, model.reach, _PIECE):
            rows = slice(start, min(start + _PIECE, model.reach))
            values[rows, channel] -= model.at_bins(bins, sources, rows)[0]
    return Rest(bins._replace(values=values), tuple(models), sources, moved)


def response_left(
    rest: Rest, omega: Grid, half_width: Grid, fit: LocalFit
) -> Float[np.ndarray, " moved"]:
    """The most that a model leaves in any window, to what `fit` leaves: noise is 1 to 6; or 0."""
    first, last = window_slices(omega, half_width, rest.bins)
    power = sums_between(np.abs(rest.bins.values[:, rest.moved]) ** 2, first, last)
    power /= np.maximum(last - first, 1)[:, None]
    noise = diagonal(fit.scatter)
    modelled = (fit.freedom > 0)[:, None] & (noise > 0)
    modelled = modelled & np.array([model is not None for model in rest.models])
    return np.max(np.where(modelled, power / np.where(modelled, noise, 1.0), 0.0), axis=0)


def weighted_models(
    rest: Rest, bins: Bins, which: Bool[np.ndarray, " moved"], noise: Noise, most: int
) -> list[GlobalModel | None]:
    """The models, `which` of them fitted to the `bins` again, which now count by the `noise`."""
    models = list(rest.models)
    for c, model in enumerate(rest.models):
        if model is None or not which[c]:
            continue
        omega, channel = bins.omega[model.places], rest.moved.start + c
        power = noise._replace(power=noise.power[:, c : c + 1]).power_at(omega)[:, 0]
        power = np.where(omega > noise.omega[-1], model.noise, power)
        equations = _equations(bins, model.places, rest.sources, channel, model.scale, model.dt)
        white = equations.weighted(1 / np.sqrt(power)).pick(_thin(len(omega), _TRIAL_BINS))
        orders = search_orders(white, most)
        if orders.best:
            start = next_order(white, orders, most)
            settled = _settle(equations, omega, 1 / np.sqrt(power), start)
            models[c] = GlobalModel(*settled, model.scale, model.dt, model.places, model.reach)
    return models


def with_models(
    errors: ErrorCovariance,
    reached: Bool[np.ndarray, " bins"],
    rest: Rest,
    bins: Bins,
    fit: LocalFit,
    noise: Noise,
    left: Complex[np.ndarray, "frequencies outputs moved"],
    right: Complex[np.ndarray, "frequencies sources inputs"],
) -> ErrorCovariance:
    """The errors, which `reached` some bins, with those of models: left (models + `fit`) right.

    A local fit follows what a wrong parameter leaves in its window: only the difference remains.
    """
    used = [(c, model) for c, model in enumerate(rest.models) if model is not None]
    if not used:
        return errors
    omega = np.asarray(errors.omega)
    counts = [0 if model is None else len(model.drive) for model in rest.models]
    ends, inputs = np.cumsum([0, *counts]).tolist(), fit.response.shape[2]
    slopes = np.zeros((omega.size, len(counts), inputs, ends[-1]), complex)
    effect = np.nan_to_num(fit.effect)
    first, last = fit.first, fit.first + effect.shape[2]
    for c, model in used:
        followed = np.zeros((*effect.shape[:2], counts[c]), complex)
        for start in range(0, model.reach, _PIECE):
            stop = min(start + _PIECE, model.reach)
            at_bins = model.at_bins(bins, rest.sources, slice(start, stop))[1]
            for f in np.flatnonzero((first < stop) & (last > start)):
                low, high = max(first[f], start), min(last[f], stop)
                part = effect[f, :, low - first[f] : high - first[f]]
                followed[f] += part @ at_bins[low - start : high - start]
        slopes[:, c, :, ends[c] : ends[c + 1]] = model.response(omega, inputs)[1] - followed
    slopes = np.einsum("foc,fcsp,fsi->foip", left, slopes, right, optimize=True)
    slopes = np.nan_to_num(slopes)  # of what is not determined
    # The drive is that of one noise times its share of the roots: all would fill the memory.
    places, parameters = used[0][1].places, ends[-1]
    roots = noise.root_at(bins.omega[places])
    lines = roots / np.maximum(np.linalg.norm(roots, axis=2, keepdims=True), 1e-300)
    for c, model in enumerate(rest.models):
        lines[:, c] *= 0.0 if model is None else np.sqrt(model.noise)[:, None]
    line = np.repeat(np.arange(len(counts)), counts)
    single = np.concatenate([model.drive for _, model in used])

    def drive_at(taken: np.ndarray) -> Complex[np.ndarray, "parameters taken roots"]:
        return single[:, taken, None] * np.swapaxes(lines[taken], 0, 1)[line]

    # Parameters of unit error; the bins that no local fit reaches are one more atom for each.
    level = np.sum(np.abs(lines) ** 2, axis=2)
    pairs = zip(single, line, strict=True)
    size = np.sqrt(0.5 * np.array([np.abs(row) ** 2 @ level[:, k] for row, k in pairs]))
    size = np.where(size > 0, size, 1.0)
    gram, mine = np.zeros((parameters, parameters)), reached[places]
    others = np.flatnonzero(~mine)
    for start in range(0, others.size, _TOGETHER):
        part = drive_at(others[start : start + _TOGETHER]).reshape(parameters, -1)
        rows = np.ascontiguousarray(part).view(float)  # real and imaginary parts in turn
        gram += rows @ rows.T
    values, vectors = np.linalg.eigh(gram / np.outer(size, size))
    drive = drive_at(np.flatnonzero(mine)) / size[:, None, None]
    spare = np.zeros((parameters, parameters, drive.shape[2]), complex)
    spare[:, :, 0] = vectors * np.sqrt(np.maximum(values, 0.0))
    driven = np.concatenate([places[mine], reached.size + np.arange(parameters)])
    drive = np.concatenate([drive, spare], axis=1)
    return dataclasses.replace(errors, sensitivity=slopes * size, drive=drive, driven=driven)


def highest_looked_at(highest: float, grid: Grid) -> float:
    """Frequency above which neither models up to `highest` nor `left_moving` take bins."""
    return max(_BEYOND * highest, np.exp(_AROUND) * grid[-1])


def left_moving(
    rest: Rest, ends: Sequence[Float[np.ndarray, "_samples channels"]], grid: Grid, noise: Noise
) -> Bool[np.ndarray, " grid"]:
    """Where models leave a peak far above the noise of a channel moving at a record's `ends`."""
    ringing, bins = np.zeros(grid.size, bool), rest.bins
    place = np.log(bins.omega)
    for c in range(len(rest.models)):
        power = noise._replace(power=noise.power[:, c : c + 1]).power_at(bins.omega)[:, 0]
        # All bins that were left out have the power of the last one.
        level = float(np.sum(power) + bins.above * power[-1]) / (bins.omega.size + bins.above)
        if not any(np.var(end[:, rest.moved.start + c]) > _MOVING * level for end in ends):
            continue
        values = np.abs(bins.values[:, rest.moved.start + c]) ** 2 / power
        for f, centre in enumerate(np.log(grid)):
            near, around = (
                values[np.searchsorted(place, centre - far) : np.searchsorted(place, centre + far)]
                for far in (_NEAR, _AROUND)
            )
            peak = float(np.mean(near)) if near.size else 0.0
            usual = max(1.0, float(np.median(around)) if around.size else 1.0)
            ringing[f] |= peak > _LARGE * usual
    return ringing
