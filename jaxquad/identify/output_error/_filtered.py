"""Output error of one output behind one input by filters, where the general way differentiates.

At its samples a rational model is y = B(q) u / A(q), and all slopes of y lie in two signals:

    dy = dB(q) w - dA(q) v,  with  w = u / A  and  v = y / A.

So an evaluation takes two passes over the record, whatever the number of parameters is. Start and
trim leave the slopes as far as they are orthogonal to what start and trim do, which is all that
counts of them (variable projection).
Source: Ljung, System Identification, sec. 10.3; Kaufman (1975), A variable projection method for
solving separable nonlinear least squares problems, BIT 15.
"""

import dataclasses
import functools as ft
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import Normal
from jaxquad.models import sample_rational

from ..frequency_domain._parameters import Numbers
from ..frequency_domain._solve import evaluate, Frame, take_apart
from ._problem import Evaluation, insert_parameters, OutputError, RecordTerm
from ._simulated import band_filter, linear_model, Rational


_MOST = 4  # poles, beyond which the coefficients of A may say too little of them
_DIGITS = 1e6  # rounding of the output, in units of the last bit of its largest value
_RIDGE = 1e-10  # of the squared length of a column, and taken out again by refinement
_REFINEMENTS = 3

Samples = Float[np.ndarray, " samples"]
Values = Float[np.ndarray, " parameters"]  # in the coordinates of the descent
Rows = Float[np.ndarray, "rows samples"]


class Sampled(NamedTuple):
    """A `SampledRational` on the host, and what the parameters do to its coefficients."""

    above: Float[np.ndarray, " zeros"]
    below: Float[np.ndarray, " poles"]
    shift: int
    step: Float[np.ndarray, "both both"]
    row: Float[np.ndarray, " both"]
    slopes: Float[np.ndarray, "coefficients parameters"]  # of B and then of A


class Columns(NamedTuple):
    """What start and trim do to a record: a unit shift, then the free motions, which are biases and
    initial values."""

    free: Rows  # motions
    rows: Rows  # shift and motions, within the band
    scale: Float[np.ndarray, " rows"]  # that brings shift and motions to unit length
    normal: Float[np.ndarray, "rows rows"]  # their products at unit length, with a ridge


class Simulated(NamedTuple):
    """One record: what is left of it, and what its slopes are made of."""

    sampled: Sampled
    driven: Samples  # u / A
    output: Samples  # with the free motions
    columns: Columns
    misfit: Samples  # weighted, and orthogonal to the columns


Program = Callable[[Values], Sampled]


def is_filtered(problem: OutputError) -> bool:
    """Whether all records are of one output and one input of a rational model, in white noise."""
    base = problem.base
    if problem.unknown or any(term.motions is None for term in problem.terms):
        return False
    if any(term.direct_samples is not None for term in problem.terms):
        return False
    plant = linear_model(base.model)
    rational = isinstance(plant, Rational) and 2 <= plant.denominator.size <= _MOST + 1
    plain = (term.whitener is None and term.feedback is None for term in problem.terms)
    return rational and all(plain)


