"""A rational model of whole records with the transients of their ends, from all bins at once."""

import functools as ft
import hashlib
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from ._local_fit import Bins
from ._model_noise import log_likelihood, noise_left, rough_noise
from ._model_order import next_order, Orders, PRICE, refine_orders, search_orders
from ._rational_fit import (
    columns_of,
    descend,
    Equations,
    make_basis,
    parts_of,
    powers_of,
    slopes_of,
    Solved,
)


_BEYOND = 5.0  # ratio of the highest bin that is modelled to the highest frequency asked for
_MOST_BINS = 20000  # that a model is fitted to
_TRIAL_BINS = 4000  # with which its order is chosen
_SETTLED = 1e-6  # relative gain of a step at which the descent ends
_EVEN = 4.0  # ratio of the noise's powers below which it counts as white


class GlobalModel(NamedTuple):
    """Y = (sum_i B_i U_i + C_r) / A of one output, polynomials in x = (exp(-j omega dt) - 1)/scale.

    Inputs that are held, or linear between samples, reach a system of finite order exactly so, with
    all their aliases; C_r is the difference of the states at the ends of record r. The errors of
    the real parameters are Re(drive V), V the transform of the output's noise at `places`.
    """

    solved: Solved
    fixed: int  # the power whose coefficient in A sets the common factor
    scale: float
    dt: float  # s
    places: Int[np.ndarray, " places"]
    drive: Complex[np.ndarray, "parameters places"]
    follow: Complex[np.ndarray, "places parameters"]  # orthonormal: what the model takes of noise
    noise: Float[np.ndarray, " places"]  # its power, smoothed, from what the model leaves
    reach: int  # number of bins, the lowest, that it describes

    @property
    def order(self) -> int:
        """Degree of the denominator."""
        return len(self.solved.denominator) - 1

    def response(
        self, omega: Float[np.ndarray, " frequencies"], inputs: int
    ) -> Complex[np.ndarray, "frequencies inputs"]:
        """B_i / A."""
        powers = self._powers(omega)
        above = self._numerators(inputs) @ powers
        return (above / (self.solved.denominator @ powers)).T

    def response_slopes(
        self, omega: Float[np.ndarray, " frequencies"], inputs: int
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
        u, own = bins.values[rows, inputs].T, _own(bins.record[rows], bins.records)
        powers /= self.solved.denominator @ powers
        columns = columns_of(powers, u, own)
        output = self.solved.linear @ columns
        turned = -np.delete(powers, self.fixed, axis=0)
        return output, np.concatenate([columns, output * turned]).T

    def _numerators(self, inputs: int) -> Float[np.ndarray, "inputs powers"]:
        return self.solved.linear[: inputs * (self.order + 1)].reshape(inputs, -1)

    def _powers(
        self, omega: Float[np.ndarray, " frequencies"]
    ) -> Complex[np.ndarray, "powers frequencies"]:
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
    tasks = [
        _Task(_equations(bins, places, inputs, output, scale, dt), bins.omega[places], most)
        for output in range(outputs.start, outputs.stop)
    ]
    return [
        None if one is None else GlobalModel(*one[:2], scale, dt, places, *one[2:], reach)
        for one in map(_identify_kept, tasks)
    ]


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
    places, scale = model.places, model.scale
    equations = _equations(bins, places, inputs, output, scale, model.dt)
    omega, weight = bins.omega[places], 1 / np.sqrt(noise)
    white = equations.weighted(weight).pick(_thin(len(omega), _TRIAL_BINS))
    orders = search_orders(white, most)
    if orders.best == 0:
        return None
    settled = _settle(equations, omega, weight, next_order(white, orders, most))
    return GlobalModel(*settled[:2], scale, model.dt, places, *settled[2:], model.reach)


def _equations(
    bins: Bins,
    places: Int[np.ndarray, " places"],
    inputs: slice,
    output: int,
    scale: float,
    dt: float,
) -> Equations:
    lag = np.exp(-1j * dt * bins.omega[places]) - 1
    own = _own(bins.record[places], bins.records)
    u = np.ascontiguousarray(bins.values[places, inputs].T)
    return Equations(lag / scale, u, own, bins.values[places, output])


def highest_modelled(highest: float) -> float:
    """Frequency in rad/s up to which bins are modelled for responses up to `highest`."""
    return _BEYOND * highest


def _thin(count: int, most: int) -> Int[np.ndarray, " places"]:
    """At most so many of `count` bins, one of each n neighbours.

    Not every n-th: of a periodic input's lines it would take all, or none.
    """
    step = -(-count // most)
    first = np.arange(0, count, step)
    shift = np.floor(step * (0.6180339887 * np.arange(first.size) % 1.0)).astype(int)
    return np.minimum(first + shift, count - 1)


Identified = tuple[Solved, int, np.ndarray, np.ndarray, np.ndarray]


class _Task:
    """Equations to solve, equal to others of the same content."""

    def __init__(self, equations: Equations, omega: Float[np.ndarray, " bins"], most: int):
        self.identify = ft.partial(_identify, equations, omega, most)
        whole = b"".join(each.tobytes() for each in (*equations, omega))
        self.content = hashlib.blake2b(whole).digest(), equations.own.shape, most

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Task) and self.content == other.content

    def __hash__(self) -> int:
        return hash(self.content)


@ft.lru_cache(maxsize=2)
def _identify_kept(task: _Task) -> Identified | None:
    """A fit with another delay of the outputs asks for the model of the inputs once more.

    One of 20000 bins takes 20 MB.
    """
    return task.identify()


def _identify(
    equations: Equations, omega: Float[np.ndarray, " bins"], most: int
) -> Identified | None:
    """A model whose bins count by what a first one leaves."""
    every = _thin(len(omega), _TRIAL_BINS)
    few = equations.pick(every)
    # Unweighted, it would fit the loud bins alone.
    rough = rough_noise(few, omega[every])
    found = search_orders(few.weighted(1 / np.sqrt(rough)), most)
    if found.best == 0:
        return None
    first = found._replace(best=_likeliest(few, omega[every], rough, found))
    noise = _noise_after(equations, omega, first.solved[first.best])
    weight = 1 / np.sqrt(noise)
    if np.max(noise) < _EVEN * np.min(noise):
        weight = np.full_like(noise, np.mean(weight))
    white = few.weighted(weight[every])
    orders = refine_orders(white, first, most)
    if orders.best == 0:
        return None
    return _settle(equations, omega, weight, next_order(white, orders, most))


def _likeliest(
    equations: Equations,
    omega: Float[np.ndarray, " bins"],
    rough: Float[np.ndarray, " bins"],
    orders: Orders,
) -> int:
    """The order whose model and smoothed noise are likeliest together, at the same price.

    In weights without the peak that gusts make through a light mode, further poles describe it.
    """

    def value(order: int) -> float:
        solved, even = orders.solved[order], np.ones_like(omega)
        left = solved.left * np.sqrt(rough)
        noise = noise_left(omega, left, solved.below, even)
        return PRICE * equations.parameters(order) - 2 * log_likelihood(left, noise)

    return min((order for order in orders.solved if order > 0), key=value)


def _noise_after(
    equations: Equations, omega: Float[np.ndarray, " bins"], solved: Solved
) -> Float[np.ndarray, " bins"]:
    """The noise, from what a solution leaves of all bins."""
    basis = make_basis(equations, len(solved.denominator))
    below = solved.denominator @ basis.powers
    left = equations.y - solved.linear @ basis.columns / below
    return noise_left(omega, left, below, np.ones_like(omega))


def _settle(
    equations: Equations,
    omega: Float[np.ndarray, " bins"],
    weight: Float[np.ndarray, " bins"],
    start: Float[np.ndarray, " powers"],
) -> Identified:
    """A descent from `start`, the fixed power, drive of errors, what follows noise, its power."""
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


def _own(record: Int[np.ndarray, " bins"], records: int) -> Float[np.ndarray, "records bins"]:
    return (record == np.arange(records)[:, None]).astype(float)
