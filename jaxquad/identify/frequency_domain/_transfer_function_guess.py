"""Starting values for a transfer function of any order, from a response alone."""

import dataclasses
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial.polynomial import polyfromroots, polyroots

from jaxquad._core import require_x64
from jaxquad.models import TransferFunction
from jaxquad.spectra import FrequencyResponse

from ..uncertainty._verdict import UndeterminedError
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
from ._fit import check_options, require_responses
from ._rational import Coefficients, descend, Rational, Samples, sanathanan_koerner


MORE_POINTS = "lower the orders, or measure more frequencies"
_DELAY_STEP = 0.7  # rad at the highest frequency
_MOST_DELAYS = 60
_PLACES = 5  # frequencies at which an idle pair is tried
_TRIED = 8  # linear starts that are refined
_SHORT, _LONG = 12, 200  # steps of a descent: to compare starts, and to finish


def lowest_minimum(
    samples: Samples, zeros: int, poles: int, delay: float | None, extra: tuple[Rational, ...] = ()
) -> Rational:
    """The best minimum found; `delay` is free where it is None.

    Starts are linear fits at delays from 0 to beyond what the phase's slope allows, further ones in
    `extra`, and the best of them with one root (or pair) reflected to the other half plane, or with
    its outermost zero and pole, which may be idle beyond the band, placed within it.
    """
    free = delay is None
    delays = _delays(samples) if delay is None else np.array([delay])
    starts = [sanathanan_koerner(samples, zeros, poles, float(each)) for each in delays]
    starts = sorted(starts, key=lambda model: model.cost)[:_TRIED] + list(extra)
    short = [descend(samples, each, steps=_SHORT, free_delay=free) for each in starts]
    best = min(short, key=lambda model: model.cost)
    for _ in range(2):
        best = descend(samples, best, steps=_LONG, free_delay=free)
        if not np.isfinite(best.cost):
            return best
        others = _with_reflected_roots(best) + _with_moved_pair(samples, best)
        again = [descend(samples, each, steps=_SHORT, free_delay=free) for each in others]
        better = min(again, key=lambda model: model.cost, default=best)
        if not better.cost < 0.999 * best.cost:
            return best
        best = better
    return descend(samples, best, steps=_LONG, free_delay=free)