@dataclasses.dataclass(frozen=True, eq=False)
class FilteredPoint:
    """Where a descent by filters stands."""

    problem: OutputError
    programs: list[Program]  # of each record
    z: Values
    records: list[Simulated]
    prior_misfits: Float[np.ndarray, " priors"]
    prior_slopes: Float[np.ndarray, "priors parameters"]

    @property
    def cost(self) -> float:
        """Half the sum of squares; infinite where something is not finite."""
        parts = [self.prior_misfits, *(one.misfit for one in self.records)]
        cost = 0.5 * sum(float(part @ part) for part in parts)
        return cost if np.isfinite(cost) else np.inf

    @ft.cached_property
    def behind(self) -> list[Samples]:
        """y / A of each record."""
        return [_over(one.sampled.below, one.output) for one in self.records]

    @ft.cached_property
    def rows(self) -> list[Rows]:
        """The slopes of each record's misfit, up to what start and trim can do."""
        rows = []
        for term, one, behind in zip(self.problem.terms, self.records, self.behind, strict=True):
            model, driven = one.sampled, -one.driven
            late = [(driven, k) for k in range(model.above.size)]
            late += [(behind, k + 1) for k in range(model.below.size)]
            signals = np.empty((len(late), len(behind)))
            for row, (signal, k) in zip(signals, late, strict=True):
                row[:k], row[k:] = 0.0, signal[: len(signal) - k]
            rows.append(_in_band(term, float(term.weights[0]) * model.slopes.T @ signals))
        return rows

    @ft.cached_property
    def normal(self) -> tuple[np.ndarray, np.ndarray]:
        """Gradient and Gauss-Newton Hessian."""
        gradient = self.prior_slopes.T @ self.prior_misfits
        hessian = self.prior_slopes.T @ self.prior_slopes
        for one, rows in zip(self.records, self.rows, strict=True):
            gradient = gradient + rows @ one.misfit
            # Products of the rows' parts orthogonal to the columns.
            columns = one.columns
            shared = columns.scale[:, None] * (columns.rows @ rows.T)
            products = _row_products(rows) - shared.T @ np.linalg.solve(columns.normal, shared)
            hessian = hessian + products
        return gradient, hessian

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        return self.normal

    def moved(self, change: Values) -> "FilteredPoint":
        return FilteredPoint.at(self.problem, self.programs, self.z + change)

    @staticmethod
    def at(problem: OutputError, programs: list[Program], z: Values) -> "FilteredPoint":
        parts = zip(problem.terms, programs, strict=True)
        records = [_simulated(term, sample(z)) for term, sample in parts]
        misfits, slopes = np.zeros(0), np.zeros((0, z.size))
        if problem.base.quantities:
            [priors] = evaluate(problem.base, z)
            misfits, slopes = priors.prior_misfits, priors.prior_slopes[:, : z.size]
        return FilteredPoint(problem, programs, z, records, misfits, slopes)

    @property
    def is_precise(self) -> bool:
        """Whether rounding of the coefficients leaves the digits that a fit needs."""
        for one, behind in zip(self.records, self.behind, strict=True):
            above, size = np.sum(np.abs(one.sampled.above)), float(np.max(np.abs(one.output)))
            driven = float(above * np.max(np.abs(one.driven)))
            needed = max(float(np.max(np.abs(behind))), driven)
            if not (np.isfinite(needed) and needed <= _DIGITS * size):
                return False
        return True

    @property
    def evaluation(self) -> Evaluation:
        """As the general way gives it."""
        misfits = [one.misfit[:, None] for one in self.records]
        slopes = [rows.T[:, None] for rows in self.rows]
        columns = [one.columns.rows.T[:, None] for one in self.records]
        normal = Normal(self.cost, *self.normal)  # pyright: ignore[reportArgumentType]
        return Evaluation(misfits, slopes, columns, normal)


