"""Starting values for a transfer function of any order, from a response alone."""

from typing import Any, Literal, NamedTuple

import numpy as np

from jaxquad.models import TransferFunction
from jaxquad.spectra import FrequencyResponse, require_x64

from ._band import Band, usable
from ._checks import check_options, checked_responses
from ._cost import CoherenceWeighted, Cost
from ._identifiable import NotIdentifiable
from ._pair import one_pair
from ._rational import Rational, Samples
from ._rational_search import lowest


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
    cost: Cost = CoherenceWeighted(),
    band: Band = None,
    min_coherence: float = 0.6,
) -> TransferFunction:
    """A transfer function of given orders that is near a response, with no start of one's own.

    Linear fits (Sanathanan-Koerner) over a range of delays, the best ones refined under
    `cost`, and again with roots reflected or moved. Poles and zeros may lie on either side
    of the imaginary axis. `poles` counts the `integrators`, which stay at 0. `delay` in s, or
    "free". Options as in `jq.fit`; frequencies below `min_coherence` are left out.

    Raises `NotIdentifiable` where too few frequencies are left, `ValueError` for orders that
    make no proper transfer function or that no start fits, `PrecisionError` in 32 bits.
    """
    require_x64("a transfer function")
    check_options(cost, band, min_coherence, 1)
    structure = checked_structure(zeros, poles, integrators, delay)
    pair = one_pair(checked_response(frf), output, input)
    samples = usable_samples(pair, structure, cost, band, min_coherence)
    return transfer_function(search(samples, structure), samples, structure)


def checked_response(frf: Any) -> FrequencyResponse:
    found = checked_responses(frf)
    if len(found) > 1:
        raise ValueError(
            f"{len(found)} responses: a transfer function is fitted to one; combine the records in "
            "jq.frequency_response([record, ...]), or start jq.fit(model, responses) from a guess"
        )
    return found[0]


def checked_structure(zeros: int, poles: int, integrators: int, delay: Delay) -> Structure:
    """Orders that make a proper transfer function, or ValueError."""
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


def usable_samples(
    pair: FrequencyResponse,
    structure: Structure,
    cost: Cost,
    band: Band,
    min_coherence: float,
) -> Samples:
    """The coherent points, in frequencies over the geometric mean of the lowest and highest."""
    used = usable(pair, band, min_coherence) & (np.abs(np.asarray(pair.response)) > 0)
    points, needed = int(used.sum()), structure.unknowns + 2
    # Magnitude and phase are two numbers, but half as many points leave nothing to judge by.
    if points < needed:
        best = float(np.max(np.asarray(pair.coherence)))
        raise NotIdentifiable(
            f"not identifiable from this record: coherence reaches {min_coherence:g} at {points} "
            f"of {used.size} frequencies, its maximum is {best:.2f}, and {structure.unknowns} "
            f"coefficients need at least {needed}: lower the orders, or measure more frequencies"
        )
    mask = used[:, 0, 0]
    weights = cost.weights(pair, used, np.ones(used.shape))[mask, 0, 0]
    omega = np.asarray(pair.omega)[mask]
    unit = float(np.sqrt(omega[0] * omega[-1]))
    s = 1j * omega / unit
    response = np.asarray(pair.response)[mask, 0, 0] * s**structure.integrators
    return Samples(s, response, weights, unit)


def search(samples: Samples, structure: Structure, extra: tuple[Rational, ...] = ()) -> Rational:
    """The lowest minimum found, in frequencies over the samples' unit."""
    delay = None if structure.delay is None else structure.delay * samples.unit
    poles = structure.poles - structure.integrators
    found = lowest(samples, structure.zeros, poles, delay, extra)
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
