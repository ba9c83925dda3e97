"""Delays of what passes directly from a held input: the whole samples at which a record shows it.

y = D u(t - delay) is sampled as D z^-n, n = ceil(delay / h), for all delays of one sample alike.
The cost jumps from one n to the next, where no descent finds its way: first the direct part turns
evenly, as it does on average over the delays of a sample; then the samples next to that are solved.
Within its sample only the rest of the response tells the delay. Where that says less than the
sample does, the sample is what is known: a uniform density, by its mean and variance.
Source: Minka (2001), Expectation propagation for approximate Bayesian inference, UAI 17.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import Message
from jaxquad.records import Record
from jaxquad.spectra import FrequencyResponse

from ..uncertainty._error_budget import scaled_inverse
from ._parameters import Condition, Numbers
from ._problem import Problem
from ._sampled import Aliases, direct_part, whole_samples


_DIGITS = 9  # of slopes: delays that change alike
# A delay that its sample leaves with that share of its standard error, and does not move by more
# standard errors, is known better from the rest of the response.
_SEEN, _MOVED = 0.95, 0.05
_NARROWED = 0.9  # of the deviation of a sample, below which an interval is no longer that sample
_REACH = 8.0  # standard errors, beyond which a density is nothing
_PLACES = 401  # at which it is integrated
_NOTHING = 1e-3  # of the precision of a sample
_STEPS = 12  # of Newton's method, to the middles of samples
_FIRST = 0.1  # samples, of a delay that is next to none

Vector = Float[np.ndarray, " free"]


@dataclasses.dataclass(frozen=True, eq=False)
class DirectDelay:
    """The delay in s from an input directly to an output, as a function of the model."""

    condition: Condition
    record: int
    output: int
    input: int

    def __call__(self, model: PyTree) -> Float[Array, ""]:
        direct = direct_part(self.condition(model))
        assert direct is not None
        return direct[1][self.output, self.input]

    def __hash__(self) -> int:
        return hash((id(self.condition), self.output, self.input))

    def __eq__(self, other: object) -> bool:  # what a compiled program depends on
        key = lambda x: (id(x.condition), x.output, x.input)
        return isinstance(other, DirectDelay) and key(self) == key(other)


@eqx.filter_jit
def _delays(z: Float[Numbers, " free"], problem: Problem):
    """Gains and delays of the direct parts of all records, and the delays' slopes by `z`."""

    def late(z):
        model = problem.parameters.insert(problem.model, z)
        parts = [direct_part(change(model)) for change in problem.conditions]
        gains, delays = zip(*(part or (None, None) for part in parts), strict=True)
        return list(delays), list(gains)

    delays, gains = late(z)
    return gains, delays, jax.jacfwd(lambda z: late(z)[0])(z)


def _aliases(problem: Problem, delay: DirectDelay) -> Aliases:
    aliases = problem.aliases[delay.record]
    assert aliases is not None
    return aliases


def free_delays(problem: Problem) -> list[list[DirectDelay]]:
    """Those of direct parts behind a hold that free parameters change, in lists that go along."""
    ours = [k for k, a in enumerate(problem.aliases) if a is not None and a.samples is not None]
    if not ours:
        return []
    z = np.asarray(problem.parameters.start)[: problem.parameters.count]
    gains, _, slopes = jax.tree.map(np.asarray, _delays(z, problem))
    groups: dict[bytes, list[DirectDelay]] = {}
    for k in ours:
        for o, i in np.argwhere(gains[k] != 0).tolist():
            if np.any(slope := slopes[k][o, i]):
                key = np.round(slope / np.max(np.abs(slope)), _DIGITS).tobytes()
                groups.setdefault(key, []).append(DirectDelay(problem.conditions[k], k, o, i))
    return list(groups.values())


