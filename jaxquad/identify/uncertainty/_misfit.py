"""Misfits of a kind: local in frequency, where they are and what they may move; along a sweep.

A stationary discrepancy hardly sees a notch or a mode of the plant: beside many points that fit,
it is improbable. So windows from half an octave to the whole band are searched, overlapping by
half. In each, the squares of misfit over random error, each divided by the number of points that
share its noise, sum to chi-squared; degrees of freedom are 2 for each point of independent noise,
less what the parameters take off. The noise is an estimate, so this is an F of these degrees and
its own (`log_noise_covariance`). The least probability of all windows, times their number, bounds
that of a false alarm (Bonferroni).
Source: Glaz, Naus & Wallenstein (2001), Scan Statistics.

A sweep has each frequency at one time, so what drifts with time does so along frequency: a gain, or
the clock of the output, whose stamps come later and later. Its score test is the next step of the
fit with such a drift as one more parameter.
Source: Rao (1948), Large sample tests of statistical hypotheses.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from jaxquad.spectra import in_hertz

from ..frequency_domain._cost import Points
from ._discrepancy import SHARES
from ._error_budget import ErrorBudget, Matrix, scaled_inverse
from ._response_term import PriorRows, ResponseTerm


DRIFT, CLOCK = "drift", "clock"  # kinds of remarks
MISFIT = 1.5  # ratio of misfit to random error from which the model's structure is in doubt
DOUBT = 0.05  # probability that the model is right, below which a misfit is remarked
_CHANCE = 0.002  # of a local misfit somewhere, where the model is right
_WIDTHS = (0.5, 1.0, 2.0)  # octaves
_MOST = 0.5  # share of the misfit beyond the noise
_FEWEST = 2.0  # degrees of freedom of a window
_FALLS, _RISES = 0.004, 0.0005  # chance of a remark on what is steady: batteries fall
_LOOKED_AT = 2.0  # standard errors of a drift from which its covariance is computed
_EXPLAINED = 0.2  # of a large misfit, which a drift may leave


class LocalMisfit(NamedTuple):
    """The window of the clearest misfit."""

    ratio: float  # of misfit to random error
    low: float  # rad/s
    high: float
    within: bool  # a part of the band, and not the whole of it

    def __str__(self) -> str:
        where = in_hertz(np.array([self.low, self.high]))
        return f"{self.ratio:.1f} times from {where}"


def find_local_misfit(
    budget: ErrorBudget, points: Sequence[Points], floor: float, least: float
) -> LocalMisfit | None:
    """Where the misfit is more than `least` random errors, beyond chance; a discrepancy of the
    amplitude `floor` wide as noise. None where the noise explains it everywhere."""
    from scipy.special import chdtrc, fdtrc

    tried, candidates, inverse = 0, [], scaled_inverse(budget.bread)
    for record, counted in zip(budget.records, points, strict=True):
        omega = np.asarray(record.frf.omega)
        for o, i in record.pairs:
            some = np.flatnonzero(record.used[:, o, i])
            some = some[np.argsort(omega[some], kind="stable")]
            independent = 1 / np.asarray(counted.shared)[some, o, i]
            sums = _sums(record, independent, some, (o, i), inverse, floor)
            starts, ends = _windows(np.log2(omega[some]))
            total, count, freedom, wide, clear = _in_windows(sums, starts, ends, least)
            tried += int(np.sum(wide))
            if not np.any(clear):
                continue
            covariance = record.frf.log_noise_covariance
            if covariance is None:
                chances = chdtrc(freedom, total)
            else:
                shared = (
                    independent[:, None] * np.asarray(covariance)[np.ix_(some, some)] * independent
                )
                area = np.pad(shared.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
                doubt = area[ends, ends] - area[starts, ends] - area[ends, starts]
                of_noise = 2 * count**2 / np.maximum(doubt + area[starts, starts], 1e-9)
                chances = fdtrc(freedom, of_noise, total / freedom)
            # The narrowest window that holds most of the misfit.
            beyond = np.where(clear, total - freedom, 0.0)
            most = np.flatnonzero(beyond >= _MOST * np.max(beyond))
            k = most[np.argmin(np.log(omega[some[ends[most] - 1]] / omega[some[starts[most]]]))]
            edges = float(omega[some[starts[k]]]), float(omega[some[ends[k] - 1]])
            ratio = float(np.sqrt(total[k] / freedom[k]))
            local = LocalMisfit(ratio, *edges, bool(k))
            candidates.append((float(np.min(chances[clear])), -float(np.max(beyond)), local))
    chance, _, clearest = min(candidates, key=lambda one: one[:2], default=(1.0, 0.0, None))
    return clearest if tried * chance < _CHANCE else None


def _sums(
    record: ResponseTerm,
    independent: Float[np.ndarray, "*members some"],
    some: Int[np.ndarray, " some"],
    pair: tuple[int, int],
    inverse: Matrix,
    floor: float,
) -> Float[np.ndarray, "3 *members ends"]:
    """Up to each of `some` points: squares over their errors, independent points, and what the
    parameters take off."""
    errors = record.error[..., some, *pair][..., None] ** 2 + (floor * SHARES) ** 2
    squares = np.sum(record.misfit[..., some, *pair, :] ** 2 / errors, axis=-1)
    squares = np.where(independent > 0, independent * squares, 0.0)
    rows = record.rows[..., some, *pair, :, : record.count]
    taken = np.sum((rows @ inverse[..., None, :, :]) * rows, axis=(-2, -1))
    sums = np.cumsum([squares, independent, taken], axis=-1)
    return np.concatenate([np.zeros((*sums.shape[:-1], 1)), sums], axis=-1)


def _in_windows(
    sums: Float[np.ndarray, "3 *members ends"],
    starts: Int[np.ndarray, " windows"],
    ends: Int[np.ndarray, " windows"],
    least: float,
) -> tuple[np.ndarray, ...]:
    """Squares, independent points and degrees of freedom in windows, which of them are wide enough,
    and in which the misfit is more than `least` random errors."""
    total, count, taken = sums[..., ends] - sums[..., starts]
    freedom, wide = np.maximum(2 * count - taken, count), 2 * count >= _FEWEST
    wide[..., 0] = True
    return total, count, freedom, wide, wide & (total > least**2 * freedom)


def may_have_local_misfits(
    budget: ErrorBudget, shared: Float[np.ndarray, "members frequencies outputs inputs"]
) -> Bool[np.ndarray, " members"]:
    """Which of many fits have a local misfit, if their noise were known: with that of an estimate,
    `find_local_misfit` finds as many or fewer."""
    from scipy.special import chdtrc

    [record], inverse = budget.records, scaled_inverse(budget.bread)
    omega, tried, chance = np.asarray(record.frf.omega), np.zeros(len(shared)), np.ones(len(shared))
    order = np.argsort(omega, kind="stable")
    place = np.log2(omega[order])
    for pair in record.pairs:
        used = record.used[:, order, *pair]
        independent = np.where(used, 1 / shared[:, order, *pair], 0.0)
        sums = _sums(record, independent, order, pair, inverse, 0.0)
        limits = np.stack([np.argmax(used, axis=1), np.argmax(np.cumsum(used, axis=1), axis=1)])
        for first, last in np.unique(limits[:, np.any(used, axis=1)], axis=1).T:
            mine = (limits[0] == first) & (limits[1] == last)
            starts, ends = _windows(place[first : last + 1])
            numbers = _in_windows(sums[:, mine], first + starts, first + ends, MISFIT)
            total, _, freedom, wide, clear = numbers
            tried[mine] += np.sum(wide, axis=-1)
            chances = chdtrc(freedom, total, out=np.ones(total.shape), where=clear)
            chance[mine] = np.minimum(chance[mine], np.min(chances, axis=-1))
    return tried * chance < _CHANCE


def _windows(place: Float[np.ndarray, " points"]) -> tuple[np.ndarray, np.ndarray]:
    """First points of windows, and those behind their last; the whole band is the first."""
    low, high = place[0], place[-1]
    starts, ends = [np.array([low])], [np.array([high])]
    for width in _WIDTHS:
        if width < high - low:
            begin = np.linspace(low, high - width, int(np.ceil(2 * (high - low) / width)))
            starts, ends = [*starts, begin], [*ends, begin + width]
    first = np.searchsorted(place, np.concatenate(starts) - 1e-9)
    last = np.searchsorted(place, np.concatenate(ends) + 1e-9)
    return first[last > first], last[last > first]


def local_misfits(
    budget: ErrorBudget, points: Sequence[Points]
) -> tuple[LocalMisfit | None, LocalMisfit | None]:
    """Beyond the noise, and beyond noise and discrepancy. Neighbours share a discrepancy, which
    only a larger misfit exceeds beyond chance."""
    local = find_local_misfit(budget, points, 0.0, MISFIT)
    if local is None or budget.discrepancy.none >= DOUBT:
        return local, local
    floor = float(budget.mixtures[0].amplitude)
    return local, find_local_misfit(budget, points, floor, MISFIT**2)


class Drift(NamedTuple):
    """What changes while a sweep lasts, as the residual shows it: the gain, relative, or by how
    much the output's stamps are late, in s."""

    kind: str  # of the remark
    change: float
    standard_error: float
    seconds: float  # that the sweep lasts
    chance: float  # of as much where nothing changes, on this side
    misfit_ratio: float  # with it

    def is_clear(self, misfit: float) -> bool:
        """Whether it is beyond chance and explains the fit's `misfit`."""
        falls = self.kind == DRIFT and self.change < 0
        clear = self.chance < (_FALLS if falls else _RISES)
        return clear and self.misfit_ratio < max(MISFIT**2, _EXPLAINED * misfit)

    def __str__(self) -> str:
        number, error = self.change, self.standard_error
        if self.kind == DRIFT:
            what = f"gain changed by {100 * number:+.2g} % (standard error {100 * error:.2g} %)"
            remedy = "Sweep in both directions, or with a full battery"
        else:
            rate = 1e6 * number / self.seconds
            what = (
                f"output's time stamps drifted by {1e3 * number:+.2g} ms (standard error "
                f"{1e3 * error:.2g} ms; {rate:+.2g} ppm)"
            )
            remedy = "Stamp input and output by one clock, or sweep in both directions"
        return (
            f"the misfit changes along the sweep, as if the {what} in {self.seconds:.3g} s, which "
            "the intervals do not include; or the model lacks a term («Fit.explain()» tries "
            f"both). {remedy}"
        )


