"""A rational model of whole records with the transients of their ends, from all bins at once."""

import functools as ft
import hashlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float, Int

from jaxquad._core import map_in_threads

from ._local_fit import Bins


_BEYOND = 5.0  # ratio of the highest bin that is modelled to the highest frequency asked for
_MOST_BINS = 20000  # that a model is fitted to
_TRIAL_BINS = 4000  # with which its order is chosen
_RELAXATIONS, _STEPS = 12, 20  # of Sanathanan and Koerner, of Gauss and Newton
_SETTLED, _TRIAL = 1e-6, 1e-3  # relative gain of a step at which the descent, or a trial, ends
_NEAREST = 1e-9  # size of the denominator, to its largest, so that no pole falls onto a bin
_EXACT = 1e-20  # share of the output's power that is rounding
_PER_PARAMETER = 6  # real equations
_EVEN = 4.0  # ratio of the noise's powers below which it counts as white
_THOROUGH, _PATIENCE = 6, 4  # least order, and orders in a row no better, that end the search
_PRICE = 4.0  # of a parameter: Akaike's is 2, a Bayesian one ln(count), 7 to 8
_BANDWIDTH, _NEIGHBOURS = 0.2, 12  # of the residual's power: in ln(omega), and bins a side at least

Vector = Float[np.ndarray, " parameters"]
Powers = Complex[np.ndarray, "bins powers"]


class Equations(NamedTuple):
    """What relates one output to the inputs at some bins, each row times its weight."""

    x: Complex[np.ndarray, " bins"]  # (exp(-j omega dt) - 1) / scale
    u: Complex[np.ndarray, "bins inputs"]
    own: Float[np.ndarray, "bins records"]  # the weight in the column of the bin's record, else 0
    y: Complex[np.ndarray, " bins"]

    def pick(self, rows: Int[np.ndarray, " rows"] | slice) -> "Equations":
        """Some of the bins."""
        return Equations(*(field[rows] for field in self))

    def weighted(self, weight: Float[np.ndarray, " bins"]) -> "Equations":
        """Equations whose noise is `weight` times as large."""
        column = weight[:, None]
        return Equations(self.x, self.u * column, self.own * column, self.y * weight)

    def parameters(self, order: int) -> int:
        """Real coefficients of a model of this order, without the common factor."""
        inputs, records = self.u.shape[1], self.own.shape[1]
        return inputs * (order + 1) + records * order + order


