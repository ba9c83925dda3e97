"""Local fits in narrow windows of what global models leave: their residuals are the noise."""

from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from ._global_rest import response_left, Rest, subtract_models, take_off, weighted_models
from ._joint import joint_factors, joint_fit
from ._local_fit import Bins, local_fit, LocalFit
from ._local_noise import coloured_gain
from ._local_windows import Respond, Shape, WIDENED, WIDENINGS, Windows
from ._noise import Noise, smooth_noise


_SHARPER = 0.5  # ratio of residual powers that noise alone seldom reaches
_MISSED = 100.0  # ratio of what a model leaves to the noise, from which it misses the response
_REPAIRS, _BETTER = 2, 0.1  # the most, and how little of that ratio a better model leaves

Grid = Float[np.ndarray, " frequencies"]
Method = Literal["direct", "joint"]


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
    def whole(self) -> tuple[slice, slice]:
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
    rest = subtract_models(setup.bins, *setup.whole, highest, dt, setup.global_order)
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
        found, after = _narrowly(setup, trial)
        better = after < _BETTER * left
        if not np.any(better):
            break
        if np.all(better | (left <= _MISSED)):
            rest, fit, left = trial, found, after
            continue
        kept = [new if b else old for b, old, new in zip(better, rest.models, models, strict=True)]
        rest = take_off(setup.bins, rest.sources, rest.moved, kept)
        fit, left = _narrowly(setup, rest)
    return rest, fit


def _narrowly(setup: Setup, rest: Rest) -> tuple[LocalFit, Float[np.ndarray, " moved"]]:
    """Fits from the sources to what they move, and what models leave, to what the fits leave."""
    grid, width = setup.windows.grid, setup.windows.narrow
    respond = setup.to_moved(rest)
    fit = _smaller_residual(_widened(grid, width, respond), respond(grid, width, "rational"))
    fit = rest.without_followed(grid, width, setup.order, fit)
    return fit, response_left(rest, grid, width, fit)


def _smaller_residual(polynomial: LocalFit, rational: LocalFit) -> LocalFit:
    """The rational fit where its residual is so much smaller that there must be a resonance."""
    left = [np.real(np.diagonal(fit.scatter, axis1=1, axis2=2)) for fit in (polynomial, rational)]
    with np.errstate(invalid="ignore"):
        sharper = np.any(left[1] < _SHARPER * left[0], axis=1)
    if not np.any(sharper):
        return polynomial
    return polynomial.replace_rows(sharper, rational.rows(sharper))


def _widened(grid: Grid, width: Grid, respond: Respond) -> LocalFit:
    """The fit within `width`, widened where it is undetermined, as between multisine lines."""
    fit = respond(grid, width, "polynomial")
    for _ in range(WIDENINGS):
        lost = ~np.isfinite(fit.response[:, 0, 0])
        if not np.any(lost):
            break
        width = np.where(lost, WIDENED * width, width)
        fit = fit.replace_rows(lost, respond(grid[lost], width[lost], "polynomial"))
    return fit
