"""Transfer functions of given orders (CIFER's NAVFIT)."""

import dataclasses
import functools as ft

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad.models import TransferFunction
from jaxquad.spectra import FrequencyResponse, require_x64

from ._band import Band
from ._cancellation import far_pole, idle_pair, refused
from ._checks import check_options
from ._cost import CoherenceWeighted, Cost
from ._fit import fit
from ._pair import one_pair
from ._parameters import Real
from ._rational import Samples
from ._result import Fit
from ._transfer_function_guess import (
    checked_response,
    checked_structure,
    Delay,
    search,
    Structure,
    transfer_function,
    usable_samples,
)


def fit_transfer_function(
    frf: FrequencyResponse,
    zeros: int,
    poles: int,
    *,
    delay: Delay = "free",
    integrators: int = 0,
    output: int | str = 0,
    input: int | str = 0,
    cost: Cost = CoherenceWeighted(),
    band: Band = None,
    min_coherence: float = 0.6,
    max_steps: int = 256,
) -> Fit:
    """Identify a transfer function of given orders from one response (CIFER's NAVFIT).

        (b_0 s^m + .. + b_m) exp(-delay s) / (s^integrators (s^k + a_1 s^(k-1) + .. + a_k))

    with m = `zeros` and k + `integrators` = `poles`. No start is needed: see
    `jq.guess_transfer_function`. Coefficients may have any sign: poles and zeros are never forced
    to one side. A free `delay` that runs to 0 is fixed there, with a remark. `jq.factors` gives
    gain, zeros and poles. Where fewer zeros and poles explain the response as well, the fit is
    not identifiable, and says which orders to take.

    The result's parameters are `numerator[0]` .. , `denominator[1]` .. and `delay`. Options
    and errors as in `jq.fit`. Source: Tischler & Remple, ch. 11, eq. 11.4.
    """
    require_x64("a fit")
    check_options(cost, band, min_coherence, max_steps)
    structure = checked_structure(zeros, poles, integrators, delay)
    pair = one_pair(checked_response(frf), output, input)
    samples = usable_samples(pair, structure, cost, band, min_coherence)
    best = search(samples, structure)
    result = _refined(
        pair, transfer_function(best, samples, structure), structure, samples, cost, band,
        min_coherence, max_steps,
    )  # fmt: skip
    idle = idle_pair(pair, samples, structure, best, band, min_coherence)
    if idle is not None:
        return refused(result, idle)
    far = far_pole(result, float(samples.omega[-1]) * samples.unit)
    return result if far is None else _with_remark(result, far)


def _with_remark(result: Fit, remark: str) -> Fit:
    return dataclasses.replace(result, remarks=(*result.remarks, remark))


def _refined(
    pair: FrequencyResponse,
    start: TransferFunction,
    structure: Structure,
    samples: Samples,
    cost: Cost,
    band: Band,
    min_coherence: float,
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
    return _with_remark(result, "the delay ran to zero: it is fixed at 0")


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
