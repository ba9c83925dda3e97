"""A rational model of whole records with the transients of their ends, from all bins at once."""

import functools as ft
import hashlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from ._local_fit import Bins
from ._rational_fit import (
    columns_of,
    descend,
    Equations,
    make_basis,
    next_order,
    parts_of,
    powers_of,
    PRICE,
    refine_orders,
    search_orders,
    slopes_of,
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

Grid = Float[np.ndarray, " frequencies"]
Places = Int[np.ndarray, " places"]
Levels = Float[np.ndarray, " bins"]


class GlobalModel(NamedTuple):
    """Y = (sum_i B_i U_i + C_r) / A of one output, polynomials in x = (exp(-j omega dt) - 1)/scale.

    Inputs that are held, or linear between samples, reach a system of finite order exactly so, with
    all their aliases; C_r is the difference of the states at the ends of record r. The errors of
    the real parameters are Re(drive V), V the transform of the output's noise at `places`.
    """

    solved: Solved
    fixed: int  # the power whose coefficient in A sets the common factor
    drive: Complex[np.ndarray, "parameters places"]
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

    def response(self, omega: Grid, inputs: int) -> Complex[np.ndarray, "frequencies inputs"]:
        """B_i / A."""
        powers = self._powers(omega)
        numerators = self.solved.linear[: inputs * (self.order + 1)].reshape(inputs, -1)
        return (numerators @ powers / (self.solved.denominator @ powers)).T

    def response_slopes(
        self, omega: Grid, inputs: int
    ) -> Complex[np.ndarray, "frequencies inputs parameters"]:
        """Derivatives of `response` with respect to the parameters."""
        powers, size = self._powers(omega), self.order + 1
        powers = (powers / (self.solved.denominator @ powers)).T
        slopes = np.zeros((omega.size, inputs, self.drive.shape[0]), complex)
        for i in range(inputs):
            slopes[:, i, i * size : (i + 1) * size] = powers
        turned = -np.delete(powers, self.fixed, axis=1)
        slopes[:, :, len(self.solved.linear) :] = (
            self.response(omega, inputs)[:, :, None] * turned[:, None, :]
        )
        return slopes

    def at_bins(self, bins: Bins, inputs: slice, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """The modelled output at some bins, and its derivatives with respect to the parameters."""
        powers = self._powers(bins.omega[rows])
        powers /= self.solved.denominator @ powers
        columns = columns_of(powers, bins.values[rows, inputs].T, _owner(bins, rows))
        output = self.solved.linear @ columns
        turned = -np.delete(powers, self.fixed, axis=0)
        return output, np.concatenate([columns, output * turned]).T

    def _powers(self, omega: Grid) -> Complex[np.ndarray, "powers frequencies"]:
        return powers_of((np.exp(-1j * omega * self.dt) - 1) / self.scale, self.order + 1)


def global_models(
    bins: Bins, inputs: slice, outputs: slice, highest: float, dt: float, most: int
) -> list[GlobalModel | None]:
    """One model for each output, of one order more, up to `most`, than has the least criterion.

    The criterion asks for more than Akaike's, under which a pole and a zero settle where the noise
    of single bins happens to rise, and for less than a Bayesian one, which stops where what is left
    hides in that noise; in a local window that would be a bias. It cannot see what is of the size
    of the noise, as half a sample of a delay: so the order is the next one, which takes most of it.
    `None` where a model explains no more than chance allows. The bins reach five times `highest`
    (rad/s). Above 20000 of them one of each n is taken: each is an equation of its own, so thinning
    costs precision, never resolution. The order is chosen with 4000 at most.
    """
    reach = int(np.searchsorted(bins.omega, highest_modelled(highest), "right"))
    places = _thin(reach, _MOST_BINS)
    scale = float(np.abs(np.exp(-1j * dt * bins.omega[places[-1]]) - 1)) / 2
    models = []
    for output in range(outputs.start, outputs.stop):
        equations = _equations(bins, places, inputs, output, scale, dt)
        settled = _identify_kept(_Task(equations, bins.omega[places], most))
        models.append(None if settled is None else GlobalModel(*settled, scale, dt, places, reach))
    return models


def weighted_model(
    model: GlobalModel,
    bins: Bins,
    inputs: slice,
    output: int,
    most: int,
    noise: Float[np.ndarray, " places"],
) -> GlobalModel | None:
    """The model of the same bins that count by `noise`, the output's power at the model's places.

    What the first model leaves can hide response: where it fits the loud bins alone, what it leaves
    of the others counts as their noise, and they never matter.
    """
    equations = _equations(bins, model.places, inputs, output, model.scale, model.dt)
    omega, weight = bins.omega[model.places], 1 / np.sqrt(noise)
    white = equations.weighted(weight).pick(_thin(len(omega), _TRIAL_BINS))
    orders = search_orders(white, most)
    if orders.best == 0:
        return None
    settled = _settle(equations, omega, weight, next_order(white, orders, most))
    return GlobalModel(*settled, model.scale, model.dt, model.places, model.reach)


def _equations(
    bins: Bins, places: Places, inputs: slice, output: int, scale: float, dt: float
) -> Equations:
    lag = np.exp(-1j * dt * bins.omega[places]) - 1
    u = np.ascontiguousarray(bins.values[places, inputs].T)
    return Equations(lag / scale, u, _owner(bins, places), bins.values[places, output])


def _owner(bins: Bins, rows: Places | slice) -> Float[np.ndarray, "records bins"]:
    """1 in the row of each bin's record."""
    return (bins.record[rows] == np.arange(bins.records)[:, None]).astype(float)


def highest_modelled(highest: float) -> float:
    """Frequency in rad/s up to which bins are modelled for responses up to `highest`."""
    return _BEYOND * highest


def _thin(count: int, most: int) -> Places:
    """At most so many of `count` bins, one of each n neighbours.

    Not every n-th: of a periodic input's lines it would take all, or none.
    """
    step = -(-count // most)
    first = np.arange(0, count, step)
    shift = np.floor(step * (0.6180339887 * np.arange(first.size) % 1.0)).astype(int)
    return np.minimum(first + shift, count - 1)


# A solution, the fixed power, the drive of errors, what follows noise, and the noise's power.
Settled = tuple[Solved, int, np.ndarray, np.ndarray, np.ndarray]


class _Task:
    """Equations to solve, equal to others of the same content."""

    def __init__(self, equations: Equations, omega: Levels, most: int):
        self.identify = ft.partial(_identify, equations, omega, most)
        data = b"".join(part.tobytes() for part in (*equations, omega))
        self.content = hashlib.blake2b(data).digest(), equations.owner.shape, most

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Task) and self.content == other.content

    def __hash__(self) -> int:
        return hash(self.content)


@ft.lru_cache(maxsize=2)
def _identify_kept(task: _Task) -> Settled | None:
    """A fit with another delay of the outputs asks for the model of the inputs once more.

    One of 20000 bins takes 20 MB.
    """
    return task.identify()


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
        """Price and likelihood of an order's model and smoothed noise together.

        In weights without the peak that gusts make through a light mode, further poles describe it.
        """
        left = first.solved[order].left * np.sqrt(rough)
        noise = noise_left(grid, left, first.solved[order].below, np.ones_like(grid))
        return PRICE * equations.parameters(order) - 2 * _log_likelihood(left, noise)

    first = first._replace(best=min((order for order in first.solved if order > 0), key=value))
    solved = first.solved[first.best]
    basis = make_basis(equations, len(solved.denominator))
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
    basis = make_basis(white, start.size)
    solved = descend(white, basis, start, _SETTLED)
    fixed = basis.largest(solved.denominator)
    slopes = parts_of(slopes_of(white, basis, solved, fixed))
    length = np.linalg.norm(slopes, axis=1, keepdims=True)
    left, size, right = np.linalg.svd(slopes / length, full_matrices=False)
    inverse = np.where(size > 1e-12 * size[0], 1 / np.maximum(size, 1e-300), 0.0)
    follow = right.view(complex)
    drive = (left * inverse / length) @ np.conj(follow)
    taken = np.sum(np.abs(follow) ** 2, axis=0) / 2
    noise = noise_left(omega, solved.left / weight, solved.below, 1 - taken)
    return solved, fixed, drive * weight, follow.T, noise


def rough_noise(equations: Equations, omega: Levels) -> Levels:
    """Power of what local rational functions, of one pole in a few bins, leave of the output.

    Without a pole a light mode would leave much, and its bins would hardly count.
    """
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
    """Running power of what a model leaves; that before its poles where it is clearly likelier.

    `below` are the values of the model's denominator: gusts pass the poles of the plant, and a
    light mode makes a peak of them that is narrower than a running power.
    """
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
    power, count = (
        np.concatenate([[0.0], np.cumsum(part)]) for part in (np.abs(values) ** 2, freedom)
    )
    return (power[last] - power[first]) / np.maximum(count[last] - count[first], 1.0)
