"""What a closed loop shows: the broken loop, the plant, and the bias by feedback."""

import dataclasses
from collections.abc import Sequence
from typing import get_args, Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxquad._core import Message
from jaxquad.models import Model
from jaxquad.records import Record

from ._estimators import (
    check_compatible,
    check_references,
    COHERENT,
    Grid,
    in_hertz,
    Remark,
    Response,
    Welch,
)
from ._frequency_response import FrequencyResponse
from ._welch import spectral_density


_LINES = 40  # frequencies, log-spaced
_CYCLES = 4  # of the lowest frequency in a window
_WINDOWS = 10  # that a record is cut into, about

_AMPLIFIED = 10.0  # factor on the relative error from which a remark is made
_SIGNIFICANT = 0.02  # share of noise in the input from which the joint estimate is recommended

Entry = Literal["set-point", "plant input"]


class BrokenLoop(NamedTuple):
    """The response of a loop L that is broken at its error, as `estimate_broken_loop` estimates it.

    **Attributes:**

    - `omega`: rad/s.
    - `response`: L, with negative feedback: closed as 1 + L = 0.
    - `error`: standard error, relative and in rad.
    - `coherence`: of the reference with what it was estimated from.
    """

    omega: Grid
    response: Response
    error: Grid
    coherence: Grid

    @property
    def crossover(self) -> float:
        """Where |L| falls through 1 for the last time, in rad/s; nan if not in the band."""
        return self._crossing(np.log(np.abs(self.response)))[0]

    @property
    def phase_margin(self) -> tuple[float, float]:
        """At the crossover, with its standard error, in rad."""
        place, k, share = self._crossing(np.log(np.abs(self.response)))
        if np.isnan(place):
            return float("nan"), float("nan")
        phase = np.unwrap(np.angle(-self.response))
        margin = phase[k] + share * (phase[k + 1] - phase[k])
        turn = 2 * np.pi
        return float((margin + np.pi) % turn - np.pi), float(self.error[k : k + 2].max())

    @property
    def gain_margin(self) -> tuple[float, float]:
        """Factor at the first crossing of -180 deg beyond the crossover, and where in rad/s."""
        phase = np.unwrap(np.angle(-self.response))
        start = np.searchsorted(self.omega, self.crossover) if self.crossover > 0 else 0
        phase = phase - 2 * np.pi * np.round(phase[min(start, phase.size - 1)] / (2 * np.pi))
        falls = [k for k in np.flatnonzero(np.diff(np.sign(phase)) < 0) if k + 1 >= start]
        if not falls:
            return float("nan"), float("nan")
        k = int(falls[0])
        share = phase[k] / (phase[k] - phase[k + 1])
        level = np.log(np.abs(self.response))
        place = np.log(self.omega)
        gain = level[k] + share * (level[k + 1] - level[k])
        return float(np.exp(-gain)), float(np.exp(place[k] + share * (place[k + 1] - place[k])))

    def _crossing(self, level: Grid) -> tuple[float, int, float]:
        falls = np.flatnonzero((level[:-1] > 0) & (level[1:] <= 0))
        if not falls.size:
            return float("nan"), 0, 0.0
        k = int(falls[-1])
        share = float(level[k] / (level[k] - level[k + 1]))
        place = np.log(self.omega)
        return float(np.exp(place[k] + share * (place[k + 1] - place[k]))), k, share


