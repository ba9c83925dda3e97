"""Transfer functions of given orders from a response alone (CIFER's NAVFIT)."""

import dataclasses
import functools as ft
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float
from numpy.polynomial.polynomial import polyfromroots, polyroots, polyval

from jaxquad._core import as_messages, minimise_on_host, require_x64
from jaxquad.models import TransferFunction
from jaxquad.spectra import FrequencyResponse

from ..uncertainty._assess import unfitted
from ..uncertainty._verdict import UndeterminedError, without_numbers
from ._cost import (
    Band,
    Cost,
    describe_usable,
    least_coherence,
    MaximumLikelihood,
    Points,
    points_of,
    usable,
)
from ._fit import fit
from ._parameters import name_places, Parameters, Real
from ._refits import check_options, require_responses
from ._result import Fit


Delay = Literal["free"] | float | int  # s
_MORE_POINTS = "lower the orders, or measure more frequencies"
# A pair takes two numbers, but may settle on any frequency: noise alone, at 30 or 100 points,
# lowers the squared misfit by 9 in 1 of 100 cases, and by 13.5 at most in 200.
_CHANCE = 15.0
_BEYOND = 20.0  # times the highest frequency, from which a pole is a constant
_SK_STEPS = 12
_CONVERGED = 1e-11  # largest relative change of the response that a step still makes
_DELAY_STEP = 0.7  # rad at the highest frequency
_MOST_DELAYS = 60
_PLACES = 5  # frequencies at which an idle pair is tried
_TRIED = 8  # linear starts that are refined
_BRIEF, _LONG = 12, 200  # steps of a descent: to compare starts, and to finish

Grid = Complex[np.ndarray, " frequencies"]
Coefficients = Float[np.ndarray, " _"]


def fit_transfer_function(
    frf: FrequencyResponse,
    zeros: int,
    poles: int,
    *,
    delay: Delay = "free",
    integrators: int = 0,
    output: int | str = 0,
    input: int | str = 0,
    cost: Cost = MaximumLikelihood(),
    band: Band = None,
    min_coherence: float | None = None,
    max_steps: int = 256,
) -> Fit:
    """Identify a transfer function of given orders from one response (CIFER's NAVFIT).

        (b_0 s^m + .. + b_m) exp(-delay s) / (s^integrators (s^k + a_1 s^(k-1) + .. + a_k))

    with m = `zeros` and k + `integrators` = `poles`. No starting values are needed, see
    `jq.identify.guess_transfer_function`. Coefficients may have any sign: poles and zeros may lie
    on either side of the imaginary axis. The parameters of the result are `numerator[0]` ..,
    `denominator[1]` .. and `delay`; `jq.identify.factors` gives gain, zeros and poles.

    **Arguments:**

    - `frf`: a measured response.
    - `zeros`, `poles`: the orders; `poles` counts the integrators.
    - `delay`: in s, or "free". A free delay that runs to 0 is fixed there, with a remark.
    - `integrators`: poles that stay at 0.
    - `output`, `input`: the channels, by name or number.
    - `cost`, `band`, `min_coherence`, `max_steps`: as in `jq.fit`.

    **Returns:**

    A `jq.identify.Fit`. Where fewer zeros and poles explain the response as well, its `verdict`
    is "not identifiable", and says which orders to fit.

    **Raises:**

    - `ValueError`: orders that make no proper transfer function, and what `jq.fit` refuses.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.

    Source: Tischler & Remple, ch. 11, eq. 11.4.
    """
    require_x64("a fit")
    check_options(cost, band, min_coherence, max_steps)
    orders = _Orders.checked(zeros, poles, integrators, delay)
    points, reason = _usable_pair(frf, orders, (output, input), cost, band, min_coherence)
    pair = points.frf
    if reason is not None:
        return _no_numbers(orders, reason, tuple(pair.remarks))
    samples = orders.samples(points, cost)
    best = orders.search(samples)
    start, omega = orders.in_seconds(best, samples), samples.omega * samples.unit
    options = {"band": band, "min_coherence": min_coherence, "max_steps": max_steps}
    solve = lambda start: fit(start, pair, free=orders.free(start, omega), cost=cost, **options)
    result = solve(start)  # which is a minimum already
    ran_to_zero = orders.delay is None and float(result.model.delay) <= 0
    if ran_to_zero and float(start.delay) > 0:
        start = eqx.tree_at(lambda model: model.delay, result.model, jnp.zeros(()))
        result = solve(start)
    verdict, remarks = result.verdict, result.remarks
    if ran_to_zero:
        remarks = (*remarks, *as_messages(["the delay ran to zero: it is fixed at 0"]))
    if (idle := _cancelling_pair(points, orders, best)) is not None:
        # None of the coefficients is determined.
        reason, remedy = idle
        verdict = dataclasses.replace(
            verdict,
            kind="not identifiable",
            undetermined=result.names,
            combinations=(),
            reasons=as_messages([reason]),
            remedies=as_messages([remedy]),
            curved=result.names,
        )
    else:
        # Or a pole that left the band.
        roots, highest = result.model.poles, float(omega[-1])
        far = roots[np.argmax(np.abs(roots))] if roots.size else 0.0
        if not result.identifiable and roots.size and np.abs(far) >= _BEYOND * highest:
            few = f"zeros={min(len(result.model.zeros), roots.size - 1)}, poles={roots.size - 1}"
            reason = (
                f"a pole at {far.real:.2g} rad/s is so far above the highest frequency, "
                f"{highest:.3g} rad/s, that it acts as a gain: {few} are enough"
            )
            reasons, remedies = as_messages([reason]), as_messages([f"fit {few}"])
            verdict = dataclasses.replace(verdict, reasons=reasons, remedies=remedies)
    return dataclasses.replace(result, verdict=verdict, remarks=remarks)


