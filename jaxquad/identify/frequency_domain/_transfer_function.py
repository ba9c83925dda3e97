"""Transfer functions of given orders from a response alone (CIFER's NAVFIT)."""

import dataclasses
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

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
from ._fit import check_options, fit, require_responses
from ._parameters import name_places, Parameters, Real
from ._rational import descend, lowest_minimum, Rational, Samples, without_nearest_pair
from ._result import Fit


Delay = Literal["free"] | float | int  # s
_MORE_POINTS = "lower the orders, or measure more frequencies"
# A pair takes two numbers, but may settle on any frequency: noise alone, at 30 or 100 points,
# lowers the squared misfit by 9 in 1 of 100 cases, and by 13.5 at most in 200.
_CHANCE = 15.0
_BEYOND = 20.0  # times the highest frequency, from which a pole is a constant


class Structure(NamedTuple):
    """Orders of a transfer function; `poles` counts the `integrators` too."""

    zeros: int
    poles: int
    integrators: int
    delay: float | None  # s; None if it is free

    @property
    def unknowns(self) -> int:
        return self.zeros + 1 + self.poles - self.integrators + (self.delay is None)


class _Data(NamedTuple):
    """A response pair; `reason` says why there is nothing to fit."""

    pair: FrequencyResponse
    points: Points
    reason: str | None


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
    structure = require_structure(zeros, poles, integrators, delay)
    data = _prepare(frf, structure, (output, input), cost, band, min_coherence)
    pair, points, reason = data
    if reason is not None:
        return _unfitted(structure, reason, tuple(pair.remarks))
    samples = _usable_samples(points, structure, cost)
    best = _search(samples, structure)
    start, omega = _in_seconds(best, samples, structure), samples.omega * samples.unit
    options = {"band": band, "min_coherence": min_coherence, "max_steps": max_steps}
    solve = lambda start: fit(
        start, pair, free=_free(start, structure, omega), cost=cost, **options
    )
    result = solve(start)  # which is a minimum already
    ran_to_zero = structure.delay is None and float(result.model.delay) <= 0
    if ran_to_zero and float(start.delay) > 0:
        start = eqx.tree_at(lambda model: model.delay, result.model, jnp.zeros(()))
        result = solve(start)
    verdict, remarks = result.verdict, result.remarks
    if ran_to_zero:
        remarks = (*remarks, *as_messages(["the delay ran to zero: it is fixed at 0"]))
    if (idle := _cancelling_pair(points, structure, best)) is not None:
        # None of the coefficients is determined.
        verdict = dataclasses.replace(
            verdict,
            kind="not identifiable",
            undetermined=result.names,
            combinations=(),
            reasons=as_messages(idle[:1]),
            remedies=as_messages(idle[1:]),
            curved=result.names,
        )
    elif (far := _pole_beyond_band(result, float(omega[-1]))) is not None:
        reasons, remedies = as_messages(far[:1]), as_messages(far[1:])
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

    **Returns:**

    A `jq.TransferFunction`.

    **Raises:**

    - `UndeterminedError`: fewer frequencies are usable than the orders need.
    - `ValueError`: orders that make no proper transfer function, or that no start fits.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.
    """
    require_x64("a transfer function")
    check_options(cost, band, min_coherence, 1)
    structure = require_structure(zeros, poles, integrators, delay)
    data = _prepare(frf, structure, (output, input), cost, band, min_coherence)
    if data.reason is not None:
        raise UndeterminedError(
            f"no transfer function from this record: {data.reason}; {_MORE_POINTS}"
        )
    samples = _usable_samples(data.points, structure, cost)
    return _in_seconds(_search(samples, structure), samples, structure)


def require_structure(zeros: int, poles: int, integrators: int, delay: Delay) -> Structure:
    """Orders that make a proper transfer function. Raise ValueError for others."""
    orders = {"zeros": zeros, "poles": poles, "integrators": integrators}
    for name, value in orders.items():
        if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 0:
            raise ValueError(f"{name}={value!r}: give a whole number, 0 or more")
    if not max(zeros, integrators) <= poles:
        raise ValueError(
            f"zeros={zeros}, poles={poles}, integrators={integrators}: a proper transfer function "
            "has at most as many zeros as poles, and the integrators count among the poles"
        )
    if isinstance(delay, str) and delay == "free":
        return Structure(zeros, poles, integrators, None)
    if isinstance(delay, str | bool) or not 0 <= delay < np.inf:
        raise ValueError(f'delay={delay!r}: give "free", or 0 or more in s')
    return Structure(zeros, poles, integrators, float(delay))


def _prepare(
    frf: object,
    structure: Structure,
    channels: tuple[int | str, int | str],
    cost: Cost,
    band: Band,
    min_coherence: float | None,
) -> _Data:
    """The pair, its usable points, and whether these are enough; ValueError for several pairs."""
    frfs = require_responses(frf)
    if len(frfs) > 1:
        raise ValueError(
            f"{len(frfs)} responses: a transfer function is fitted to one; combine the records in "
            "jq.frequency_response([record, ...]), or start jq.fit(model, responses) from a guess"
        )
    pair = select_pair(frfs[0], *channels)
    least = least_coherence(min_coherence, cost, pair)
    used = usable(pair, band, least) & (np.abs(np.asarray(pair.response)) > 0)
    points, count, needed = points_of([pair], [used])[0], int(used.sum()), structure.unknowns + 2
    # Magnitude and phase are two numbers, but half as many points leave nothing to judge by.
    reason = None
    if count < needed:
        reason = (
            f"{describe_usable([pair], count, least)}, and {structure.unknowns} coefficients "
            f"need at least {needed}"
        )
    return _Data(pair, points, reason)


def select_pair(frf: FrequencyResponse, output: int | str, input: int | str) -> FrequencyResponse:
    """The response of one output to one input, by name or number; raises ValueError."""
    places = []
    sides = (("output", output, frf.output_names), ("input", input, frf.input_names))
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

    def pick(values: Array) -> Array:
        return values[:, o : o + 1, i : i + 1]

    return dataclasses.replace(
        frf,
        response=pick(frf.response),
        coherence=pick(frf.coherence),
        random_error=pick(frf.random_error),
        errors=frf.errors.pair(o, i),
        divided=None if frf.divided is None else frf.divided[:, o : o + 1, i : i + 1],
        direct_coherence=pick(frf.direct_coherence),
        multiple_coherence=frf.multiple_coherence[:, o : o + 1],
        input_names=frf.input_names[i : i + 1],
        output_names=frf.output_names[o : o + 1],
    )


def _usable_samples(points: Points, structure: Structure, cost: Cost) -> Samples:
    """The points that count, in frequencies over the geometric mean of the lowest and highest."""
    pair, mask = points.frf, points.used[:, 0, 0]
    weights = cost.weights(points, np.ones(points.used.shape))[mask, 0, 0]
    omega = np.asarray(pair.omega)[mask]
    unit = float(np.sqrt(omega[0] * omega[-1]))
    s = 1j * omega / unit
    response = np.asarray(pair.response)[mask, 0, 0] * s**structure.integrators
    return Samples(s, response, weights, unit)


def _search(samples: Samples, structure: Structure, extra: tuple[Rational, ...] = ()) -> Rational:
    """The lowest minimum that any start leads to, in frequencies over the samples' unit."""
    delay = None if structure.delay is None else structure.delay * samples.unit
    poles = structure.poles - structure.integrators
    best = lowest_minimum(samples, structure.zeros, poles, delay, extra)
    if not np.isfinite(best.cost):
        raise ValueError(
            f"no transfer function of {structure.zeros} zeros and {structure.poles} poles has a "
            "finite response near the measured one: lower the orders, or look at the response"
        )
    return best