class Solved(NamedTuple):
    """Coefficients, and what they leave of the output."""

    denominator: Float[np.ndarray, " powers"]  # of rising powers of x
    linear: Vector  # numerators, input by input; then transients, record by record
    below: Complex[np.ndarray, " bins"]  # the denominator's values
    fitted: Complex[np.ndarray, " bins"]
    cost: float  # sum of squared residuals


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
        above = powers @ self._numerators(inputs).T
        return above / (powers @ self.solved.denominator)[:, None]

    def response_slopes(
        self, omega: Float[np.ndarray, " frequencies"], inputs: int
    ) -> Complex[np.ndarray, "frequencies inputs parameters"]:
        """Derivatives of `response` with respect to the parameters."""
        powers, size = self._powers(omega), self.order + 1
        below = (powers @ self.solved.denominator)[:, None]
        slopes = np.zeros((omega.size, inputs, self.drive.shape[0]), complex)
        for i in range(inputs):
            slopes[:, i, i * size : (i + 1) * size] = powers / below
        turned = -np.delete(powers, self.fixed, axis=1) / below
        slopes[:, :, len(self.solved.linear) :] = (
            self.response(omega, inputs)[:, :, None] * turned[:, None, :]
        )
        return slopes

    def at_bins(self, bins: Bins, inputs: slice, rows: slice) -> tuple[np.ndarray, np.ndarray]:
        """The modelled output at some bins, and its derivatives with respect to the parameters."""
        powers = self._powers(bins.omega[rows])
        u, own = bins.values[rows, inputs], _own(bins.record[rows], bins.records)
        below = (powers @ self.solved.denominator)[:, None]
        columns = _regressors(powers, u, own) / below
        output = columns @ self.solved.linear
        turned = -np.delete(powers, self.fixed, axis=1) / below
        return output, np.concatenate([columns, output[:, None] * turned], axis=1)

    def _numerators(self, inputs: int) -> Float[np.ndarray, "inputs powers"]:
        return self.solved.linear[: inputs * (self.order + 1)].reshape(inputs, -1)

    def _powers(self, omega: Float[np.ndarray, " frequencies"]) -> Powers:
        x = (np.exp(-1j * omega * self.dt) - 1) / self.scale
        return x[:, None] ** np.arange(self.order + 1)


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
    tasks = (
        _Task(_equations(bins, places, inputs, output, scale, dt), bins.omega[places], most)
        for output in range(outputs.start, outputs.stop)
    )
    found = map_in_threads(_identify_kept, tasks)
    return [
        None if one is None else GlobalModel(*one[:2], scale, dt, places, *one[2:], reach)
        for one in found
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
    weight, every = 1 / np.sqrt(noise), _thin(places.size, _TRIAL_BINS)
    chosen = _choose(equations.weighted(weight).pick(every), most)
    if chosen is None:
        return None
    found = _settle(equations, bins.omega[places], weight, chosen)
    return GlobalModel(*found[:2], scale, model.dt, places, *found[2:], model.reach)


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
    return Equations(lag / scale, bins.values[places, inputs], own, bins.values[places, output])


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
    first = _choose(equations.pick(every), most)
    if first is None:
        return None
    noise = running_power(omega, _residual(equations, first), np.ones_like(omega))
    weight = 1 / np.sqrt(noise)
    if np.max(noise) < _EVEN * np.min(noise):
        weight = np.full_like(noise, np.mean(weight))
    white = equations.weighted(weight)
    chosen = _choose(white.pick(every), most) if np.ptp(weight) > 0 else first
    return None if chosen is None else _settle(equations, omega, weight, chosen)


def _settle(
    equations: Equations,
    omega: Float[np.ndarray, " bins"],
    weight: Float[np.ndarray, " bins"],
    chosen: Solved,
) -> Identified:
    """The solution, the fixed power, the drive of the errors, what follows noise, and its power."""
    white = equations.weighted(weight)
    basis = _basis(white, len(chosen.denominator))
    solved = _descend(white, basis, chosen.denominator, _SETTLED)
    fixed = basis.largest(solved.denominator)
    slopes = _stacked(_slopes(basis, solved, fixed))
    length = np.linalg.norm(slopes, axis=0)
    left, size, right = np.linalg.svd(slopes / length, full_matrices=False)
    inverse = np.where(size > 1e-12 * size[0], 1 / np.maximum(size, 1e-300), 0.0)
    drive = _complex(left) @ (right * inverse[:, None]) / length
    follow = np.conj(_complex(left))
    taken = np.sum(np.abs(follow) ** 2, axis=1) / 2
    noise = running_power(omega, _residual(equations, solved), 1 - taken)
    return solved, fixed, drive.T * weight, follow, noise


def _complex(stacked: Float[np.ndarray, "parts columns"]) -> Complex[np.ndarray, "rows columns"]:
    """Columns whose products with the noise have as their real part those of the `stacked` ones."""
    rows = len(stacked) // 2
    return stacked[:rows] - 1j * stacked[rows:]


def _residual(equations: Equations, solved: Solved) -> Complex[np.ndarray, " bins"]:
    basis = _basis(equations, len(solved.denominator))
    return equations.y - basis.columns @ solved.linear / (basis.powers @ solved.denominator)


def _choose(equations: Equations, most: int) -> Solved | None:
    """The solution of the order above the best one, where it was tried and leaves less.

    Descents begin at a linear estimate, and at the solution of the order below, so that no order
    leaves more than a lower one. The noise draws the poles of linear estimates to the stability
    limit or beyond it, from where few descents find back: those models can lack a lag of the plant,
    for hundreds of the criterion.
    """
    count, below = 2 * len(equations.y), np.ones(1)
    best, above, least, worse = None, None, _information(_proportional(equations), 1, count), 0
    lowest, floor = least, _EXACT * float(np.sum(np.abs(equations.y) ** 2))
    for order in _orders(most):
        parameters = equations.parameters(order)
        if parameters * _PER_PARAMETER > count:
            break
        basis = _basis(equations, order + 1)
        solved = _descend(equations, basis, _relax(equations, basis), _TRIAL)
        value = _information(solved.cost + 0.01 * floor, parameters, count)
        # What the order below leads to must not end the search: higher orders may find more.
        worse, lowest = (0, value) if value < lowest else (worse + 1, lowest)
        again = _descend(equations, basis, np.pad(below, (0, order + 1 - below.size)), _TRIAL)
        if again.cost < solved.cost:
            solved, value = again, _information(again.cost + 0.01 * floor, parameters, count)
        below = solved.denominator
        if value < least:
            best, above, least = solved, None, value
        elif above is None:
            above = solved
        if (worse >= _PATIENCE and order >= _THOROUGH) or solved.cost <= floor:
            break
    if best is None or above is None or above.cost >= best.cost:
        return best
    return above


def _orders(most: int) -> Iterator[int]:
    """All up to 6, then every second."""
    yield from (order for order in range(1, most + 1) if order <= 6 or (most - order) % 2 == 0)


def _information(cost: float, parameters: int, count: int) -> float:
    return count * np.log(max(cost, 1e-300) / count) + _PRICE * parameters


def _proportional(equations: Equations) -> float:
    """Squared residuals of gains that do not depend on frequency."""
    return _solve(equations, _basis(equations, 1), np.ones(1)).cost


def _relax(equations: Equations, basis: "_Basis") -> Float[np.ndarray, " powers"]:
    """The denominator by repeated linear least squares, each weighted by the one before."""
    moved = basis.powers * equations.y[:, None]
    weight, best = np.ones((len(moved), 1)), None
    for _ in range(_RELAXATIONS):
        joined = _stacked(basis.columns * weight, moved * weight)
        denominator = _null_vector(joined, basis.columns.shape[1])
        solved = _solve(equations, basis, denominator)
        if best is not None and solved.cost > 0.999 * best.cost:
            break
        best = solved if best is None or solved.cost < best.cost else best
        weight = 1 / np.abs(solved.below)[:, None]
    assert best is not None
    return best.denominator


def _null_vector(matrix: Float[np.ndarray, "rows columns"], first: int) -> Vector:
    """Coefficients of the columns from `first` on, of unit length, that others explain best."""
    length = _lengths(matrix)
    corner = _triangle(matrix / length)[first:, first:]
    return np.linalg.svd(corner)[2][-1] / length[first:]


def _descend(
    equations: Equations,
    basis: "_Basis",
    denominator: Float[np.ndarray, " powers"],
    least_gain: float,
) -> Solved:
    """Gauss-Newton steps of the denominator, until one gains too little; the rest is linear."""
    solved, reduced = _project(equations, basis, denominator)
    floor = _EXACT * float(np.sum(np.abs(equations.y) ** 2))
    for _ in range(_STEPS):
        fixed, left = basis.largest(solved.denominator), equations.y - solved.fitted
        further = _stacked(_turned(basis, solved, fixed), left[:, None])
        change = _least_squares(*_extended(reduced, further))[len(solved.linear) :]
        step = np.insert(change, fixed, 0.0)
        trials = (_project(equations, basis, solved.denominator + step / 3**k) for k in range(6))
        better = next((each for each in trials if each[0].cost < solved.cost), None)
        if better is None:
            break
        gain, (solved, reduced) = 1 - better[0].cost / solved.cost, better
        if gain < least_gain or solved.cost < floor:
            break
    return solved


class _Basis(NamedTuple):
    """What all models of one order have in common; each column lies in one piece of memory."""

    powers: Powers
    columns: Complex[np.ndarray, "bins parameters"]  # of the numerators and transients
    size: Float[np.ndarray, " powers"]  # mean over the bins

    def largest(self, denominator: Float[np.ndarray, " powers"]) -> int:
        """The power whose term is largest over the bins."""
        return int(np.argmax(np.abs(denominator) * self.size))


def _basis(equations: Equations, size: int) -> _Basis:
    powers = equations.x[:, None] ** np.arange(size)
    columns = _regressors(powers, equations.u, equations.own)
    one_piece = np.asfortranarray(powers), np.asfortranarray(columns)
    return _Basis(*one_piece, np.mean(np.abs(powers), axis=0))


class _Reduced(NamedTuple):
    """Columns of unit length as LAPACK's QR decomposition leaves them."""

    qr: Float[np.ndarray, "rows columns"]
    tau: Float[np.ndarray, " columns"]
    length: Float[np.ndarray, " columns"]  # that they had


def _solve(
    equations: Equations, basis: _Basis, denominator: Float[np.ndarray, " powers"]
) -> Solved:
    return _project(equations, basis, denominator)[0]


def _project(
    equations: Equations, basis: _Basis, denominator: Float[np.ndarray, " powers"]
) -> tuple[Solved, _Reduced]:
    """The best linear coefficients under a denominator; and their columns, then the output."""
    below = basis.powers @ denominator
    least = _NEAREST * np.max(np.abs(below))
    below = np.where(np.abs(below) < least, least, below)
    joined = _stacked(basis.columns * (1 / below)[:, None], equations.y[:, None])
    reduced, rows = _reduce(joined), len(below)
    linear = _least_squares(np.triu(reduced.qr[: joined.shape[1]]), reduced.length)
    fitted = joined[:, :-1] @ linear
    cost = float(np.sum((joined[:, -1] - fitted) ** 2))
    solved = Solved(denominator, linear, below, fitted[:rows] + 1j * fitted[rows:], cost)
    return solved, reduced


def _turned(basis: _Basis, solved: Solved, fixed: int) -> Complex[np.ndarray, "bins parameters"]:
    """Derivatives of the fitted output by the denominator's coefficients but the fixed one."""
    return (-solved.fitted / solved.below)[:, None] * np.delete(basis.powers, fixed, axis=1)


def _slopes(basis: _Basis, solved: Solved, fixed: int) -> Complex[np.ndarray, "bins parameters"]:
    """Derivatives of the fitted output, all coefficients but the fixed one."""
    columns = basis.columns / solved.below[:, None]
    return np.concatenate([columns, _turned(basis, solved, fixed)], axis=1)


def _regressors(powers: Powers, u: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Powers times inputs, then all powers but the last times records."""
    parts = (u[:, :, None] * powers[:, None, :], own[:, :, None] * powers[:, None, :-1])
    return np.concatenate([part.reshape(len(u), -1) for part in parts], axis=1)


def _least_squares(
    triangle: Float[np.ndarray, "columns columns"], length: Float[np.ndarray, " columns"]
) -> Vector:
    """Coefficients of all columns but the last, which they fit, by the R of unit columns."""
    found = np.linalg.lstsq(triangle[:-1, :-1], triangle[:-1, -1], rcond=1e-13)[0]
    return found * length[-1] / length[:-1]


def _lengths(columns: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, " columns"]:
    """Euclidean norms; 1 for columns of zeros."""
    length = np.sqrt(np.einsum("ij,ij->j", columns, columns))
    return np.where(length > 0, length, 1.0)


def _reduce(joined: Float[np.ndarray, "rows columns"]) -> _Reduced:
    """numpy.linalg.qr takes twice the time, for copies."""
    from scipy.linalg.lapack import dgeqrf  # pyright: ignore[reportAttributeAccessIssue]

    length = _lengths(joined)
    qr, tau, *_ = dgeqrf(joined / length, overwrite_a=True)
    return _Reduced(qr, tau, length)


def _triangle(matrix: Float[np.ndarray, "rows columns"]) -> Float[np.ndarray, "columns columns"]:
    """R of the QR decomposition."""
    from scipy.linalg.lapack import dgeqrf  # pyright: ignore[reportAttributeAccessIssue]

    return np.triu(dgeqrf(matrix, overwrite_a=True)[0][: matrix.shape[1]])


def _extended(
    reduced: _Reduced, further: Float[np.ndarray, "rows columns"]
) -> tuple[Float[np.ndarray, "all all"], Float[np.ndarray, " all"]]:
    """R and lengths of all columns that are reduced, but the last, and of `further` ones."""
    from scipy.linalg.lapack import dormqr  # pyright: ignore[reportAttributeAccessIssue]

    count, length = len(reduced.tau) - 1, _lengths(further)
    kept, size = reduced.qr[:, :count], count + further.shape[1]
    work = 64 * further.shape[1]
    turned, *_ = dormqr(
        "L", "T", kept, reduced.tau[:count], further / length, work, overwrite_c=True
    )
    triangle = np.zeros((size, size))
    triangle[:count, :count], triangle[:count, count:] = np.triu(kept[:count]), turned[:count]
    triangle[count:, count:] = _triangle(turned[count:])
    return triangle, np.concatenate([reduced.length[:count], length])


def _stacked(
    *parts: Complex[np.ndarray, "rows _"],
) -> Float[np.ndarray, "stacked columns"]:
    """Columns side by side, real above imaginary parts, in the order that LAPACK takes."""
    rows, ends = len(parts[0]), np.cumsum([0, *(part.shape[1] for part in parts)])
    stacked = np.empty((2 * rows, ends[-1]), order="F")
    for part, start, end in zip(parts, ends[:-1], ends[1:], strict=True):
        stacked[:rows, start:end], stacked[rows:, start:end] = np.real(part), np.imag(part)
    return stacked


def _own(record: Int[np.ndarray, " bins"], records: int) -> Float[np.ndarray, "bins records"]:
    return (record[:, None] == np.arange(records)).astype(float)


def running_power(
    omega: Float[np.ndarray, " bins"],
    values: Complex[np.ndarray, " bins"],
    freedom: Float[np.ndarray, " bins"],
) -> Float[np.ndarray, " bins"]:
    """Sum of |values|^2 over that of `freedom`, within a fifth of a neper of each bin."""
    each = np.arange(omega.size)
    first = np.searchsorted(omega, omega * np.exp(-_BANDWIDTH))
    last = np.searchsorted(omega, omega * np.exp(_BANDWIDTH), "right")
    first = np.maximum(np.minimum(first, each - _NEIGHBOURS), 0)
    last = np.minimum(np.maximum(last, each + _NEIGHBOURS + 1), omega.size)
    power, count = (
        np.concatenate([[0.0], np.cumsum(part)]) for part in (np.abs(values) ** 2, freedom)
    )
    return (power[last] - power[first]) / np.maximum(count[last] - count[first], 1.0)
