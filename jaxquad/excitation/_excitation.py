"""A signal to excite a vehicle with, and the rules that it is checked against."""

import dataclasses
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad._core import Number, require_all_positive


Kind = Literal["sweep", "multisine", "doublet", "3-2-1-1"]


@dataclasses.dataclass(frozen=True, eq=False)
class Excitation:
    """A test signal with uniform time stamps from 0 s.

    The band `omega_min` .. `omega_max` is the range of a sweep, the lowest and highest line of a
    multisine, and for a pulse the band around the peak of its spectrum within 3 dB. `duration` is
    that of the excited part, without the zeros before and after it.
    """

    time: Float[np.ndarray, " samples"]  # s
    signal: Float[np.ndarray, " samples"]  # in the unit of the amplitude
    lines: Float[np.ndarray, " frequencies"]  # rad/s, of a multisine; none for the others
    kind: Kind
    omega_min: float  # rad/s
    omega_max: float  # rad/s
    amplitude: float  # peak
    sample_rate: float  # Hz
    duration: float  # s
    lead_in: float = 0.0  # s at omega_min
    lead: float = 0.0  # s of zeros before
    tail: float = 0.0  # s of zeros after

    @property
    def samples(self) -> int:
        """Number of samples."""
        return self.time.size

    def __str__(self) -> str:
        return (
            f"{self.kind}: {self.omega_min:.4g} to {self.omega_max:.4g} rad/s "
            f"({self.omega_min / (2 * np.pi):.3g} to {self.omega_max / (2 * np.pi):.3g} Hz), "
            f"amplitude {self.amplitude:.4g}, {self.duration:.6g} s excited of "
            f"{self.time[-1]:.6g} s at {self.sample_rate:.6g} Hz"
        )


class Guideline(NamedTuple):
    """One rule of test design, checked for one excitation."""

    rule: str
    value: float
    limit: float
    ok: bool
    message: str

    def __str__(self) -> str:
        return f"{'OK  ' if self.ok else 'FAIL'}  {self.message}"


class Guidelines(tuple[Guideline, ...]):
    """All rules that apply to an excitation; `ok` if it follows all of them."""

    @property
    def ok(self) -> bool:
        return all(guideline.ok for guideline in self)

    def __str__(self) -> str:
        return "\n".join(map(str, self))


def check_guidelines(
    excitation: Excitation,
    *,
    omega_bandwidth: Number | None = None,
    omega_180: Number | None = None,
) -> Guidelines:
    """Check an excitation against the guidelines for identification from frequency sweeps.

    Source: Tischler and Remple, "Aircraft and Rotorcraft System Identification", ch. 5.

    **Arguments:**

    - `excitation`: a sweep or a multisine. Pulses serve for verification, and only their sample
        rate is checked.
    - `omega_bandwidth`, `omega_180`: the expected bandwidth and 180 deg crossover of the response
        in rad/s; each adds a rule for one end of the band.

    **Returns:** `Guidelines`, a tuple of `Guideline`, which prints as one line for each rule.
    """
    rules = [_sample_rate(excitation)]
    if excitation.kind in ("sweep", "multisine"):
        rules += [_record_length(excitation), _range(excitation), _window(excitation)]
        if omega_bandwidth is not None:
            require_all_positive(omega_bandwidth=omega_bandwidth)
            rules.append(_low_end(excitation, omega_bandwidth))
        if omega_180 is not None:
            require_all_positive(omega_180=omega_180)
            rules.append(_high_end(excitation, omega_180))
    if excitation.kind == "sweep":
        rules += [_lead_in(excitation), _trim(excitation)]
    return Guidelines(rules)


def _sample_rate(design: Excitation) -> Guideline:
    value, limit = 2 * np.pi * design.sample_rate, 25 * design.omega_max
    said = (
        f"sample rate {design.sample_rate:.4g} Hz "
        f"(rule: at least 25 f_max = {limit / (2 * np.pi):.4g} Hz)"
    )
    return _guideline("sample rate", value, limit, said, "Sample faster, or lower omega_max")


def _record_length(design: Excitation) -> Guideline:
    longest = 2 * np.pi / design.omega_min
    said = (
        f"record length {design.duration:.4g} s excited (rule: at least 4 to 5 periods of "
        f"omega_min = {4 * longest:.4g} to {5 * longest:.4g} s)"
    )
    if 4 * longest <= design.duration < 5 * longest:
        said += "; longer is safer"
    advice = "Lengthen the record, or raise omega_min"
    return _guideline("record length", design.duration, 4 * longest, said, advice)


def _range(design: Excitation) -> Guideline:
    value = design.omega_max / design.omega_min
    said = f"range omega_max / omega_min = {value:.4g} (rule: at least 10, a decade)"
    advice = "Widen the band: a narrow band does not determine a model"
    return _guideline("range", value, 10.0, said, advice)


def _window(design: Excitation) -> Guideline:
    longest, shortest = design.duration / 2, 20 * 2 * np.pi / design.omega_max
    said = (
        f"window {longest:.4g} s, half the record "
        f"(rule: at least 20 cycles of omega_max = {shortest:.4g} s)"
    )
    advice = "Lengthen the record, or raise omega_max"
    return _guideline("window", longest, shortest, said, advice)


def _low_end(design: Excitation, omega_bandwidth: Number) -> Guideline:
    value, limit = design.omega_min, 0.5 * omega_bandwidth
    said = f"low end {_in_hertz(value)} (rule: at most half the bandwidth = {_in_hertz(limit)})"
    return _guideline("low end", value, limit, said, "Lower omega_min", highest=True)


def _high_end(design: Excitation, omega_180: Number) -> Guideline:
    value, limit = design.omega_max, 2.5 * omega_180
    said = f"high end {_in_hertz(value)} (rule: at least 2.5 omega_180 = {_in_hertz(limit)})"
    return _guideline("high end", value, limit, said, "Raise omega_max")


def _lead_in(design: Excitation) -> Guideline:
    cycles = design.lead_in * design.omega_min / (2 * np.pi)
    said = f"lead-in {cycles:.3g} cycles of omega_min (rule: at least 2)"
    return _guideline("lead-in", cycles, 2.0, said, "Use lead_in_cycles=2")


def _trim(design: Excitation) -> Guideline:
    value = min(design.lead, design.tail)
    said = f"trim {value:.3g} s of zeros at each end (rule: at least 3 s)"
    return _guideline("trim", value, 3.0, said, "Use trim=3, or record 3 s of trim at each end")


def _in_hertz(omega: Number) -> str:
    return f"{omega:.4g} rad/s = {omega / (2 * np.pi):.3g} Hz"


def _guideline(
    rule: str, value: float, limit: float, said: str, advice: str, *, highest: bool = False
) -> Guideline:
    slack = 1e-9 * limit
    ok = value <= limit + slack if highest else value >= limit - slack
    message = said if ok else f"{said}. {advice}"
    return Guideline(rule, float(value), float(limit), bool(ok), message)
