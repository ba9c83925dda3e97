"""Errors and coherence of local fits, from the noise that they leave; the plant by references."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from ._error_covariance import ErrorCovariance, reach_of
from ._estimators import adjoint, diagonal, Grid, Levels, Pairs, Places, Where
from ._local_fit import Bins, LocalFit
from ._noise import Noise, smooth_noise


_CHANCE = 1e-5  # of calling a residual a misfit
_FALSE_ALARM = 1e-3  # chance that noise alone leaves any of a record's responses unresolved
_HARMLESS = 1e-4  # share of the moved channel's power
_FAR_OFF = 10.0  # residual power over that of the noise from which a response is unresolved
_UNKNOWN = 1e60  # error of what is not determined: infinity, but products with zero are zero
_TOGETHER = 1024  # bins whose drives are taken at a time: those of a long record are many
_DEPENDENT = 1e-6  # smallest singular value of the responses of the inputs, to the largest
DIVISIBLE = 0.15  # largest random error of an input's response to the references

Left = Complex[np.ndarray, "frequencies outputs moved"]


class SharedErrors(NamedTuple):
    """Errors of real parameters that noise W of unit power has moved by Re(drive W), `roots` to a
    bin.

    The drive is that of one noise times its share of the roots: all at once would fill the memory.
    """

    slopes: Complex[np.ndarray, "frequencies outputs inputs parameters"]
    single: Complex[np.ndarray, "parameters places"]
    lines: Complex[np.ndarray, "places lines roots"]
    line: Int[np.ndarray, " parameters"]  # that each parameter's noise has in `lines`
    places: Int[np.ndarray, " places"]  # bins, rising

    def drive_at(
        self, taken: Int[np.ndarray, " taken"]
    ) -> Complex[np.ndarray, "parameters taken roots"]:
        """The drive by some of the `places`, numbers of which are `taken`."""
        lines = np.swapaxes(self.lines[taken], 0, 1)
        return self.single[:, taken, None] * lines[self.line]

    def on_atoms(
        self, reached: Bool[np.ndarray, " bins"]
    ) -> tuple[np.ndarray, np.ndarray, Int[np.ndarray, " driven"]]:
        """Slopes by the parameters' errors of unit size, their drive by atoms, and which atoms.

        The bins that no local fit reaches are one more atom for each parameter, behind all bins.
        """
        level = np.sum(np.abs(self.lines) ** 2, axis=2)
        pairs = zip(self.single, self.line, strict=True)
        size = np.sqrt(0.5 * np.array([np.abs(row) ** 2 @ level[:, k] for row, k in pairs]))
        size = np.where(size > 0, size, 1.0)
        mine, parameters = reached[self.places], size.size
        gram, others = np.zeros((parameters, parameters)), np.flatnonzero(~mine)
        for first in range(0, others.size, _TOGETHER):
            part = self.drive_at(others[first : first + _TOGETHER]).reshape(parameters, -1)
            rows = np.ascontiguousarray(part).view(float)  # real and imaginary parts in turn
            gram += rows @ rows.T
        values, vectors = np.linalg.eigh(gram / np.outer(size, size))
        drive = self.drive_at(np.flatnonzero(mine)) / size[:, None, None]
        spare = np.zeros((parameters, parameters, drive.shape[2]), complex)
        spare[:, :, 0] = vectors * np.sqrt(np.maximum(values, 0.0))
        driven = np.concatenate([self.places[mine], reached.size + np.arange(parameters)])
        return self.slopes * size, np.concatenate([drive, spare], axis=1), driven


def error_covariance(
    omega: Grid,
    fit: LocalFit,
    noise: Noise,
    at: Places,
    bins: Bins,
    back: Complex[np.ndarray, "frequencies 1 1"],
    sources: Noise,
    left: Left,
    models: SharedErrors | None,
) -> ErrorCovariance:
    """Errors of `fit`, recoloured by `back`; `at` is the place of each frequency in `noise`.

    The atoms are the bins, each with its own noise: `left` times that of the `sources`. Where the
    residual is larger than chance allows, so is the error. The same noise disturbs the `models`.
    """
    colour = _colour_of_noise(sources, left, omega, bins, fit)
    effect = fit.effect * np.exp(0.5 * np.mean(np.log(colour), axis=2))[:, None, :]
    scale = fit.boost * np.sqrt(_misfit(fit, noise, at, colour, _CHANCE))
    root = left @ sources.root()[at]
    size = np.sqrt(noise.power[at]) * scale / np.maximum(np.linalg.norm(root, axis=2), 1e-300)
    root = root * size[:, :, None]
    finite = fit.determined
    root = np.where(finite[:, None, None], root, np.eye(*root.shape[1:]))
    effect = np.where(finite[:, None, None], effect * back, 0)
    reach = reach_of(effect, fit.first)
    effect = effect[:, :, : max(np.max(reach.last - reach.first), 1)].copy()
    effect[~finite, :, 0] = _UNKNOWN
    first = np.where(finite, fit.first, 0)
    errors = ErrorCovariance(np.asarray(omega), effect, root, first=first)
    if models is None:
        return errors
    slopes = np.where(finite[:, None, None, None], models.slopes * back[..., None], 0.0)
    reached = reach.reached(bins.omega.size)
    slopes, drive, driven = models._replace(slopes=slopes).on_atoms(reached)
    return dataclasses.replace(errors, sensitivity=slopes, drive=drive, driven=driven)


def _colour_of_noise(
    sources: Noise, left: Left, omega: Grid, bins: Bins, fit: LocalFit
) -> Float[np.ndarray, "frequencies window outputs"]:
    """Power of `left` times the noise at the bins of each window, to that at its centre."""
    places = _window_places(fit, bins)
    lowest = np.min(places, initial=bins.omega.size - 1)
    inside = bins.omega[lowest : np.max(places, initial=0) + 1]
    if left.shape[1] == left.shape[2] == 1:
        power = sources.power_at(inside)
        return power[places - lowest] / sources.power_at(omega)[:, None, :]
    roots = np.ascontiguousarray(np.swapaxes(sources.root_at(inside), 0, 1))
    colour, moved = np.empty((*places.shape, left.shape[1])), len(roots)
    for f, mine in enumerate(places):
        parts = left[f] @ roots[:, mine - lowest].reshape(moved, -1)  # one product: many are slow
        power = parts.real**2 + parts.imag**2
        colour[f] = np.sum(power.reshape(-1, mine.size, moved), axis=2).T
    centre = np.sum(np.abs(left @ sources.root_at(omega)) ** 2, axis=2)
    return colour / np.maximum(centre, 1e-300)[:, None, :]


def _window_places(fit: LocalFit, bins: Bins) -> Int[np.ndarray, "frequencies window"]:
    """The bins of each window, padded."""
    return np.minimum(fit.first[:, None] + np.arange(fit.effect.shape[2]), bins.omega.size - 1)


def coloured_gain(fit: LocalFit, sources: Noise, left: Left, omega: Grid, bins: Bins) -> LocalFit:
    """The fit with the gain of noise that is of unit power at the window's centre only."""
    colour = _colour_of_noise(sources, left, omega, bins, fit)
    gain = np.einsum("fik,fko->foi", np.abs(fit.effect) ** 2, colour)
    return fit._replace(gain=fit.boost[:, :, None] ** 2 * gain)