def with_samples(
    problem: Problem, groups: Sequence[Sequence[DirectDelay]], counts: Sequence[Sequence[float]]
) -> Problem:
    """The problem with its direct parts so many samples late; nan: as their delays, on average."""
    arrays = {k: np.array(a.samples) for k, a in enumerate(problem.aliases) if a is not None}
    for group, row in zip(groups, counts, strict=True):
        for delay, count in zip(group, row, strict=True):
            arrays[delay.record][delay.output, delay.input] = count
    aliases = tuple(
        a if a is None or a.samples is None else dataclasses.replace(a, samples=arrays[k])
        for k, a in enumerate(problem.aliases)
    )
    return dataclasses.replace(problem, aliases=aliases)


def unsampled(problem: Problem, groups: Sequence[Sequence[DirectDelay]]) -> Problem:
    """The problem whose direct parts turn evenly with their delays."""
    return with_samples(problem, groups, [[np.nan] * len(group) for group in groups])


def _to_middles(problem: Problem, z: Vector, groups: Sequence[Sequence[DirectDelay]]) -> Vector:
    """The parameters with each delay in the middle of its sample, as near as they allow."""
    for _ in range(_STEPS):
        _, delays, slopes = jax.tree.map(np.asarray, _delays(z, problem))
        rows, missing = [], []
        for one, *_ in groups:
            aliases, at = _aliases(problem, one), (one.output, one.input)
            samples = max(float(np.asarray(aliases.samples)[at]) - 0.5, _FIRST)
            missing.append(samples * float(aliases.hold) - delays[one.record][at])
            rows.append(slopes[one.record][at])
        z = z + np.clip(np.linalg.pinv(np.array(rows)) @ np.array(missing), -1.0, 1.0)
    return z


class Solved(NamedTuple):
    """Where a descent ended; of a fit in the time domain, too."""

    solution: Any
    z: Vector
    cost: float  # or deviance
    information: Float[np.ndarray, "free free"]  # J'J of its weighted residuals and priors


Solve = Callable[[Problem, Vector], Solved]


def find_samples(
    problem: Problem, z: Vector, groups: Sequence[Sequence[DirectDelay]], solve: Solve
) -> tuple[Problem, Solved]:
    """The problem with direct parts of whole samples, and its solution, from near `z`.

    Samples next to those of `z` are solved, too, one group after the other, until none is better.
    """
    _, delays, _ = jax.tree.map(np.asarray, _delays(z, problem))

    def sample(one: DirectDelay) -> float:
        samples = whole_samples(delays[one.record], _aliases(problem, one).hold)
        return float(np.asarray(samples)[one.output, one.input])

    counts = [[sample(one) for one in group] for group in groups]

    def attempt(counts: Sequence[Sequence[float]], z: Vector) -> tuple[Problem, Solved]:
        tried = with_samples(problem, groups, counts)
        # From within the samples: beyond their ends there may be minima that are none.
        return tried, solve(tried, _to_middles(tried, z, groups))

    best, improved = attempt(counts, z), True
    while improved:
        improved = False
        for k, row in enumerate(counts):
            for step in (-1.0, 1.0):
                moved = [*counts[:k], [count + step for count in row], *counts[k + 1 :]]
                if min(moved[k]) < 0:
                    continue
                other = attempt(moved, best[1].z)
                if other[1].cost < best[1].cost:
                    best, counts, improved = other, moved, True
    return best


class SampleLimit(NamedTuple):
    """What the sample of a direct part tells of its delay, as one more measurement."""

    delay: DirectDelay
    low: float  # s
    high: float
    value: float
    standard_error: float
    narrowed: bool = False  # whether the rest of the response says more than the sample