def estimate_broken_loop(
    record: Record,
    *,
    entry: Entry,
    reference: str | None = None,
    output: str | None = None,
    input: str | None = None,
    band: tuple[float, float] | None = None,
) -> BrokenLoop:
    """Estimate the broken loop L of a flight, without knowing plant or controller.

    A reference that is compared with the output closes as y = T r, T = L / (1 + L), so that
    L = T / (1 - T). One that is added to the plant's input closes as u = S r, S = 1 / (1 + L), so
    that L = 1 / S - 1. T and S are averages over tapered windows and neighbouring frequencies, and
    their errors are propagated to first order.
    Source: Tischler and Remple, "Aircraft and Rotorcraft System Identification", 2nd ed., sec. 5.7
    and 9.2 (the random error of an average).

    **Arguments:**

    - `record`: with a reference.
    - `entry`: where the reference enters, "set-point" or "plant input".
    - `reference`, `output`, `input`: channels, by default the first of each.
    - `band`: in rad/s; by default from four cycles in a window to a fifth of the sample rate.

    **Returns:** a `BrokenLoop` of the frequencies with a coherence of 0.6 or more; it may be empty.

    **Raises:** ValueError for a record without a reference, and for another entry.
    """
    if entry not in get_args(Entry):
        entries = " or ".join(map(repr, get_args(Entry)))
        raise ValueError(f"entry is {entry!r}: say where the reference enters, {entries}")
    if reference is None and not record.reference_names:
        raise ValueError(
            Message(
                "the record has no reference, so its loop is not known: name one («reference=»)"
            )
        )
    source = reference or record.reference_names[0]
    answer = output or record.output_names[0]
    answer = answer if entry == "set-point" else input or record.input_names[0]
    size = 2 * (record.samples // (_WINDOWS + 1))
    starts = np.arange(0, record.samples - size + 1, size // 2)
    taper = np.sin(np.pi * (np.arange(size) + 0.5) / size) ** 2
    one, other = (
        np.fft.rfft(taper * (x - x.mean())[starts[:, None] + np.arange(size)], axis=1)
        for x in (record.channel(source), record.channel(answer))
    )
    fine = 2 * np.pi * np.fft.rfftfreq(size, record.dt)
    low, high = band or (_CYCLES * fine[1], 0.2 * 2 * np.pi * record.sample_rate)
    edges = np.geomspace(max(low, 2 * fine[1]), min(high, fine[-2]), _LINES + 1)
    parts = []
    for begin, end in zip(edges[:-1], edges[1:], strict=True):
        bins = np.flatnonzero((fine >= begin) & (fine < end))
        if bins.size:
            parts.append(_average(one[:, bins], other[:, bins], fine[bins]))
    table = np.array(parts, complex).reshape(-1, 4).T
    omega, closed, error, coherence = table[0].real, table[1], table[2].real, table[3].real
    kept = (coherence >= COHERENT) & (closed != 0) & (closed != 1)
    omega, closed, error, coherence = (x[kept] for x in (omega, closed, error, coherence))
    if entry == "set-point":
        loop, size = closed / (1 - closed), error / np.abs(1 - closed)
    else:
        loop, size = 1 / closed - 1, error / np.abs(1 - closed)
    return BrokenLoop(omega, loop, size, coherence)


def _average(
    one: np.ndarray, other: np.ndarray, omega: Grid
) -> tuple[float, complex, float, float]:
    """Over windows and neighbours, at the frequency where the reference has its power."""
    powers = np.abs(one) ** 2
    power = np.maximum(np.sum(powers), 1e-150)
    cross = np.sum(np.conj(one) * other)
    total = np.maximum(np.sum(np.abs(other) ** 2), 1e-150)
    # Windows that overlap, and neighbours of tapered spectra, are half as many as they seem.
    count = max(power**2 / np.maximum(np.sum(powers**2), 1e-300) / 2, 1.0)
    raw = np.abs(cross) ** 2 / (power * total)
    coherence = float(np.clip((count * raw - 1) / max(count - 1, 1e-3), 0.0, 1.0))
    error = np.sqrt((1 - coherence) / max(2 * count * coherence, 1e-9))
    middle = float(np.sum(powers.sum(axis=0) * omega) / power)
    return middle, complex(cross / power), float(error), coherence


def deembed(
    closed: FrequencyResponse,
    controller: Model,
    *,
    entry: Literal["set-point", "plant input"] = "set-point",
) -> FrequencyResponse:
    """Calculate the plant from a measured closed loop whose controller is known.

    With T = G C / (1 + G C) measured from the set-point, G = T / (C (1 - T)); with
    P = G / (1 + G C) measured from the plant input, G = P / (1 - P C). Random errors are propagated
    to first order.

    **Arguments:**

    - `closed`: the `FrequencyResponse` of one output to the injected signal.
    - `controller`: has `frequency_response(omega)`, from minus the output to the plant input, shape
        `(frequencies, 1, 1)`; it is taken as exact.
    - `entry`: where the signal was injected, `"set-point"` or `"plant input"`.

    **Returns:** the `FrequencyResponse` of the plant, with a remark where the loop amplifies the
    errors of the closed loop more than ten times.

    **Raises:**

    - `ValueError`: for another entry, or responses with more than one input or output.
    """
    measured = np.asarray(closed.response)
    feedback = np.asarray(controller.frequency_response(jnp.asarray(closed.omega)))
    if measured.shape[1:] != (1, 1) or feedback.shape != measured.shape:
        raise ValueError(
            f"deembed needs one input and one output, but the response has shape {measured.shape} "
            f"and the controller's {feedback.shape} (frequencies, outputs, inputs): select "
            "channels with jq.records.select"
        )
    if entry == "set-point":
        rest = 1 - measured
        plant, slope = measured / (feedback * rest), 1 / (feedback * rest**2)
    elif entry == "plant input":
        rest = 1 - measured * feedback
        plant, slope = measured / rest, 1 / rest**2
    else:
        raise ValueError(f"entry is {entry!r}: use 'set-point' or 'plant input'")
    amplified = np.abs(slope * measured / plant)
    lost, remarks = np.asarray(closed.omega)[amplified[:, 0, 0] > _AMPLIFIED], list(closed.remarks)
    if lost.size:
        text = (
            f"the closed loop hardly depends on the plant {{where}}: its errors are amplified more "
            f"than {_AMPLIFIED:g} times there. Leave these frequencies out, or inject the signal "
            "at the plant input"
        )
        remarks.append(Remark(text, lost, kind="amplified errors"))
    errors = closed.errors.scaled(jnp.asarray(slope[:, 0, 0]))
    return dataclasses.replace(
        closed,
        response=jnp.asarray(plant),
        random_error=closed.random_error * jnp.asarray(amplified),
        errors=errors,
        remarks=tuple(remarks),
    )


class FeedbackBias(eqx.Module):
    """The bias of the direct estimate by noise that a controller C feeds back.

    With g^2 the coherence of reference and input, the direct estimate is
    H1 = g^2 G + (1 - g^2) (-1/C). `noise_share` is 1 - g^2, `joint` is G, and `inverse` is -1/C,
    estimated from the parts of input and output that the reference does not explain.
    """

    omega: Grid  # rad/s
    direct: Response
    joint: Response
    inverse: Response
    noise_share: Grid  # of the input's power, 0 to 1

    @property
    def bias(self) -> Response:
        """Relative error of the direct estimate, H1 / G - 1."""
        return self.direct / self.joint - 1

    def __str__(self) -> str:
        worst, largest = int(np.argmax(self.noise_share)), int(np.argmax(np.abs(self.bias)))
        share, size = 100 * self.noise_share, 100 * np.abs(self.bias)
        lines = [
            f"feedback: {np.median(share):.2g} % of the input's power is fed-back noise (median), "
            f"at most {share[worst]:.2g} % at {in_hertz(self.omega[[worst]])}",
            f"  bias of the direct estimate: {np.median(size):.2g} % (median), at most "
            f"{size[largest]:.2g} % at {in_hertz(self.omega[[largest]])}",
        ]
        if np.max(self.noise_share) > _SIGNIFICANT:
            lines.append("  use the joint estimate, the default for a record with a reference")
        return "\n".join(lines)


def feedback_bias(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | None = None,
    *,
    welch: Welch | None = None,
) -> FeedbackBias:
    """Estimate how far feedback biases the direct estimate of a plant.

    Input and output are split into the part that the reference explains and the rest (Wellstead,
    1981, "Non-parametric methods of system identification"; Forssell and Ljung, 1999, "Closed-loop
    identification revisited").

    **Arguments:**

    - `record`: one `Record` or several, with one input, one output and one external reference.
    - `omega`: frequencies in rad/s; by default those of `welch`.
    - `welch`: window and overlap, by default `jq.spectra.Welch()`.

    **Returns:** a `FeedbackBias`, which prints as a summary.

    **Raises:**

    - `ValueError`: for other channels, and for frequencies that the window does not resolve.
    """
    records = [record] if isinstance(record, Record) else list(record)
    check_compatible(records)
    check_references(records)
    first = records[0]
    if len(first.input_names) != 1 or len(first.output_names) != 1:
        raise ValueError(
            f"feedback_bias needs one input and one output, but the record has "
            f"{first.input_names} and {first.output_names}: select them with jq.records.select"
        )
    density = spectral_density(records, omega, welch=welch)
    u, y, r = first.names
    power, spread = np.asarray(density.power(u)), np.asarray(density.power(r))
    cross, from_u, from_y = (np.asarray(density.cross(*pair)) for pair in ((u, y), (r, u), (r, y)))
    explained = np.abs(from_u) ** 2 / spread
    joint = from_y / from_u
    rest = np.maximum(power - explained, 1e-300)
    return FeedbackBias(
        np.asarray(density.omega),
        cross / power,
        joint,
        (cross - np.conj(from_u) * from_y / spread) / rest,
        np.clip(1 - explained / power, 0.0, 1.0),
    )
