"""Local fits of what global models leave, and the errors of both together."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from ._global_model import global_models, GlobalModel, highest_modelled, weighted_model
from ._local_fit import Bins, left_power, LocalFit, window_slices
from ._local_noise import SharedErrors
from ._noise import Noise


_NEAR, _AROUND = 0.05, 0.7  # a mode's neighbourhood and beyond, in ln(omega)
_MOST_FOLLOWED = 0.8  # share of the residuals' freedom
_PIECE = 8192  # bins whose slopes are taken at once
_END, _FEWEST = 0.05, 20  # share of a record, and samples, that count as its end
_MOVING, _LARGE = 4.0, 10.0  # ratios of powers to the noise's: of the end, and of what models leave

Grid = Float[np.ndarray, " frequencies"]


class Rest(NamedTuple):
    """Bins without what the models of the `moved` channels explain by the `sources`."""

    bins: Bins
    models: tuple[GlobalModel | None, ...]  # one for each moved channel
    sources: slice
    moved: slice

    def without_followed(
        self, omega: Grid, half_width: Grid, order: int, fit: LocalFit
    ) -> LocalFit:
        """The fit with the scatter of its residuals corrected for the noise that models follow.

        A model takes off as much of the noise as it has parameters; what of it a local fit would
        have followed by itself is counted already.
        """
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
                response[:, c] += model.response(omega, inputs)
        return fit._replace(response=response)


def subtract_models(
    bins: Bins, sources: slice, moved: slice, highest: float, dt: float, most: int
) -> Rest:
    """Fit a model of order up to `most` to each moved channel, and take it off; 0 for none."""
    none = (None,) * (moved.stop - moved.start)
    models = global_models(bins, sources, moved, highest, dt, most) if most else none
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
    """The most that a model leaves in any window, to what the local `fit` leaves of it; or 0.

    Noise is 1 to 6. More is response, or a transient, that the local fit follows.
    """
    first, last = window_slices(omega, half_width, rest.bins)
    running = np.cumsum(np.abs(rest.bins.values[:, rest.moved]) ** 2, axis=0)
    running = np.concatenate([np.zeros((1, running.shape[1])), running])
    power = (running[last] - running[first]) / np.maximum(last - first, 1)[:, None]
    noise = np.real(np.diagonal(fit.scatter, axis1=1, axis2=2))
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
        models[c] = weighted_model(model, bins, rest.sources, channel, most, power) or model
    return models


def shared_errors(
    rest: Rest,
    bins: Bins,
    omega: Grid,
    fit: LocalFit,
    noise: Noise,
    left: Complex[np.ndarray, "frequencies outputs moved"],
    right: Complex[np.ndarray, "frequencies sources inputs"],
) -> SharedErrors | None:
    """Errors of the models' parameters in left (models + `fit`) right; `None` without models.

    `noise` is that of the moved channels, and `fit` is from the sources to these. A local fit
    follows what a wrong parameter leaves in its window, so that only the difference of the model's
    own change at the frequency and of the change that the local fit sees remains.
    """
    used = [(c, model) for c, model in enumerate(rest.models) if model is not None]
    if not used:
        return None
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
        slopes[:, c, :, ends[c] : ends[c + 1]] = model.response_slopes(omega, inputs) - followed
    slopes = np.einsum("foc,fcsp,fsi->foip", left, slopes, right, optimize=True)
    places = used[0][1].places
    roots = noise.root_at(bins.omega[places])
    lines = roots / np.maximum(np.linalg.norm(roots, axis=2, keepdims=True), 1e-300)
    for c, model in enumerate(rest.models):
        lines[:, c] *= 0.0 if model is None else np.sqrt(model.noise)[:, None]
    line = np.repeat(np.arange(len(counts)), counts)
    drive = np.concatenate([model.drive for _, model in used])
    return SharedErrors(slopes, drive, lines, line, places)


def highest_looked_at(highest: float, grid: Grid) -> float:
    """Frequency in rad/s above which neither models nor `left_moving` on a `grid` take any bin.

    The models are those of responses up to `highest`.
    """
    return max(highest_modelled(highest), np.exp(_AROUND) * grid[-1])


def left_moving(
    rest: Rest, ends: Sequence[Float[np.ndarray, "_samples channels"]], grid: Grid, noise: Noise
) -> Bool[np.ndarray, " grid"]:
    """Where models leave a peak, far above the noise, of a channel that moves when a record ends.

    There the local fits alone have to tell the response from what still rings, which they cannot do
    of a mode narrower than their windows. `ends` are those of the records' channels as transformed,
    and `noise` is that of the moved channels on the `grid`.
    """
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


def end_of(columns: Float[np.ndarray, "samples channels"]) -> Float[np.ndarray, "last channels"]:
    """The last samples of a record, by which `left_moving` judges it; a copy of them alone."""
    return columns[-max(int(_END * len(columns)), _FEWEST) :].copy()
