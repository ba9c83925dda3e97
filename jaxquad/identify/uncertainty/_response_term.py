"""Responses as a fit sees them at its solution: misfits, slopes and random errors."""

import dataclasses
import functools as ft
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad.spectra import FrequencyResponse

from ..frequency_domain._cost import mix, Mixing
from ..frequency_domain._parameters import namespace_of, Numbers
from ..frequency_domain._solve import Solution


Units = Float[np.ndarray, "*members all"]
PerFit = float | Numbers  # of one fit, or of many


def units_of(solution: Solution) -> Units:
    """What relative changes are relative to: the value, or the change that shows of one at zero. A
    lag at zero would look without effect, while it trades off with the delay."""
    units = np.asarray(solution.slopes).copy()
    units[..., list(solution.at_zero)] = solution.units_at_zero
    return units


def rescale(solution: Solution, units: Units) -> Units:
    """From derivatives by z to derivatives by changes relative to `units`."""
    slopes = np.asarray(solution.slopes)
    return np.where(slopes == 0, 1.0, units / np.where(slopes == 0, 1.0, slopes))


def diagonal(matrix: Numbers) -> Numbers:
    """Of the last two axes."""
    return namespace_of(matrix).diagonal(matrix, axis1=-2, axis2=-1)


class PriorRows(NamedTuple):
    """Prior knowledge, in standard errors, by relative changes."""

    misfit: Float[np.ndarray, "*members priors"]
    slopes: Float[np.ndarray, "*members priors all"]


def prior_rows(solution: Solution, units: Units) -> PriorRows:
    """Those of the solution, relative to `units`."""
    parts = solution.sensitivity
    slopes = np.asarray(parts.prior_slopes) * rescale(solution, units)
    return PriorRows(np.asarray(parts.prior_misfits), slopes)


class Responses:
    """What an error budget asks of the responses of many fits, on a first axis of members."""

    swept_at = None  # a drift is looked for in one fit at a time

    def __init__(self, frfs: Sequence[FrequencyResponse]):
        stack = lambda of: np.stack([np.asarray(of(frf)) for frf in frfs])
        self.omega, self.errors = frfs[0].omega, [frf.errors for frf in frfs]
        self.response, self.random_error = (
            stack(lambda f: f.response),
            stack(lambda f: f.random_error),
        )
        self.error_exponent = stack(lambda f: f.error_exponent)
        covariances, none = [f.log_noise_covariance for f in frfs], np.zeros(2 * self.omega.shape)
        self.log_noise_covariance = None
        if any(x is not None for x in covariances):
            self.log_noise_covariance = np.stack([none if x is None else x for x in covariances])


@dataclasses.dataclass(frozen=True, eq=False)
class ResponseTerm:
    """One frequency response as the fit sees it, or those of many fits at the same frequencies, on
    a first axis of members; of JAX for what a derivative needs."""

    frf: FrequencyResponse | Responses
    misfit: Float[Numbers, "*members frequencies outputs inputs 2"]
    slopes: Float[Numbers, "*members frequencies outputs inputs 2 all"]
    weights: Float[np.ndarray, "*members frequencies outputs inputs 2"]
    mixing: Mixing | None
    count: int  # of free parameters, the first of all

    @ft.cached_property
    def used(self) -> np.ndarray:
        return self.weights[..., 0] > 0

    @ft.cached_property
    def pairs(self) -> list[tuple[int, int]]:
        """Output and input of the response pairs that have usable frequencies."""
        used = np.any(self.weights.reshape(-1, *self.weights.shape[-3:]), axis=(0, 3))
        return [(o, i) for o, i in np.argwhere(used).tolist()]

    @ft.cached_property
    def residual(self) -> Float[np.ndarray, "*members frequencies outputs inputs 2"]:
        """What the fit lowers."""
        return mix(self.mixing, (self.weights * self.misfit)[..., None])[..., 0]

    @ft.cached_property
    def rows(self) -> Float[np.ndarray, "*members frequencies outputs inputs 2 all"]:
        """Slopes of the residual."""
        return mix(self.mixing, self.weights[..., None] * self.slopes)

    @ft.cached_property
    def pulls(self) -> Float[np.ndarray, "*members frequencies outputs inputs 2 parameters"]:
        """How far a misfit of each point moves the gradient by each free parameter."""
        rows = self.weights[..., None] * self.slopes[..., : self.count]
        return self.weights[..., None] * mix(self.mixing, rows, twice=True)

    @ft.cached_property
    def ratio(self) -> Complex[Numbers, "*members frequencies outputs inputs"]:
        """Measurement over model."""
        exp = namespace_of(self.misfit).exp
        return exp(-self.misfit[..., 0] - 1j * self.misfit[..., 1])

    @ft.cached_property
    def measured_error(self) -> Float[Numbers, "*members frequencies outputs inputs"]:
        """Random error relative to the model."""
        xp, power = namespace_of(self.misfit), self.frf.error_exponent
        return xp.asarray(self.frf.random_error) * xp.abs(self.ratio) ** power

    @ft.cached_property
    def error(self) -> Float[Numbers, "*members frequencies outputs inputs"]:
        """The same, but never 0: an exact response would have infinite weight."""
        return namespace_of(self.misfit).maximum(self.measured_error, 1e-7)