def find_drift(budget: ErrorBudget) -> Drift | None:
    """The clearest drift that the residual of sweeps shows; None of other excitation."""
    if any(record.frf.swept_at is None for record in budget.records):
        return None
    drifts = [_score_drift(budget, kind) for kind in (DRIFT, CLOCK)]
    return min(filter(None, drifts), key=lambda drift: drift.chance, default=None)


def _score_drift(budget: ErrorBudget, kind: str) -> Drift | None:
    """The next step of the fit with one kind of drift; None where it is within the noise."""
    from scipy.special import stdtr

    records, count, times = [], budget.count, []
    for record in budget.records:
        time = np.asarray(record.frf.swept_at)[:, None, :]
        times.append(time[np.any(record.used, axis=1, keepdims=True) & np.isfinite(time)])
        column = np.zeros((*record.misfit.shape, 1))
        if kind == DRIFT:
            column[..., 0, 0] = np.where(record.used, time, 0.0)
        else:
            turn = -np.asarray(record.frf.omega)[:, None, None] * time
            column[..., 1, 0] = np.where(record.used, turn, 0.0)
        slopes = np.concatenate([record.slopes[..., :count], column], axis=-1)
        records.append(dataclasses.replace(record, slopes=slopes, count=count + 1))
    priors = np.pad(budget.prior.slopes[:, :count], ((0, 0), (0, 1)))
    more = ErrorBudget(records, PriorRows(budget.prior.misfit, priors), count + 1)
    inverse = scaled_inverse(more.bread)
    step = inverse @ more.gradient
    if not step[-1] ** 2 > _LOOKED_AT**2 * inverse[-1, -1]:  # as if the noise were known and white
        return None
    error = float(np.sqrt(more.by_noise[-1, -1]))
    chance = float(stdtr(more.degrees_of_freedom[-1], -abs(step[-1]) / error))
    left = more.data_cost - float(more.gradient @ step)
    ratio = float(left / max(more.noise.cost - more.fitted_noise, 1e-300))
    seconds = max(float(np.ptp(time)) for time in times)
    return Drift(kind, -float(step[-1]) * seconds, error * seconds, seconds, chance, ratio)
