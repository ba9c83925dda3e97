"""Transfer functions of given orders (CIFER's NAVFIT)."""

import dataclasses
import functools as ft

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from numpy.polynomial.polynomial import polyfromroots, polyroots

from jaxquad._core import Message, require_x64
from jaxquad.models import TransferFunction
from jaxquad.spectra import FrequencyResponse

from ..uncertainty._assess import unfitted
from ..uncertainty._verdict import without_numbers
from ._cost import Band, Cost, least_coherence, MaximumLikelihood, Points
from ._fit import check_options, fit
from ._parameters import name_places, Parameters, Real
from ._rational import descend, Rational, Samples
from ._result import Fit
from ._transfer_function_guess import (
    Delay,
    MORE_POINTS,
    require_single_response,
    require_structure,
    search,
    select_pair,
    Structure,
    too_few_points,
    transfer_function,
    usable_points,
    usable_samples,
)


# A pair takes two numbers, but may settle on any frequency: noise alone, at 30 or 100 points,
# lowers the squared misfit by 9 in 1 of 100 cases, and by 13.5 at most in 200.
_CHANCE = 15.0
_BEYOND = 20.0  # times the highest frequency, from which a pole is a constant


def _cancelling_pair(
    points: Points, structure: Structure, best: Rational
) -> tuple[str, str] | None:
    """Reason and remedy where one zero and one pole fewer explain the response within its noise."""
    if structure.zeros == 0 or structure.poles == structure.integrators:
        return None
    smaller = structure._replace(zeros=structure.zeros - 1, poles=structure.poles - 1)
    samples = usable_samples(points, structure, MaximumLikelihood())
    full = descend(samples, best, steps=200, free_delay=structure.delay is None)
    less = search(samples, smaller, (_without_nearest(full),))
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


def _refused(fit: Fit, reason: str, remedy: str) -> Fit:
    """The same fit with none of its coefficients called determined."""
    verdict = dataclasses.replace(
        fit.verdict,
        kind="not identifiable",
        undetermined=fit.names,
        combinations=(),
        reasons=(Message(reason),),
        remedies=(Message(remedy),),
        curved=fit.names,
    )
    return dataclasses.replace(fit, verdict=verdict)


def _with_reason(fit: Fit, reason: str, remedy: str) -> Fit:
    reasons, remedies = (Message(reason),), (Message(remedy),)
    verdict = dataclasses.replace(fit.verdict, reasons=reasons, remedies=remedies)
    return dataclasses.replace(fit, verdict=verdict)


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
    verdict = without_numbers("too few points", parameters.names, reason, MORE_POINTS)
    return unfitted(parameters.replace(model, nothing), parameters, verdict, remarks)


def _without_nearest(model: Rational) -> Rational:
    """The model without the zero and the real pole nearest to each other."""
    zeros, poles = polyroots(model.above), polyroots(model.below)
    apart = np.abs(zeros[:, None].real - poles[None, :].real)
    z, p = np.unravel_index(np.argmin(apart), apart.shape)
    above = model.above[-1] * np.real(polyfromroots(np.delete(zeros, z)))
    return Rational(above, np.real(polyfromroots(np.delete(poles, p))), model.delay)


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
    pair = select_pair(require_single_response(frf), output, input)
    least = least_coherence(min_coherence, cost, pair)
    points = usable_points(pair, band, least)
    too_few = too_few_points(points, structure, least)
    if too_few is not None:
        return _unfitted(structure, too_few, tuple(pair.remarks))
    samples = usable_samples(points, structure, cost)
    best = search(samples, structure)
    result = _refined(
        pair, transfer_function(best, samples, structure), structure, samples, cost, band,
        min_coherence, max_steps,
    )  # fmt: skip
    idle = _cancelling_pair(points, structure, best)
    if idle is not None:
        return _refused(result, *idle)
    far = _pole_beyond_band(result, float(samples.omega[-1]) * samples.unit)
    return result if far is None else _with_reason(result, *far)


def _refined(
    pair: FrequencyResponse,
    start: TransferFunction,
    structure: Structure,
    samples: Samples,
    cost: Cost,
    band: Band,
    min_coherence: float | None,
    max_steps: int,
) -> Fit:
    """The fit from a start that is already its minimum, with all that `jq.fit` says of it."""
    solve = ft.partial(fit, cost=cost, band=band, min_coherence=min_coherence, max_steps=max_steps)
    result = solve(start, pair, free=_free(start, structure, samples))
    ran_to_zero = structure.delay is None and float(result.model.delay) <= 0
    if ran_to_zero and float(start.delay) > 0:
        start = eqx.tree_at(lambda model: model.delay, result.model, jnp.zeros(()))
        result = solve(start, pair, free=_free(start, structure, samples))
    if not ran_to_zero:
        return result
    remark = Message("the delay ran to zero: it is fixed at 0")
    return dataclasses.replace(result, remarks=(*result.remarks, remark))


def _free(start: TransferFunction, structure: Structure, samples: Samples) -> list[Real]:
    """All coefficients but the leading 1 and the integrators' zeros; a delay unless it is 0."""
    omega = samples.omega * samples.unit
    above = _sizes(np.asarray(start.numerator), omega)
    below = _sizes(np.asarray(start.denominator), omega)
    count = structure.poles - structure.integrators
    free = [Real(f"numerator[{k}]", float(size)) for k, size in enumerate(above)]
    free += [Real(f"denominator[{k}]", float(below[k])) for k in range(1, count + 1)]
    if structure.delay is None and float(start.delay) > 0:
        free.append(Real("delay", max(float(start.delay), 1 / float(omega[-1]))))
    return free


def _sizes(
    coefficients: Float[np.ndarray, " powers"], omega: Float[np.ndarray, " frequencies"]
) -> Float[np.ndarray, " powers"]:
    """A coefficient's own size, or what would double the response somewhere if it is near 0."""
    powers = np.arange(coefficients.size - 1, -1, -1.0)
    terms = omega[:, None] ** powers
    whole = np.abs(np.polyval(coefficients, 1j * omega))[:, None]
    return np.maximum(np.abs(coefficients), np.min(whole / terms, axis=0))
