"""The noise by which a rational model's bins count: before there is a model, and after."""

import numpy as np
from jaxtyping import Complex, Float, Int

from ._rational_fit import Equations


_BANDWIDTH, _NEIGHBOURS = 0.2, 12  # of running powers: in ln(omega), and bins a side at least
_LEAST = 1e-6  # input, or noise, to its root mean square over the bins
_LIKELIER = 10.0  # twice the logarithm of a ratio of likelihoods that chance seldom reaches

Bins = Float[np.ndarray, " bins"]


def rough_noise(equations: Equations, omega: Bins) -> Bins:
    """Power of what local rational functions, of one pole in a few bins, leave of the output.

    Without a pole a light mode would leave much, and its bins would hardly count.
    """
    factors = np.concatenate([equations.u, equations.own])
    count, columns = omega.size, 2 * len(factors) + 1
    length = min(2 * columns, count)
    blocks = np.arange(-(-count // length) * length).reshape(-1, length)
    inside = np.minimum(blocks, count - 1)
    y = equations.y[inside][:, :, None]
    basis = _directions(np.moveaxis(factors[:, inside], 0, 2), y)
    left = y - basis @ (np.conj(np.swapaxes(basis, 1, 2)) @ y)
    freedom = 1 - np.sum(np.abs(basis) ** 2, axis=2)
    power = running_power(omega, left.ravel()[:count], freedom.ravel()[:count])
    return power + _LEAST**2 * np.mean(np.abs(equations.y) ** 2)


def _directions(
    factors: Complex[np.ndarray, "blocks bins factors"], y: Complex[np.ndarray, "blocks bins 1"]
) -> Complex[np.ndarray, "blocks bins columns"]:
    """What the factors, and all times the bin's place, span in each block."""
    place = np.linspace(-1.0, 1.0, factors.shape[1])[:, None]
    rows = np.concatenate([factors, factors * place, y * place], axis=2)
    # Where no input moves the bins, their rounding must not count as one.
    least = np.diag(_LEAST * np.sqrt(np.mean(np.abs(rows) ** 2, axis=(0, 1))))
    ridge = np.broadcast_to(least, (len(rows), *least.shape))
    return np.linalg.qr(np.concatenate([rows, ridge], axis=1))[0][:, : len(place)]


def noise_left(
    omega: Bins,
    left: Complex[np.ndarray, " bins"],
    below: Complex[np.ndarray, " bins"],
    freedom: Bins,
) -> Bins:
    """Running power of what a model leaves; that before its poles where it is clearly likelier.

    `below` are the values of the model's denominator: gusts pass the poles of the plant, and a
    light mode makes a peak of them that is narrower than a running power.
    """
    after = running_power(omega, left, freedom)
    before = running_power(omega, left * below, freedom) / np.abs(below) ** 2
    gain = log_likelihood(left, before) - log_likelihood(left, after)
    return before if 2 * gain > _LIKELIER else after


def log_likelihood(left: Complex[np.ndarray, " bins"], power: Bins) -> float:
    """Of circular normal noise of this power, but for a constant."""
    power = np.maximum(power, np.finfo(float).tiny)
    return -float(np.sum(np.log(power) + np.abs(left) ** 2 / power))


def running_power(omega: Bins, values: Complex[np.ndarray, " bins"], freedom: Bins) -> Bins:
    """Sum of |values|^2 over that of `freedom`, within a fifth of a neper of each bin."""
    first, last = _around(omega)
    power, count = (
        np.concatenate([[0.0], np.cumsum(part)]) for part in (np.abs(values) ** 2, freedom)
    )
    return (power[last] - power[first]) / np.maximum(count[last] - count[first], 1.0)


def _around(omega: Bins) -> tuple[Int[np.ndarray, " bins"], Int[np.ndarray, " bins"]]:
    """First and last bin, exclusive, of the neighbourhood of each."""
    each = np.arange(omega.size)
    first = np.searchsorted(omega, omega * np.exp(-_BANDWIDTH))
    last = np.searchsorted(omega, omega * np.exp(_BANDWIDTH), "right")
    first = np.maximum(np.minimum(first, each - _NEIGHBOURS), 0)
    return first, np.minimum(np.maximum(last, each + _NEIGHBOURS + 1), omega.size)
