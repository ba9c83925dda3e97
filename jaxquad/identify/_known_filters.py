"""Filters of the log's output that are known, as those of a gyro are: what is left without them."""

import dataclasses
from collections.abc import Sequence
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Array, Complex, Float

from jaxquad.records import Record
from jaxquad.spectra import FrequencyResponse


Frequencies = Float[np.ndarray, " frequencies"]


@runtime_checkable
class KnownFilter(Protocol):
    """A filter of the log's output, as `jq.autopilot.FilterChain` is one."""

    def response(self, frequency_hz: Frequencies) -> Complex[Array | np.ndarray, " frequencies"]:
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


def behind_filters(record: Record, filters: Sequence[KnownFilter]) -> Record:
    """The record with inputs that have passed the filters, which the outputs have.

    A model up to what the filters were given makes of these inputs what left the filters. Before
    the record the inputs are taken as constant.
    """
    if not filters:
        return record
    inputs, size = np.asarray(record.inputs), 2 * record.samples
    passed = filter_response(filters, 2 * np.pi * np.fft.rfftfreq(size, record.dt))
    spectra = np.fft.rfft(inputs - inputs[0], size, axis=0) * passed[:, None]
    late = inputs[0] + np.fft.irfft(spectra, size, axis=0)[: record.samples]
    return dataclasses.replace(record, inputs=late)


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