def partial_coherence(fit: LocalFit, noise: Levels) -> Pairs:
    """Share of each output's power that an input explains beyond the other inputs, 0 to 1."""
    response = np.where(fit.determined[:, None, None], fit.response, 0)
    explained = np.abs(response) ** 2 * power_alone(fit)[:, None, :]
    return explained / (explained + noise[:, :, None])


def power_alone(fit: LocalFit) -> Float[np.ndarray, "frequencies inputs"]:
    """Power of each input that no other input explains; 1 where nothing is determined."""
    power = np.where(fit.determined[:, None, None], fit.power, np.eye(fit.power.shape[1]))
    return 1 / diagonal(np.linalg.inv(power))


def multiple_coherence(fit: LocalFit, noise: Levels) -> Levels:
    """Share of each output's power that all inputs together explain, 0 to 1."""
    finite = fit.determined[:, None, None]
    response, power = np.where(finite, fit.response, 0), np.where(finite, fit.power, 0)
    explained = np.real(np.einsum("foi,fij,foj->fo", response, power, np.conj(response)))
    return explained / (explained + noise)


def unresolved(
    omega: Grid, fit: LocalFit, noise: Noise, at: Places, bins: Bins, moved: slice
) -> Where:
    """Where `fit` leaves residuals far above the noise, and more than a hundredth of what
    `moved`."""
    outputs = fit.response.shape[1]
    left = np.broadcast_to(np.eye(outputs, dtype=complex), (omega.size, outputs, outputs))
    colour = _colour_of_noise(noise, left, omega, bins, fit)
    ratio = _misfit(fit, noise, at, colour, _FALSE_ALARM / (omega.size * outputs))
    inside = np.any(fit.effect != 0, axis=1)[:, :, None]
    values = np.abs(bins.values[:, moved]) ** 2
    power = np.sum(values[_window_places(fit, bins)] * inside, axis=1) / np.sum(inside, axis=1)
    left = diagonal(fit.scatter)
    large = (ratio > _FAR_OFF) & (left > _HARMLESS * power)
    return fit.determined & np.any(large, axis=1)


