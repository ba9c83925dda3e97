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
    low, high, duration = excitation.omega_min, excitation.omega_max, excitation.duration
    limit = 25 * high
    rules = [
        _guideline(
            "sample rate",
            2 * np.pi * excitation.sample_rate,
            limit,
            f"sample rate {excitation.sample_rate:.4g} Hz "
            f"(rule: at least 25 f_max = {limit / (2 * np.pi):.4g} Hz)",
            "Sample faster, or lower omega_max",
        )
    ]
    if excitation.kind in ("sweep", "multisine"):
        longest, shortest = 2 * np.pi / low, 20 * 2 * np.pi / high
        safer = "; longer is safer" if 4 * longest <= duration < 5 * longest else ""
        rules += [
            _guideline(
                "record length",
                duration,
                4 * longest,
                f"record length {duration:.4g} s excited (rule: at least 4 to 5 periods of "
                f"omega_min = {4 * longest:.4g} to {5 * longest:.4g} s){safer}",
                "Lengthen the record, or raise omega_min",
            ),
            _guideline(
                "range",
                high / low,
                10.0,
                f"range omega_max / omega_min = {high / low:.4g} (rule: at least 10, a decade)",
                "Widen the band: a narrow band does not determine a model",
            ),
            _guideline(
                "window",
                duration / 2,
                shortest,
                f"window {duration / 2:.4g} s, half the record "
                f"(rule: at least 20 cycles of omega_max = {shortest:.4g} s)",
                "Lengthen the record, or raise omega_max",
            ),
        ]
        in_hertz = lambda omega: f"{omega:.4g} rad/s = {omega / (2 * np.pi):.3g} Hz"
        if omega_bandwidth is not None:
            require_all_positive(omega_bandwidth=omega_bandwidth)
            limit = 0.5 * omega_bandwidth
            said = f"low end {in_hertz(low)} (rule: at most half the bandwidth = {in_hertz(limit)})"
            rules.append(_guideline("low end", low, limit, said, "Lower omega_min", highest=True))
        if omega_180 is not None:
            require_all_positive(omega_180=omega_180)
            limit = 2.5 * omega_180
            said = f"high end {in_hertz(high)} (rule: at least 2.5 omega_180 = {in_hertz(limit)})"
            rules.append(_guideline("high end", high, limit, said, "Raise omega_max"))
    if excitation.kind == "sweep":
        cycles = excitation.lead_in * low / (2 * np.pi)
        said = f"lead-in {cycles:.3g} cycles of omega_min (rule: at least 2)"
        rules.append(_guideline("lead-in", cycles, 2.0, said, "Use lead_in_cycles=2"))
        zeros = min(excitation.lead, excitation.tail)
        said = f"trim {zeros:.3g} s of zeros at each end (rule: at least 3 s)"
        advice = "Use trim=3, or record 3 s of trim at each end"
        rules.append(_guideline("trim", zeros, 3.0, said, advice))
    return Guidelines(rules)


def _guideline(
    rule: str, value: float, limit: float, said: str, advice: str, *, highest: bool = False
) -> Guideline:
    slack = 1e-9 * limit
    ok = value <= limit + slack if highest else value >= limit - slack
    message = said if ok else f"{said}. {advice}"
    return Guideline(rule, float(value), float(limit), bool(ok), message)