def _in_seconds(model: Rational, samples: Samples, structure: Structure) -> TransferFunction:
    """In rad/s and s, with the integrators."""
    below = np.concatenate([np.zeros(structure.integrators), model.below])
    scale = samples.unit ** np.arange(structure.poles, -1, -1.0)
    above = model.above * scale[: structure.zeros + 1]
    delay = model.delay / samples.unit if structure.delay is None else structure.delay
    return TransferFunction(above[::-1], (below * scale)[::-1], delay)


def _free(
    start: TransferFunction, structure: Structure, omega: Float[np.ndarray, " frequencies"]
) -> list[Real]:
    """All coefficients but the leading 1 and the integrators' zeros; a delay unless it is 0."""

    def sizes(coefficients: Float[np.ndarray, " powers"]) -> Float[np.ndarray, " powers"]:
        """A coefficient's size, or what would double the response somewhere if it is near 0."""
        terms = omega[:, None] ** np.arange(coefficients.size - 1, -1, -1.0)
        total = np.abs(np.polyval(coefficients, 1j * omega))[:, None]
        return np.maximum(np.abs(coefficients), np.min(total / terms, axis=0))

    above, below = sizes(np.asarray(start.numerator)), sizes(np.asarray(start.denominator))
    count = structure.poles - structure.integrators
    free = [Real(f"numerator[{k}]", float(size)) for k, size in enumerate(above)]
    free += [Real(f"denominator[{k}]", float(below[k])) for k in range(1, count + 1)]
    if structure.delay is None and float(start.delay) > 0:
        free.append(Real("delay", max(float(start.delay), 1 / float(omega[-1]))))
    return free


