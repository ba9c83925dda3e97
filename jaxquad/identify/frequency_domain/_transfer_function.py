"""Transfer functions of given orders from a response alone (CIFER's NAVFIT)."""

import dataclasses
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.polynomial.polynomial import polyfromroots, polyroots

from jaxquad._core import as_messages, require_x64
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
from ._rational_search import descend, LONG, Rational, Samples, search
from ._refits import check_options, require_responses
from ._result import Fit


Delay = Literal["free"] | float | int  # s
_MORE_POINTS = "lower the orders, or measure more frequencies"
# A pair takes two numbers, but may settle on any frequency: noise alone, at 30 or 100 points,
# lowers the squared misfit by 9 in 1 of 100 cases, and by 13.5 at most in 200.
_CHANCE = 15.0
_BEYOND = 20.0  # times the highest frequency, from which a pole is a constant


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

    def samples(self, points: Points, cost: Cost) -> Samples:
        """The points that count, in frequencies over the geometric mean of lowest and highest."""
        pair, mask = points.frf, points.used[:, 0, 0]
        weights = np.asarray(cost.weights(points, np.ones(points.used.shape)))[mask, 0, 0]
        omega = np.asarray(pair.omega)[mask]
        unit = float(np.sqrt(omega[0] * omega[-1]))
        s = 1j * omega / unit
        response = np.asarray(pair.response)[mask, 0, 0] * s**self.integrators
        return Samples(s, response, weights, unit)

    def search(self, samples: Samples, extra: tuple[Rational, ...] = ()) -> Rational:
        """As the function of this name. Raises ValueError where nothing is near the response."""
        best = search(samples, self.zeros, self.poles - self.integrators, self.delay, extra)
        if not np.isfinite(best.cost):
            raise ValueError(
                f"no transfer function of {self.zeros} zeros and {self.poles} poles has a finite "
                "response near the measured one: lower the orders, or look at the response"
            )
        return best

    def in_seconds(self, model: Rational, samples: Samples) -> TransferFunction:
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
    pair = measured.pair(*places)
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


def _cancelling_pair(points: Points, orders: _Orders, best: Rational) -> tuple[str, str] | None:
    """Reason and remedy where one zero and one pole fewer explain the response within its noise."""
    if orders.zeros == 0 or orders.poles == orders.integrators:
        return None
    smaller = orders._replace(zeros=orders.zeros - 1, poles=orders.poles - 1)
    samples = orders.samples(points, MaximumLikelihood())
    full = descend(samples, best, LONG, orders.delay is None)
    # A start without the zero and the real pole nearest to each other.
    zeros, poles = polyroots(full.above), polyroots(full.below)
    distance = np.abs(zeros[:, None].real - poles[None, :].real)
    z, p = np.unravel_index(np.argmin(distance), distance.shape)
    above = full.above[-1] * np.real(polyfromroots(np.delete(zeros, z)))
    extra = Rational(above, np.real(polyfromroots(np.delete(poles, p))), full.delay)
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