def guess_transfer_function(
    frf: FrequencyResponse,
    zeros: int,
    poles: int,
    *,
    delay: Delay = "free",
    integrators: int = 0,
    output: int | str = 0,
    input: int | str = 0,
    cost: Cost = MaximumLikelihood(),
    band: Band = None,
    min_coherence: float | None = None,
) -> TransferFunction:
    """A transfer function of given orders near a measured response, without starting values.

    Linear fits (Sanathanan-Koerner) over a range of delays; the best ones are refined under
    `cost`, and again with roots reflected or moved.

    **Arguments:**

    - `frf`, `zeros`, `poles`, `delay`, `integrators`, `output`, `input`, `cost`, `band`,
        `min_coherence`: as in `jq.fit_transfer_function`.

    **Raises:**

    - `UndeterminedError`: fewer frequencies are usable than the orders need.
    - `ValueError`: orders that make no proper transfer function, or that no start fits.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.
    """
    require_x64("a transfer function")
    check_options(cost, band, min_coherence, 1)
    orders = _Orders.checked(zeros, poles, integrators, delay)
    points, reason = _usable_pair(frf, orders, (output, input), cost, band, min_coherence)
    if reason is not None:
        raise UndeterminedError(f"no transfer function from this record: {reason}; {_MORE_POINTS}")
    samples = orders.samples(points, cost)
    return orders.in_seconds(orders.search(samples), samples)


class _Samples(NamedTuple):
    """A measured response where it is coherent, in frequencies over `unit`."""

    s: Grid
    response: Grid  # without the integrators
    weights: Float[np.ndarray, "frequencies 2"]  # of the misfit of ln-magnitude and phase
    unit: float  # rad/s

    @property
    def omega(self) -> Float[np.ndarray, " frequencies"]:
        return np.imag(self.s)


class _Rational(NamedTuple):
    """`above(s) / below(s) exp(-delay s)`; coefficients rise in power, `below` is monic."""

    above: Coefficients
    below: Coefficients
    delay: float
    cost: float = np.inf  # weighted squares of the logarithm of its ratio to the samples

    def misfit(self, samples: _Samples) -> Float[np.ndarray, "frequencies 2"]:
        """Weighted ln-magnitude and wrapped phase (rad) of model over measurement."""
        ratio = polyval(samples.s, self.above) / polyval(samples.s, self.below) / samples.response
        log = np.log(ratio * np.exp(-self.delay * samples.s))
        return samples.weights * np.stack([np.real(log), np.imag(log)], axis=1)

    def with_cost(self, samples: _Samples) -> "_Rational":
        """The same with its cost, infinite where it has no finite response."""
        with np.errstate(all="ignore"):
            cost = float(np.sum(self.misfit(samples) ** 2))
        return self._replace(cost=cost if np.isfinite(cost) else np.inf)