def _misfit(
    fit: LocalFit,
    noise: Noise,
    at: Places,
    colour: Float[np.ndarray, "frequencies window outputs"],
    chance: float,
) -> Levels:
    """Ratio of residuals to the noise where it is larger than chance allows, else 1."""
    from scipy.special import fdtri

    inside = np.any(fit.effect != 0, axis=1)
    count = np.maximum(np.sum(inside, axis=1), 1)[:, None]
    expected = noise.power[at] * np.sum(colour * inside[:, :, None], axis=1) / count
    left = diagonal(fit.scatter) / expected
    freedom = 2 * np.maximum(fit.freedom, 1.0), 2 * np.maximum(noise.freedom[at], 1.0)
    return np.where(left > fdtri(*freedom, 1 - chance)[:, None], left, 1.0)


def joint_factors(fit: LocalFit, inputs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where T_ru has an inverse, [-G, 1], and that inverse: dG = [-G, 1] dT T_ru^-1."""
    invertible = fit.determined
    through = np.where(invertible[:, None, None], fit.response[:, :inputs], np.eye(inputs))
    strength = np.linalg.svd(through, compute_uv=False)
    invertible &= strength[:, -1] > _DEPENDENT * strength[:, 0]
    back = np.linalg.inv(np.where(invertible[:, None, None], through, np.eye(inputs)))
    response = fit.response[:, inputs:] @ back
    outputs = response.shape[1]
    ones = np.broadcast_to(np.eye(outputs), (len(back), outputs, outputs))
    return invertible, np.concatenate([-response, ones], axis=2), back


def joint_fit(fit: LocalFit, inputs: int) -> LocalFit:
    """G = T_ry T_ru^-1 of the fit from references to [inputs, outputs], with the error of v = y - G
    u.

    Source: Pintelon and Schoukens, System Identification, 2nd ed., section 2.6 and 7.2.7.
    """
    invertible, left, back = joint_factors(fit, inputs)
    through, response = fit.response[:, :inputs], -left[:, :, :inputs]
    blank = np.where(invertible, 1.0, np.nan)[:, None, None]
    effect = np.swapaxes(back, 1, 2) @ fit.effect * blank
    scatter = left @ fit.scatter @ adjoint(left) * blank
    boosted = left * fit.boost[:, None, :]
    boosted = diagonal(boosted @ fit.scatter @ adjoint(boosted))
    boost = np.sqrt(boosted / np.maximum(diagonal(scatter), 1e-300))
    gain = boost[:, :, None] ** 2 * np.vecdot(effect, effect).real[:, None, :]
    power = through @ fit.power @ adjoint(through)
    freedom = np.where(invertible, fit.freedom, 0.0)
    return LocalFit(response * blank, effect, boost, gain, fit.first, scatter, freedom, power)


def coherence_of_references(omega: Grid, half_width: Grid, fit: LocalFit, inputs: int) -> Pairs:
    """Partial coherence of the joint estimate: the smaller of the shares of input and output.

    Source: Bendat and Piersol, Random Data, ch. 7.
    """
    noise = smooth_noise(omega, half_width, fit.scatter, fit.freedom)
    moved = noise.power[:, None, :inputs]
    plant = joint_fit(fit, inputs)
    alone = power_alone(plant)[:, None, :]
    through = partial_coherence(plant, noise.power[:, inputs:])
    return np.minimum(through, alone / (alone + moved))


def share_of_inputs(left: Left, noise: Noise, at: Places, inputs: int) -> Pairs:
    """Share of a joint estimate's squared error by the noise of T_ru, half of what both make
    included."""
    root = noise.root()[at]
    total = left @ root
    of_inputs = left[:, :, :inputs] @ root[:, :inputs]
    power = np.vecdot(total, total).real
    mine = np.sum(np.real(of_inputs * np.conj(total)), axis=2)
    share = np.clip(mine / np.maximum(power, 1e-300), 0.0, 1.0)
    return np.repeat(share[:, :, None], inputs, axis=2)


def find_unmoved(moved: LocalFit, noise: Noise, at: Places, inputs: int) -> Where:
    """Where references hardly move an input: the joint ratio of two noises is -1 over the
    controller."""
    invertible, _, back = joint_factors(moved, inputs)
    effect = np.sum(np.abs(np.swapaxes(back, 1, 2) @ moved.effect) ** 2, axis=2)
    relative = np.sqrt(noise.power[at][:, :inputs] * effect / 2)
    return invertible & np.any(relative > DIVISIBLE, axis=1)
