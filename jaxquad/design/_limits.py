"""Peaks that a test signal must keep: its own, that of its rate, those of the outputs."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


class Limits(NamedTuple):
    """Signals made from the input by a filter each, and the peaks that they may have."""

    names: tuple[str, ...]
    filters: Complex[np.ndarray, "limits frequencies"]
    peaks: Float[np.ndarray, " limits"]

    def costs(self, crest: Float[np.ndarray, " limits"]) -> Float[np.ndarray, "limits frequencies"]:
        """Share of each limit that unit mean square at a line takes, at these crest factors."""
        return np.abs(self.filters) ** 2 * (crest / self.peaks)[:, None] ** 2


def gather_limits(
    omega: Float[np.ndarray, " frequencies"],
    responses: Sequence[Complex[np.ndarray, "frequencies outputs"]],
    amplitude: float | int,
    rate: float | int | None,
    output_amplitude: float | int | Sequence[float] | None,
) -> Limits:
    """The limits that are asked for; an output's holds for every model of an ensemble."""
    names, filters, peaks = ["amplitude"], [np.ones(omega.size, complex)], [amplitude]
    if rate is not None:
        names, filters, peaks = [*names, "rate"], [*filters, 1j * omega], [*peaks, rate]
    outputs = responses[0].shape[1]
    for o, peak in enumerate(_per_output(output_amplitude, outputs)):
        for m, response in enumerate(responses):
            if peak < np.inf:
                which = f" {o}" if outputs > 1 else ""
                names.append(f"output{which}" + (f", model {m}" if len(responses) > 1 else ""))
                filters.append(response[:, o])
                peaks.append(peak)
    for name, peak in zip(names, peaks, strict=True):
        if not 0 < peak < np.inf:
            raise ValueError(f"the limit of {name} is {peak}: it has to be positive and finite")
    return Limits(tuple(names), np.array(filters), np.array(peaks, float))


def _per_output(limit: float | int | Sequence[float] | None, outputs: int) -> list[float]:
    if limit is None:
        return [np.inf] * outputs
    given = [float(limit)] * outputs if isinstance(limit, int | float) else list(limit)
    if len(given) != outputs:
        raise ValueError(
            f"output_amplitude has {len(given)} values for {outputs} outputs: give one for each, "
            "inf where there is no limit"
        )
    return given