def _cancelling_pair(
    points: Points, structure: Structure, best: Rational
) -> tuple[str, str] | None:
    """Reason and remedy where one zero and one pole fewer explain the response within its noise."""
    if structure.zeros == 0 or structure.poles == structure.integrators:
        return None
    smaller = structure._replace(zeros=structure.zeros - 1, poles=structure.poles - 1)
    samples = _usable_samples(points, structure, MaximumLikelihood())
    full = descend(samples, best, steps=200, free_delay=structure.delay is None)
    less = _search(samples, smaller, (without_nearest_pair(full),))
    freedom = max(2 * float(np.sum(1 / points.shared[points.used])) - structure.unknowns, 1.0)
    # A misfit beyond the noise counts as noise here.
    gained = (less.cost - full.cost) / max(full.cost / freedom, 1.0)
    if gained > _CHANCE:
        return None
    orders = f"zeros={smaller.zeros}, poles={smaller.poles}"
    reason = (
        f"a zero and a pole cancel: {orders} explain the response as well (the pair lowers the "
        f"misfit by {max(gained, 0.0):.2g} squared random errors; noise alone gives up to "
        f"{_CHANCE:g})"
    )
    return reason, f"fit {orders}"


def _pole_beyond_band(fit: Fit, highest: float) -> tuple[str, str] | None:
    """Reason and remedy for a fit that is not identifiable as a pole left the band (rad/s)."""
    poles = fit.model.poles
    if fit.identifiable or not poles.size or np.max(np.abs(poles)) < _BEYOND * highest:
        return None
    far = poles[np.argmax(np.abs(poles))]
    orders = f"zeros={min(len(fit.model.zeros), poles.size - 1)}, poles={poles.size - 1}"
    reason = (
        f"a pole at {far.real:.2g} rad/s is so far above the highest frequency, {highest:.3g} "
        f"rad/s, that it acts as a gain: {orders} are enough"
    )
    return reason, f"fit {orders}"


def _unfitted(structure: Structure, reason: str, remarks: tuple[str, ...]) -> Fit:
    """The result where there are fewer usable frequencies than coefficients: no number at all."""
    below = np.eye(structure.poles + 1)[0]
    delay = structure.delay or 0.0
    model = TransferFunction(np.zeros(structure.zeros + 1), below, delay)
    places = name_places(model)
    last = structure.poles - structure.integrators
    names = [f"numerator[{k}]" for k in range(structure.zeros + 1)]
    names += [f"denominator[{k}]" for k in range(1, last + 1)]
    names += ["delay"] if structure.delay is None else []
    chosen = tuple(place for place in places if place.name in names)
    count = len(chosen)
    nothing = jnp.full(count, jnp.nan)
    parameters = Parameters(chosen, (), (False,) * count, count, jnp.ones(count), nothing)
    verdict = without_numbers("too few points", parameters.names, reason, _MORE_POINTS)
    return unfitted(parameters.replace(model, nothing), parameters, verdict, remarks)