def _delays(samples: Samples) -> Float[np.ndarray, " delays"]:
    """From 0 to 4 rad at the highest frequency, or beyond what the phase's slope allows."""
    omega, phase = samples.omega, np.unwrap(np.angle(samples.response))
    slope = -np.diff(phase)[omega.size // 2 :] / np.diff(omega)[omega.size // 2 :]
    limit = 4.0 / omega[-1] + 1.2 * max(float(np.median(slope)), 0.0)
    count = int(np.clip(limit * omega[-1] / _DELAY_STEP + 1, 2, _MOST_DELAYS))
    return np.linspace(0.0, limit, count)


def _with_reflected_roots(model: Rational) -> list[Rational]:
    """One zero or pole, or a pair, mirrored in the imaginary axis."""
    found = []
    for above, odd in _mirrored(model.above):
        side = model._replace(above=-above if odd else above)
        found += [side, side._replace(above=-side.above)] if odd else [side]
    for below, odd in _mirrored(model.below):
        side = model._replace(below=below)
        found += [side, side._replace(above=-side.above)] if odd else [side]
    return found


def _mirrored(coefficients: Coefficients) -> list[tuple[Coefficients, bool]]:
    """The polynomials with one root, or pair, mirrored, and whether it was a single root."""
    roots, found = polyroots(coefficients), []
    for root in roots[roots.imag >= 0]:
        mine = (roots == root) | (roots == root.conj())
        mirrored = np.where(mine, -roots.conj(), roots)
        polynomial = coefficients[-1] * np.real(polyfromroots(mirrored))
        found.append((polynomial, bool(np.sum(mine) % 2)))
    return found


def _with_moved_pair(samples: Samples, model: Rational) -> list[Rational]:
    """The outermost real zero and pole as a near-cancelling pair within the band."""
    zeros, poles = polyroots(model.above), polyroots(model.below)
    if not (np.any(zeros.imag == 0) and np.any(poles.imag == 0)):
        return []
    zero, pole = (max(roots[roots.imag == 0], key=abs) for roots in (zeros, poles))
    found = []
    lead = model.above[-1] * np.real((1j - zero) / (1j - pole))
    for place in np.geomspace(samples.omega[0], samples.omega[-1], _PLACES):
        for apart in (0.8, 1.25):
            moved = np.where(zeros == zero, -place * apart, zeros)
            above = lead * np.real(polyfromroots(moved))
            below = np.real(polyfromroots(np.where(poles == pole, -place, poles)))
            found.append(model._replace(above=above, below=below))
    return found


def select_pair(frf: FrequencyResponse, output: int | str, input: int | str) -> FrequencyResponse:
    """The response of one output to one input, by name or number; raises ValueError."""
    o = _position("output", output, frf.output_names)
    i = _position("input", input, frf.input_names)

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


def _position(role: str, wanted: int | str, names: tuple[str, ...]) -> int:
    if isinstance(wanted, str) and wanted in names:
        return names.index(wanted)
    if isinstance(wanted, int | np.integer) and 0 <= wanted < len(names):
        return int(wanted)
    raise ValueError(f"{role}={wanted!r}: the response has {role}s 0 to {len(names) - 1}, {names}")


Delay = Literal["free"] | float | int  # s


class Structure(NamedTuple):
    """Orders of a transfer function; `poles` counts the `integrators` too."""

    zeros: int
    poles: int
    integrators: int
    delay: float | None  # s; None if it is free

    @property
    def unknowns(self) -> int:
        return self.zeros + 1 + self.poles - self.integrators + (self.delay is None)


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
    pair = select_pair(require_single_response(frf), output, input)
    least = least_coherence(min_coherence, cost, pair)
    points = usable_points(pair, band, least)
    reason = too_few_points(points, structure, least)
    if reason is not None:
        raise UndeterminedError(f"no transfer function from this record: {reason}; {MORE_POINTS}")
    samples = usable_samples(points, structure, cost)
    return transfer_function(search(samples, structure), samples, structure)


def require_single_response(frf: object) -> FrequencyResponse:
    """A single response. Raise ValueError for several."""
    found = require_responses(frf)
    if len(found) > 1:
        raise ValueError(
            f"{len(found)} responses: a transfer function is fitted to one; combine the records in "
            "jq.frequency_response([record, ...]), or start jq.fit(model, responses) from a guess"
        )
    return found[0]


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


def usable_points(pair: FrequencyResponse, band: Band, least: float) -> Points:
    """The points of a single response that count, as in `jq.fit`."""
    used = usable(pair, band, least) & (np.abs(np.asarray(pair.response)) > 0)
    return points_of([pair], [used])[0]


def usable_samples(points: Points, structure: Structure, cost: Cost) -> Samples:
    """The points that count, in frequencies over the geometric mean of the lowest and highest."""
    pair, mask = points.frf, points.used[:, 0, 0]
    weights = cost.weights(points, np.ones(points.used.shape))[mask, 0, 0]
    omega = np.asarray(pair.omega)[mask]
    unit = float(np.sqrt(omega[0] * omega[-1]))
    s = 1j * omega / unit
    response = np.asarray(pair.response)[mask, 0, 0] * s**structure.integrators
    return Samples(s, response, weights, unit)


def too_few_points(points: Points, structure: Structure, least: float) -> str | None:
    """Why a structure cannot be fitted, where fewer frequencies are usable than it needs."""
    count, needed = int(points.used.sum()), structure.unknowns + 2
    # Magnitude and phase are two numbers, but half as many points leave nothing to judge by.
    if count >= needed:
        return None
    return (
        f"{describe_usable([points.frf], count, least)}, and {structure.unknowns} coefficients "
        f"need at least {needed}"
    )


def search(samples: Samples, structure: Structure, extra: tuple[Rational, ...] = ()) -> Rational:
    """The lowest minimum found, in frequencies over the samples' unit."""
    delay = None if structure.delay is None else structure.delay * samples.unit
    poles = structure.poles - structure.integrators
    found = lowest_minimum(samples, structure.zeros, poles, delay, extra)
    if not np.isfinite(found.cost):
        raise ValueError(
            f"no transfer function of {structure.zeros} zeros and {structure.poles} poles has a "
            "finite response near the measured one: lower the orders, or look at the response"
        )
    return found


def transfer_function(found: Rational, samples: Samples, structure: Structure) -> TransferFunction:
    """In rad/s and s, with the integrators."""
    below = np.concatenate([np.zeros(structure.integrators), found.below])
    scale = samples.unit ** np.arange(structure.poles, -1, -1.0)
    above = found.above * scale[: structure.zeros + 1]
    delay = found.delay / samples.unit if structure.delay is None else structure.delay
    return TransferFunction(above[::-1], (below * scale)[::-1], delay)
