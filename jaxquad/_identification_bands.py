"""Whether a fit holds in all of its band: what it becomes without the lowest or highest part."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from .identify import Cost, Fit, fit, NotIdentifiable
from .identify._band import usable
from .models import LaggedIntegrator
from .report import comparison
from .spectra import FrequencyResponse


_DOUBT = 3.0  # ratio of misfit to random error from which the band is looked into
_DOMINATED = "feedback-dominated"
_MOVED = 0.1  # of the gain: more than that is no matter of noise


def by_bands(
    found: Fit, frf: FrequencyResponse, cost: Cost, derived: Mapping[str, Callable[[Any], Any]]
) -> tuple[Fit, str]:
    """The fit beside those in the upper and the lower two thirds of its frequencies.

    Returns it with a remark where the gain moves, and the table. Nothing is added where the
    misfit is below three times the noise, for other models than the lagged integrator, and for a
    response that feedback dominates: no part of it would be better.
    """
    small = found.chi_squared < _DOUBT**2 or not isinstance(found.model, LaggedIntegrator)
    if small or any(_DOMINATED in remark for remark in frf.remarks):
        return found, ""
    used = np.asarray(frf.omega)[usable(frf, None, 0.6)[:, 0, 0]]
    low, first, second, high = np.geomspace(used[0], used[-1], 4).tolist()
    parts = {"above": (first, high), "below": (low, second)}
    fits: dict[str, Fit | NotIdentifiable] = {f"{low:.3g} .. {high:.3g} rad/s": found}
    for word, band in parts.items():
        limit = first if word == "above" else second
        fits[f"{word} {limit:.3g} rad/s"] = _refitted(found, frf, cost, band)
    table = comparison(fits, derived)
    moved = [_moved(name, other, found) for name, other in list(fits.items())[1:]]
    remarks = tuple(filter(None, moved))
    return dataclasses.replace(found, remarks=(*found.remarks, *remarks)), table


def _refitted(
    found: Fit, frf: FrequencyResponse, cost: Cost, band: tuple[float, float]
) -> Fit | NotIdentifiable:
    """From where the fit stopped; its undetermined numbers too are finite in the model."""
    try:
        return fit(found.model, frf, free=found.names, cost=cost, band=band)
    except NotIdentifiable as error:
        return error
    except ValueError as error:  # The solver diverged.
        return NotIdentifiable(str(error))


def _moved(where: str, other: Fit | NotIdentifiable, found: Fit) -> str:
    if isinstance(other, NotIdentifiable):
        return ""
    before, after = found.values[0], other.values[0]
    apart = abs(after - before)
    if not apart > max(_MOVED * abs(before), 2 * other.standard_errors[0]):
        return ""
    ratio, was = other.chi_squared**0.5, found.chi_squared**0.5
    return (
        f"{where} the gain is {after:.4g} instead of {before:.4g}, with a misfit of {ratio:.1f} "
        f"instead of {was:.1f}: the model does not hold over the whole band. Fit within the part "
        f"where it does (--band, --band-rad), or fit one that has more to it"
    )