def filtered_point(problem: OutputError, z: Values) -> FilteredPoint:
    """Where a descent begins."""
    frame, arrays = take_apart(OutputError(problem.base, (), problem.zeros))

    def sampler(term: RecordTerm) -> Program:
        run = _program(frame, term.hold)

        def sample(z: Values) -> Sampled:
            coefficients, motion, shift = map(np.asarray, run(z, term.dt, arrays))
            both = motion.shape[1]
            above, below = np.split(coefficients[:, 0], [both // 2 + 2])
            parts = (motion[:both], motion[both], coefficients[:, 1:])
            return Sampled(above, below, int(shift), *parts)

        return sample

    return FilteredPoint.at(problem, [sampler(term) for term in problem.terms], np.asarray(z))


@ft.lru_cache(maxsize=64)
def _program(frame: Frame, hold: str) -> Callable[[np.ndarray, float, list[Numbers]], PyTree]:
    """Few arrays come back: each takes longer than its numbers."""

    def run(z: Float[Array, " parameters"], dt: Float[Array, ""], arrays: list[Array]) -> PyTree:
        problem = frame.filled(arrays)

        def coefficients(z):
            plant = linear_model(insert_parameters(z, problem))
            assert isinstance(plant, Rational)
            model = sample_rational(plant, dt, hold)
            both = jnp.concatenate([model.above, model.below])
            return both, (both, jnp.concatenate([model.step, model.rows]), model.shift)

        slopes, (both, motion, shift) = jax.jacfwd(coefficients, has_aux=True)(z)
        return jnp.concatenate([both[:, None], slopes], axis=1), motion, shift

    return jax.jit(run)


def _simulated(term: RecordTerm, sampled: Sampled) -> Simulated:
    u, samples, shift = np.asarray(term.u)[:, 0], len(term.y), sampled.shift
    # The input from its first value, so many samples later; after the record it stays as it is.
    late, kept = np.zeros(len(u)), max(len(u) - abs(shift), 0)
    if shift < 0:
        late[:kept], late[kept:] = u[len(u) - kept :], u[-1]
        late = late - u[0]
    else:
        late[len(u) - kept :] = u[:kept] - u[0]
    with np.errstate(all="ignore"):  # an unstable model is a failed step
        driven = _over(sampled.below, late)
        forced = np.convolve(driven, sampled.above)[:samples]
        columns = _columns(term, _free_motions(term, sampled, samples))
        left = np.asarray(term.y)[:, 0] - _in_band(term, forced)
        misfit, unknowns = _project_out(left, columns)
        # A shift stays what it is, whatever A does.
        forced += unknowns[1:] @ columns.free
    return Simulated(sampled, driven, forced, columns, float(term.weights[0]) * misfit)


def _over(below: Float[np.ndarray, " poles"], x: Samples) -> np.ndarray:
    """`x` / A, from rest."""
    from scipy.signal import lfilter

    with np.errstate(all="ignore"):
        return np.asarray(lfilter(np.ones(1), np.concatenate([[1.0], below]), x))


def _in_band(term: RecordTerm, x: Float[np.ndarray, "*rows samples"]) -> np.ndarray:
    return x if term.gain is None else np.asarray(band_filter(x.T, np.asarray(term.gain))).T


def _free_motions(term: RecordTerm, sampled: Sampled, samples: int) -> Rows:
    """Biases on the slow motions and initial values of the fast ones."""
    assert term.motions is not None
    slow, fast = map(np.asarray, term.motions)
    states = len(slow)
    if not slow.shape[1]:  # there are no biases
        step, row, ways = sampled.step[:states, :states], sampled.row[:states], fast.T
    else:
        step, row = sampled.step, sampled.row
        ways = np.zeros((slow.shape[1] + fast.shape[1], 2 * states))
        ways[: slow.shape[1], states:], ways[slow.shape[1] :, :states] = slow.T, fast.T
    # `row` step^k for each sample k.
    motion = np.empty((len(row), samples))
    motion[:, 0], done, power = row, 1, step.T
    while done < samples:
        more = min(done, samples - done)
        np.matmul(power, motion[:, :more], out=motion[:, done : done + more])
        power, done = power @ power, done + more
    return ways @ motion


def _columns(term: RecordTerm, free: Rows) -> Columns:
    rows = _in_band(term, np.vstack([np.ones(len(term.y)), free]))
    normal = _row_products(rows)
    square = np.diagonal(normal)
    scale = 1 / np.sqrt(np.where(square > 1e-20 * np.max(square), square, 1.0))
    ridged = normal * np.outer(scale, scale) + _RIDGE * np.eye(len(normal))
    return Columns(free, rows, scale, ridged)


def _project_out(misfit: Samples, columns: Columns) -> tuple[Samples, Float[np.ndarray, " rows"]]:
    """The misfit that no start, trim or shift explains, and how much of each does explain."""
    aim, unknowns = columns.scale * (columns.rows @ misfit), np.zeros(len(columns.scale))
    if not np.all(np.isfinite(aim)):
        return np.full_like(misfit, np.nan), unknowns
    plain = columns.normal - _RIDGE * np.eye(len(aim))
    for _ in range(_REFINEMENTS):
        unknowns = unknowns + np.linalg.solve(columns.normal, aim - plain @ unknowns)
    unknowns = columns.scale * unknowns
    return misfit - unknowns @ columns.rows, unknowns


def _row_products(rows: Float[np.ndarray, "rows samples"]) -> Float[np.ndarray, "rows rows"]:
    """Products of each two of a few long rows. By a copy: BLAS's own way for a matrix and its
    transpose takes two to four times as long here."""
    return rows @ rows.copy(order="K").T