class _Orders(NamedTuple):
    """Of a transfer function; `poles` counts the `integrators` too."""

    zeros: int
    poles: int
    integrators: int
    delay: float | None  # s; None if it is free

    @classmethod
    def checked(cls, zeros: int, poles: int, integrators: int, delay: Delay) -> "_Orders":
        orders = {"zeros": zeros, "poles": poles, "integrators": integrators}
        for name, value in orders.items():
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
                raise ValueError(f"{name}={value!r}: give a whole number, 0 or more")
        if not max(zeros, integrators) <= poles:
            raise ValueError(
                f"zeros={zeros}, poles={poles}, integrators={integrators}: a proper transfer "
                "function has at most as many zeros as poles, and the integrators count among the "
                "poles"
            )
        if isinstance(delay, str) and delay == "free":
            return cls(zeros, poles, integrators, None)
        if isinstance(delay, str | bool) or not 0 <= delay < np.inf:
            raise ValueError(f'delay={delay!r}: give "free", or 0 or more in s')
        return cls(zeros, poles, integrators, float(delay))

    @property
    def unknowns(self) -> int:
        return self.zeros + 1 + self.poles - self.integrators + (self.delay is None)

    def samples(self, points: Points, cost: Cost) -> _Samples:
        """The points that count, in frequencies over the geometric mean of lowest and highest."""
        pair, mask = points.frf, points.used[:, 0, 0]
        weights = np.asarray(cost.weights(points, np.ones(points.used.shape)))[mask, 0, 0]
        omega = np.asarray(pair.omega)[mask]
        unit = float(np.sqrt(omega[0] * omega[-1]))
        s = 1j * omega / unit
        response = np.asarray(pair.response)[mask, 0, 0] * s**self.integrators
        return _Samples(s, response, weights, unit)

    def search(self, samples: _Samples, extra: tuple[_Rational, ...] = ()) -> _Rational:
        """The lowest minimum that any start leads to, in frequencies over the samples' unit.

        Starts are linear fits at delays from 0 to beyond what the phase's slope allows, those in
        `extra`, and the best of them with one root (or pair) reflected to the other half plane, or
        with its outermost zero and pole, which may be idle beyond the band, placed within it.
        """
        free, omega, poles = self.delay is None, samples.omega, self.poles - self.integrators
        delays = np.array([0.0 if self.delay is None else self.delay * samples.unit])
        if free:  # from 0 to 4 rad at the highest frequency, or beyond the phase's slope
            phase = np.unwrap(np.angle(samples.response))
            slope = -np.diff(phase)[omega.size // 2 :] / np.diff(omega)[omega.size // 2 :]
            limit = 4.0 / omega[-1] + 1.2 * max(float(np.median(slope)), 0.0)
            count = int(np.clip(limit * omega[-1] / _DELAY_STEP + 1, 2, _MOST_DELAYS))
            delays = np.linspace(0.0, limit, count)
        cost = lambda model: model.cost
        starts = [_linear_fit(samples, self.zeros, poles, float(late)) for late in delays]
        starts = sorted(starts, key=cost)[:_TRIED] + list(extra)
        descend_from = lambda start, steps: _descend(samples, start, steps, free)
        best = min((descend_from(start, _BRIEF) for start in starts), key=cost)
        for _ in range(2):
            best = descend_from(best, _LONG)
            if not np.isfinite(best.cost):
                raise ValueError(
                    f"no transfer function of {self.zeros} zeros and {self.poles} poles has a "
                    "finite response near the measured one: lower the orders, or look at the "
                    "response"
                )
            others = _with_other_roots(samples, best)
            better = min((descend_from(other, _BRIEF) for other in others), key=cost, default=best)
            if not better.cost < 0.999 * best.cost:
                return best
            best = better
        return descend_from(best, _LONG)

    def in_seconds(self, model: _Rational, samples: _Samples) -> TransferFunction:
        """In rad/s and s, with the integrators."""
        below = np.concatenate([np.zeros(self.integrators), model.below])
        scale = samples.unit ** np.arange(self.poles, -1, -1.0)
        above = model.above * scale[: self.zeros + 1]
        delay = model.delay / samples.unit if self.delay is None else self.delay
        return TransferFunction(above[::-1], (below * scale)[::-1], delay)

    def free(self, start: TransferFunction, omega: Float[np.ndarray, " frequencies"]) -> list[Real]:
        """All coefficients but the leading 1 and the integrators' zeros; a delay unless it is 0.
        Each with its size, or what would double the response somewhere if it is near 0."""
        sizes = []
        for coefficients in map(np.asarray, (start.numerator, start.denominator)):
            terms = omega[:, None] ** np.arange(coefficients.size - 1, -1, -1.0)
            total = np.abs(np.polyval(coefficients, 1j * omega))[:, None]
            sizes.append(np.maximum(np.abs(coefficients), np.min(total / terms, axis=0)))
        above, below = sizes
        free = [Real(f"numerator[{k}]", float(size)) for k, size in enumerate(above)]
        last = self.poles - self.integrators
        free += [Real(f"denominator[{k}]", float(below[k])) for k in range(1, last + 1)]
        if self.delay is None and float(start.delay) > 0:
            free.append(Real("delay", max(float(start.delay), 1 / float(omega[-1]))))
        return free


def _usable_pair(
    frf: object,
    orders: _Orders,
    channels: tuple[int | str, int | str],
    cost: Cost,
    band: Band,
    min_coherence: float | None,
) -> tuple[Points, str | None]:
    """The points of the pair of these channels, and why there is nothing to fit, if so."""
    frfs = require_responses(frf)
    if len(frfs) > 1:
        raise ValueError(
            f"{len(frfs)} responses: a transfer function is fitted to one; combine the records in "
            "jq.frequency_response([record, ...]), or start jq.fit(model, responses) from a guess"
        )
    [measured], places = frfs, []
    sides = (
        ("output", channels[0], measured.output_names),
        ("input", channels[1], measured.input_names),
    )
    for role, wanted, names in sides:
        if isinstance(wanted, str) and wanted in names:
            places.append(names.index(wanted))
        elif isinstance(wanted, int | np.integer) and 0 <= wanted < len(names):
            places.append(int(wanted))
        else:
            raise ValueError(
                f"{role}={wanted!r}: the response has {role}s 0 to {len(names) - 1}, {names}"
            )
    o, i = places
    pick = lambda values: None if values is None else values[:, o : o + 1, i : i + 1]
    pair = dataclasses.replace(
        measured,
        response=pick(measured.response),
        coherence=pick(measured.coherence),
        random_error=pick(measured.random_error),
        errors=measured.errors.pair(o, i),
        divided=pick(measured.divided),
        direct_coherence=pick(measured.direct_coherence),
        multiple_coherence=measured.multiple_coherence[:, o : o + 1],
        swept_at=None if measured.swept_at is None else measured.swept_at[:, i : i + 1],
        input_names=measured.input_names[i : i + 1],
        output_names=measured.output_names[o : o + 1],
    )
    least = least_coherence(min_coherence, cost, pair)
    used = usable(pair, band, least) & (np.abs(np.asarray(pair.response)) > 0)
    count, needed, reason = int(used.sum()), orders.unknowns + 2, None
    # Magnitude and phase are two numbers, but half as many points leave nothing to judge by.
    if count < needed:
        reason = (
            f"{describe_usable([pair], count, least)}, and {orders.unknowns} coefficients "
            f"need at least {needed}"
        )
    return points_of(pair, used), reason


def _no_numbers(orders: _Orders, reason: str, remarks: tuple[str, ...]) -> Fit:
    """The result where there are fewer usable frequencies than coefficients: no number at all."""
    below, delay = np.eye(orders.poles + 1)[0], orders.delay or 0.0
    model = TransferFunction(np.zeros(orders.zeros + 1), below, delay)
    names = [f"numerator[{k}]" for k in range(orders.zeros + 1)]
    names += [f"denominator[{k}]" for k in range(1, orders.poles - orders.integrators + 1)]
    names += ["delay"] if orders.delay is None else []
    chosen = tuple(place for place in name_places(model) if place.name in names)
    count = len(chosen)
    nothing = jnp.full(count, jnp.nan)
    parameters = Parameters(chosen, (), (False,) * count, count, jnp.ones(count), nothing)
    verdict = without_numbers("too few points", parameters.names, reason, _MORE_POINTS)
    return unfitted(parameters.replace(model, nothing), parameters, verdict, remarks)


def _cancelling_pair(points: Points, orders: _Orders, best: _Rational) -> tuple[str, str] | None:
    """Reason and remedy where one zero and one pole fewer explain the response within its noise."""
    if orders.zeros == 0 or orders.poles == orders.integrators:
        return None
    smaller = orders._replace(zeros=orders.zeros - 1, poles=orders.poles - 1)
    samples = orders.samples(points, MaximumLikelihood())
    full = _descend(samples, best, _LONG, orders.delay is None)
    # A start without the zero and the real pole nearest to each other.
    zeros, poles = polyroots(full.above), polyroots(full.below)
    distance = np.abs(zeros[:, None].real - poles[None, :].real)
    z, p = np.unravel_index(np.argmin(distance), distance.shape)
    above = full.above[-1] * np.real(polyfromroots(np.delete(zeros, z)))
    extra = _Rational(above, np.real(polyfromroots(np.delete(poles, p))), full.delay)
    less = smaller.search(samples, (extra,))
    freedom = max(2 * float(np.sum(1 / points.shared[points.used])) - orders.unknowns, 1.0)
    # A misfit beyond the noise counts as noise here.
    gained = (less.cost - full.cost) / max(full.cost / freedom, 1.0)
    if gained > _CHANCE:
        return None
    few = f"zeros={smaller.zeros}, poles={smaller.poles}"
    reason = (
        f"a zero and a pole cancel: {few} explain the response as well (the pair lowers the "
        f"misfit by {max(gained, 0.0):.2g} squared random errors; noise alone gives up to "
        f"{_CHANCE:g})"
    )
    return reason, f"fit {few}"


def _basis(
    s: Grid, start: Grid, degree: int
) -> tuple[Complex[np.ndarray, "frequencies terms"], Float[np.ndarray, "terms terms"]]:
    """Polynomials times `start`, orthonormal over the grid and its mirror image.

    Returns their values and, in columns, their coefficients, which are real. Powers of s would be
    dependent to rounding from degree 6 or so. Source: Brubeck, Nakatsukasa and Trefethen,
    Vandermonde with Arnoldi, SIAM Review 63 (2021).
    """
    values = np.zeros((s.size, degree + 1), complex)
    coefficients = np.zeros((degree + 1, degree + 1))
    vector, powers = start, np.eye(degree + 1)[0]
    for k in range(degree + 1):
        if k:
            vector, powers = s * values[:, k - 1], np.append(0.0, coefficients[:-1, k - 1])
        for _ in range(2):
            shared = np.real(values[:, :k].conj().T @ vector)
            vector = vector - values[:, :k] @ shared
            powers = powers - coefficients[:, :k] @ shared
        size = np.linalg.norm(vector)
        values[:, k], coefficients[:, k] = vector / size, powers / size
    return values, coefficients


def _linear_fit(samples: _Samples, zeros: int, poles: int, delay: float) -> _Rational:
    """The best of a sequence of linear fits, weighed by the denominator of the one before.

    They minimise |above - response below| / |response below_last|. Poles and zeros may lie on
    either side. Source: Sanathanan and Koerner, IEEE Trans. Automatic Control 8 (1963), p. 56.
    """
    trust = np.sqrt(np.mean(samples.weights**2, axis=1))  # one weight for both parts
    target = samples.response * np.exp(delay * samples.s)
    corners = np.geomspace(samples.omega[0], samples.omega[-1], poles + 2)[1:-1]
    last = np.prod(samples.s[:, None] + corners, axis=1)
    best = _Rational(np.zeros(zeros + 1), np.eye(poles + 1)[-1], delay)
    for _ in range(_SK_STEPS):
        with np.errstate(all="ignore"):
            over, from_over = _basis(samples.s, trust / (target * last), zeros)
            under, from_under = _basis(samples.s, trust / last, poles)
            shared = np.real(over.conj().T @ under)
            rest = under - over @ shared
            parts = np.concatenate([np.real(rest), np.imag(rest)])
            if not np.all(np.isfinite(parts)):
                break
            # No coefficient can be set to 1 beforehand: any of them may be the one that is 0.
            choice = np.linalg.svd(parts, full_matrices=False)[2][-1]
            above, below = from_over @ (shared @ choice), from_under @ choice
            above, below = above / below[-1], below / below[-1]
        if not (np.all(np.isfinite(above)) and np.all(np.isfinite(below))):
            break
        candidate = _Rational(above, below, delay).with_cost(samples)
        best = min(best, candidate, key=lambda model: model.cost)
        last = polyval(samples.s, below)
    return best


class _Point:
    """A model on the way down, in coordinates made for it alone.

    The unknowns are polynomials orthonormal over the grid: dP/P for the numerator P, dQ/Q for the
    denominator Q, and the delay. High orders and many decades then cost no digits.
    """

    def __init__(self, samples: _Samples, model: _Rational, free_delay: bool):
        self.samples, self.model, self.free_delay = samples, model, free_delay
        unknowns = model.above.size + model.below.size - 1 + free_delay
        self.z, self.cost = np.zeros(unknowns), 0.5 * model.cost

    @ft.cached_property
    def tangent(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Changes of numerator and denominator that are orthonormal changes of the response, in
        columns; and the slopes of the misfit by the unknowns."""
        samples, model, s = self.samples, self.model, self.samples.s
        poles = model.below.size - 1
        with np.errstate(all="ignore"):
            over, from_over = _basis(s, 1 / polyval(s, model.above), model.above.size - 1)
            under, from_under = _basis(s, 1 / polyval(s, model.below), max(poles - 1, 0))
        under, from_under = under[:, :poles], from_under[:, :poles]
        late = np.reshape(s / samples.omega[-1], (-1, 1))[:, : int(self.free_delay)]
        columns = np.concatenate([over, -under, -late], axis=1)
        parts = np.stack([np.real(columns), np.imag(columns)], axis=1) * samples.weights[:, :, None]
        return from_over, from_under, parts.reshape(2 * s.size, -1)

    def slopes(self) -> tuple[np.ndarray, np.ndarray]:
        jacobian = np.nan_to_num(self.tangent[2])
        residual = self.model.misfit(self.samples).reshape(-1)
        if self.free_delay and self.model.delay == 0 and (jacobian.T @ residual)[-1] > 0:
            last = jacobian.shape[1] - 1
            jacobian = jacobian * (np.arange(last + 1) < last)  # the delay stays at 0
        return jacobian.T @ residual, jacobian.T @ jacobian

    def moved(self, change: Float[np.ndarray, " unknowns"]) -> "_Point":
        model, (from_over, from_under, _) = self.model, self.tangent
        ends = [from_over.shape[1], from_over.shape[1] + from_under.shape[1]]
        over, under, late = np.split(change, ends)
        below = model.below.copy()
        below[:-1] += (from_under @ under)[: below.size - 1]
        delay = model.delay + float(late.sum()) / float(self.samples.omega[-1])
        model = _Rational(model.above + from_over @ over, below, max(delay, 0.0))
        return _Point(self.samples, model.with_cost(self.samples), self.free_delay)


def _descend(samples: _Samples, start: _Rational, steps: int, free_delay: bool) -> _Rational:
    """Lower the cost of `start` by Levenberg-Marquardt; a delay stops at 0."""
    point = _Point(samples, start.with_cost(samples), free_delay)
    if not (np.isfinite(point.cost) and np.all(np.isfinite(point.tangent[2]))):
        return point.model
    return minimise_on_host(point, _Point.moved, steps, tolerance=_CONVERGED, saving=1e-14)[0].model


def _with_other_roots(samples: _Samples, model: _Rational) -> list[_Rational]:
    """One root, or pair, mirrored in the imaginary axis; the outermost real zero and pole moved."""
    models = []
    for field, coefficients in (("above", model.above), ("below", model.below)):
        roots = polyroots(coefficients)
        for root in roots[roots.imag >= 0]:
            mine = (roots == root) | (roots == root.conj())
            mirrored = np.where(mine, -roots.conj(), roots)
            polynomial = coefficients[-1] * np.real(polyfromroots(mirrored))
            odd = bool(np.sum(mine) % 2)
            if odd and field == "above":
                polynomial = -polynomial
            side = model._replace(**{field: polynomial})
            models += [side, side._replace(above=-side.above)] if odd else [side]
    zeros, poles = polyroots(model.above), polyroots(model.below)
    if not (np.any(zeros.imag == 0) and np.any(poles.imag == 0)):
        return models
    # As a near-cancelling pair within the band.
    zero, pole = (max(roots[roots.imag == 0], key=abs) for roots in (zeros, poles))
    lead = model.above[-1] * np.real((1j - zero) / (1j - pole))
    for place in np.geomspace(samples.omega[0], samples.omega[-1], _PLACES):
        for ratio in (0.8, 1.25):
            above = lead * np.real(polyfromroots(np.where(zeros == zero, -place * ratio, zeros)))
            below = np.real(polyfromroots(np.where(poles == pole, -place, poles)))
            models.append(model._replace(above=above, below=below))
    return models
