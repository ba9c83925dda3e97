"""Filters of the log's output that are known, as those of a gyro are: what is left without them."""

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad.spectra import FrequencyResponse


Frequencies = Float[np.ndarray, " frequencies"]


@runtime_checkable
class KnownFilter(Protocol):
    """A filter of the log's output, as `jq.control.autopilots.FilterChain` is one."""

    def response(self, frequency_hz: Frequencies) -> Complex[Array, " frequencies"]:
        """At frequencies in Hz."""
        ...


def filter_response(
    filters: Sequence[KnownFilter], omega: Frequencies
) -> Complex[np.ndarray, " frequencies"]:
    """Of all filters, one after the other; frequencies in rad/s."""
    passed = np.ones(omega.size, complex)
    for each in filters:
        passed = passed * np.asarray(each.response(omega / (2 * np.pi)))
    return passed


def without_filters(frf: FrequencyResponse, filters: Sequence[KnownFilter]) -> FrequencyResponse:
    """The response up to what the filters were given, its random errors with it.

    **Arguments:**

    - `frf`: up to what left the filters.
    - `filters`: those that all outputs passed, such as a gyro's.

    **Returns:** a `FrequencyResponse`; relative errors and coherence stay.
    """
    if not filters:
        return frf
    known = filter_response(filters, np.asarray(frf.omega))
    return dataclasses.replace(
        frf, response=frf.response / known[:, None, None], errors=frf.errors.scaled(1 / known)
    )
