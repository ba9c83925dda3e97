from typing import NamedTuple

import numpy as np

from jaxquad._core import check_positive, Number

from ._excitation import Excitation


class Guideline(NamedTuple):
    """One rule of the field, held against one design."""

    rule: str
    value: float
    limit: float
    ok: bool
    message: str

    def __str__(self) -> str:
        return f"{'kept  ' if self.ok else 'BROKEN'} {self.rule}: {self.message}"


class Guidelines(tuple[Guideline, ...]):
    """All rules that apply to a design; `ok` if none is broken."""

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
    """Hold a design against the rules of Tischler & Remple for identification from sweeps.

    The expected `omega_bandwidth` and `omega_180` (rad/s) of the response add a rule each for
    the ends of the band. Pulses serve for verification and are held to the sample rate only.
    """
    rules = [_sample_rate(excitation)]
    if excitation.kind in ("sweep", "multisine"):
        rules += [_record_length(excitation), _range(excitation), _window(excitation)]
        if omega_bandwidth is not None:
            check_positive(omega_bandwidth=omega_bandwidth)
            rules.append(_low_end(excitation, omega_bandwidth))
        if omega_180 is not None:
            check_positive(omega_180=omega_180)
            rules.append(_high_end(excitation, omega_180))
    if excitation.kind == "sweep":
        rules += [_lead_in(excitation), _trim(excitation)]
    return Guidelines(rules)


def _sample_rate(design: Excitation) -> Guideline:
    value, limit = 2 * np.pi * design.sample_rate, 25 * design.omega_max
    said = f"{design.sample_rate:.4g} Hz, 25 omega_max is {limit / (2 * np.pi):.4g} Hz"
    return _judge("sample rate", value, limit, said, "sample faster or lower omega_max")


def _record_length(design: Excitation) -> Guideline:
    longest = 2 * np.pi / design.omega_min
    said = (
        f"{design.duration:.4g} s excited, 4 to 5 T_max is {4 * longest:.4g} to {5 * longest:.4g} s"
    )
    if 4 * longest <= design.duration < 5 * longest:
        said += ": within it, longer is safer"
    advice = "lengthen the record or raise omega_min"
    return _judge("record length", design.duration, 4 * longest, said, advice)


def _range(design: Excitation) -> Guideline:
    value = design.omega_max / design.omega_min
    said = f"omega_max is {value:.4g} times omega_min, a decade is 10"
    return _judge("range", value, 10.0, said, "widen the band, or a model of it stays ambiguous")


def _window(design: Excitation) -> Guideline:
    longest, shortest = design.duration / 2, 20 * 2 * np.pi / design.omega_max
    said = f"half the record is {longest:.4g} s, 20 cycles of omega_max are {shortest:.4g} s"
    return _judge("window", longest, shortest, said, "lengthen the record or raise omega_max")


def _low_end(design: Excitation, omega_bandwidth: Number) -> Guideline:
    value, limit = design.omega_min, 0.5 * omega_bandwidth
    said = f"omega_min is {value:.4g} rad/s, half the bandwidth is {limit:.4g} rad/s"
    advice = "lower omega_min"
    return _judge("low end", value, limit, said, advice, highest=True)


def _high_end(design: Excitation, omega_180: Number) -> Guideline:
    value, limit = design.omega_max, 2.5 * omega_180
    said = f"omega_max is {value:.4g} rad/s, 2.5 omega_180 is {limit:.4g} rad/s"
    return _judge("high end", value, limit, said, "raise omega_max")


def _lead_in(design: Excitation) -> Guideline:
    cycles = design.lead_in * design.omega_min / (2 * np.pi)
    said = f"{cycles:.3g} cycles at omega_min, 2 are the rule"
    return _judge("lead-in", cycles, 2.0, said, "start with lead_in_cycles=2")


def _trim(design: Excitation) -> Guideline:
    value = min(design.lead, design.tail)
    said = f"{value:.3g} s of trim at each end, 3 s are the rule"
    return _judge("trim", value, 3.0, said, "add trim, or trim the record there by hand")


def _judge(
    rule: str, value: float, limit: float, said: str, advice: str, *, highest: bool = False
) -> Guideline:
    slack = 1e-9 * limit
    ok = value <= limit + slack if highest else value >= limit - slack
    return Guideline(
        rule, float(value), float(limit), bool(ok), said if ok else f"{said}: {advice}"
    )