def sample_limits(
    problem: Problem, z: Vector, groups: Sequence[Sequence[DirectDelay]], solve: Solve
) -> tuple[list[SampleLimit], Vector]:
    """For delays of which the rest of the response tells less than the sample does.

    With the parameters under the limits of all samples.
    """
    if not groups:
        return [], z
    slopes = _delays(z, problem)[2]
    rows, limits = [], []
    for one, *_ in groups:
        aliases, at = _aliases(problem, one), (one.output, one.input)
        row, hold = np.asarray(slopes[one.record])[at], float(aliases.hold)
        high = float(np.asarray(aliases.samples)[at]) * hold
        # A delay of no sample is none, and sums of others say nothing new.
        if high > 0 and np.linalg.matrix_rank(np.array([*rows, row])) > len(rows):
            rows.append(row)
            middle, error = high - hold / 2, hold / np.sqrt(12)
            limits.append(SampleLimit(one, high - hold, high, middle, error))
    if not limits:
        return [], z
    # With the mean and variance of each sample, which keeps the delays where slopes of the rest
    # hold; without its own, that of a delay is what all else tells of it.
    within = limited(problem, limits)
    solved = solve(within, _to_middles(problem, z, groups))
    _, late, slopes = _delays(solved.z, problem)
    jacobian = np.array(
        [np.asarray(slopes[one.record])[one.output, one.input] for one, *_ in limits]
    )
    spread = np.diagonal(jacobian @ scaled_inverse(solved.information) @ jacobian.T)
    needed = []
    for limit, variance in zip(limits, spread, strict=True):
        one, low, high, middle, error, _ = limit
        mean = float(np.asarray(late[one.record])[one.output, one.input])
        precision = 1 / variance - 1 / error**2
        if precision < _NOTHING / error**2:
            needed.append(limit)
            continue
        aim = (mean / variance - middle / error**2) / precision
        free = precision**-0.5
        nearest = min(max(aim, low), high)
        low_end, high_end = nearest - _REACH * free, nearest + _REACH * free
        x = np.linspace(max(low, low_end), min(high, high_end), _PLACES)
        density = -0.5 * ((x - aim) / free) ** 2
        density = np.exp(density - density.max())
        density /= density.sum()
        mean = float(density @ x)
        variance = float(density @ (x - mean) ** 2)
        if variance > _SEEN**2 / precision and abs(mean - aim) < _MOVED * free:
            continue
        more = 1 / variance - precision
        value = (mean / variance - aim * precision) / more
        narrowed = variance < (_NARROWED * error) ** 2
        needed.append(SampleLimit(one, low, high, value, more**-0.5, narrowed))
    return needed, solved.z


def limited(problem: Problem, limits: Sequence[SampleLimit]) -> Problem:
    """The problem with these limits after its priors."""
    rows = [[one.value, one.standard_error] for one in limits]
    return dataclasses.replace(
        problem,
        quantities=(*problem.quantities, *(one.delay for one in limits)),
        prior=np.concatenate([np.asarray(problem.prior), rows]),
    )


def remarks_on_samples(
    problem: Problem, limits: Sequence[SampleLimit], data: Sequence[FrequencyResponse | Record]
) -> list[Message]:
    """Say which sample is all that is known of a delay, and which direct part nobody knows."""
    remarks = list[Message]()
    for delay, low, high, _, _, narrowed in limits:
        of, extent = data[delay.record], "the interval is that sample"
        if narrowed:
            extent = "the rest of the response narrows the interval"
        text = (
            f"{of.input_names[delay.input]} passes directly to {of.output_names[delay.output]}, "
            "which shows in whole samples of the held input: its delay lies between "
            f"{1e3 * low:.4g} and {1e3 * high:.4g} ms, and {extent}; "
            "record at a higher rate to know it better"
        )
        remarks.append(Message(text, "sampled delay"))
    if any(aliases is not None and aliases.is_level for aliases in problem.aliases):
        text = (
            "the model's response does not fall at high frequencies: behind a hold, what passes "
            "directly shows in whole samples, which this model does not tell; its estimates may be "
            "far off: give it transfer_function() or state_space()"
        )
        remarks.append(Message(text, "hold"))
    return remarks
