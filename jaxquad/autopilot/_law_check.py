"""Whether a log's gains are those that flew: the law replayed on its set-point and its gyro.

Each term is compared with the logged one: by its size, and by what the replay leaves of it beyond
what the log's rounding explains. Source: docs/autopilots.md, "Which gains flew".
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxquad._core import plain_content

from ._flight_channels import FlightChannels
from ._law import FlownLoop, pick_axis
from ._replay import replay_terms


Samples = Float[np.ndarray, " samples"]
_COPIES = 3  # of the signals with other roundings
_SLOWEST = 1.0  # Hz, below which what drifts is not compared
_SETTLED = 0.3  # s, for filters that start at rest
_BAND = 0.1  # of the log's rate, beyond which the log does not show what the loop saw
_LIVELY = 0.02  # of the output's rms, below which a term says nothing of its gain
_OFF, _LEFT = 0.05, 0.1  # of a term's size, and what may be left of it, for the gains that flew
_OFF_SLOW, _LEFT_SLOW = 0.03, 0.06  # more of these for each octave that the log is slower
_SHIFTED = 0.02  # what is left of the output, from which a shift of the set-point is tried
_BETTER = 0.5  # of that, for a shift to be believed
_WINDOW = 0.2  # s, from one start of the integral to the next


class TermReplay(NamedTuple):
    """One term of the law beside the logged one; numbers in the firmware's unit.

    **Attributes:**

    - `rms`: of the logged term; `left`: of what the replay leaves, without what rounding explains;
        `rounding`: what that explains.
    - `size`: the logged term over the replayed one, by least squares; `size_error`: its standard
        error.
    - `slower`: octaves by which the log is slower than a quarter of the loop's rate: what happens
        between its samples is not in the replay.
    """

    rms: float
    left: float
    rounding: float
    size: float
    size_error: float
    slower: float = 0.0

    @property
    def share(self) -> float:
        """What is left, of the logged term."""
        return self.left / self.rms if self.rms > 0 else 0.0

    @property
    def off(self) -> bool:
        """Whether the term is not that of the gains, beyond its errors."""
        blur = self.rounding / max(self.rms, 1e-300)
        doubt = 3 * self.size_error + 2 * blur**2  # errors of both sides of a slope
        off, left = _OFF + _OFF_SLOW * self.slower, _LEFT + _LEFT_SLOW * self.slower
        return bool(abs(self.size - 1) > max(off, doubt) or self.share > max(left, doubt))


@dataclasses.dataclass(frozen=True)
class LawCheck:
    """The terms of the law that flew, replayed.

    **Attributes:**

    - `terms`: "P", "I", "D" where they are logged, and "output", their sum with feed-forward.
    - `late`: s after its stamp at which the set-point acted; `shifted`: whether that was found in
        this log, and not known of the firmware.
    - `slewed`: by how much a slew limiter (SMAX) lowered P and D on the average, of 1.
    """

    terms: Mapping[str, TermReplay]
    late: float = 0.0
    shifted: bool = False
    slewed: float = 0.0

    @property
    def wrong(self) -> tuple[str, ...]:
        """Terms that are not those of the gains, the largest misfit first; the output last."""
        size = max((term.rms for term in self.terms.values()), default=0.0)
        off = {
            name: abs(term.size - 1) + term.share
            for name, term in self.terms.items()
            if name != "output" and term.rms > _LIVELY * size and term.off
        }
        if off or "output" not in self.terms:
            return tuple(sorted(off, key=lambda name: -off[name]))
        return ("output",) if self.terms["output"].off else ()

    @property
    def flew(self) -> bool:
        """Whether these gains and filters make the logged terms."""
        return bool(self.terms) and not self.wrong

    @property
    def text(self) -> str:
        """In words."""
        if not self.terms:
            return "the log holds neither the terms of the law nor its output"
        shares = ", ".join(
            f"{100 * term.share:.2g} % of {name}"
            for name, term in self.terms.items()
            if term.rms > 0
        )
        kept = f"the law replayed on the logged set-point and gyro leaves {shares} beyond rounding"
        if self.shifted:
            kept += f", with the set-point {1e3 * self.late:+.3g} ms after its stamp"
        if self.flew:
            return f"these gains flew: {kept}"
        worst = self.terms[self.wrong[0]]
        return (
            f"these are not the gains that flew: {self.wrong[0]} in the log is "
            f"{worst.size:.2f} +- {1.96 * worst.size_error:.2g} times what they make, and "
            f"{100 * worst.share:.2g} % of it are left; {kept}. Look for another profile, for "
            "parameters changed in flight, and for a law that is not modelled"
        )

    def content(self) -> dict[str, object]:
        """All numbers, for JSON."""
        return {
            "flew": self.flew,
            "text": self.text,
            "setpoint_late_s": self.late,
            "shift_found": self.shifted,
            "lowered_by_slew_limit": self.slewed,
            "terms": {
                name: plain_content(term._asdict() | {"share": term.share})
                for name, term in self.terms.items()
            },
        }


def check_law(flown: FlownLoop, axis: int, flight: FlightChannels) -> LawCheck:
    """Replay the law of one axis on a flight.

    Where more than 2 % of the output are left, the set-point is tried one loop earlier and later.
    """
    law = pick_axis(flown, axis)
    known = _checked(law, flight, flight.late)
    output = known.terms.get("output")
    if output is None or output.share <= _SHIFTED:
        return known
    step = flown.law.interval()
    others = [_checked(law, flight, flight.late + way * step) for way in (1, -1)]
    best = min(others, key=lambda each: each.terms["output"].left)
    if best.terms["output"].left > _BETTER * output.left:
        return known
    return dataclasses.replace(best, shifted=True)


def _checked(law: FlownLoop, flight: FlightChannels, late: float) -> LawCheck:
    logged = {name: x for name, x in flight.terms.items() if name != "F" and np.any(x)}
    logged = logged if {"P", "I"} <= set(logged) else {}  # else the output alone
    forward, output = flight.terms.get("F"), flight.output
    setpoint, rate = flight.setpoint, flight.rates[flight.axis]
    roundings = np.random.default_rng(0)
    of_rate, of_term = flight.resolution
    copies = lambda x, step: np.stack(
        [x, *(x + _rounding_error(x, step, roundings) for _ in range(_COPIES))], axis=1
    )
    many = 1 + _COPIES
    terms = replay_terms(
        law, copies(setpoint, of_rate), copies(rate, of_rate), flight.followed, dt=flight.dt,
        feed_forward=None if forward is None else np.repeat(forward[:, None], many, axis=1),
        integral=copies(flight.terms["I"], of_term) if "I" in flight.terms else None,
        mixer_range=flight.mixer_range, late=late, restart=_WINDOW,
    )  # fmt: skip
    if flight.slewed is not None:
        terms |= {name: terms[name] * flight.slewed[:, None] for name in "PD"}
    if "I" in logged and any(each.kind == "anti-gravity" for each in law.unmodelled):
        terms["I"] = np.repeat(logged.pop("I")[:, None], many, axis=1)  # not judged
    if forward is not None:
        terms["F"] = np.repeat(forward[:, None], many, axis=1)
    if output is not None:
        logged["output"] = output if flight.injected is None else output - _late_by(flight, late)
        terms["output"] = terms["P"] + terms["I"] + terms["D"] + terms["F"]
    slower = max(0.0, float(np.log2(flight.dt / law.law.interval())) - 2)
    compared = {name: _compared(x, terms[name], name, flight, slower) for name, x in logged.items()}
    slewed = 0.0 if flight.slewed is None else float(1 - np.mean(flight.slewed))
    return LawCheck(compared, late, slewed=slewed)


def _late_by(flight: FlightChannels, late: float) -> Samples:
    """What was injected, when it acts."""
    assert flight.injected is not None
    time = flight.dt * np.arange(flight.count)
    return np.interp(time - late, time, flight.injected)


def _rounding_error(signal: Samples, step: float, random: np.random.Generator) -> Samples:
    """Other values that would be logged as these: the same one while the log keeps a number."""
    if step == 0:
        return np.zeros_like(signal)
    runs = np.cumsum(np.concatenate([[0], np.diff(np.rint(signal / step)) != 0]))
    return step * random.uniform(-0.5, 0.5, runs[-1] + 1)[runs]


def _compared(
    logged: Samples, replayed: Float[np.ndarray, "samples copies"], name: str,
    flight: FlightChannels, slower: float,
) -> TermReplay:  # fmt: skip
    """Of I what it grows by from start to start; of the rest what is below a tenth of the rate."""
    anchored, step = "I" in flight.terms, flight.resolution[1]
    passed = _grown(flight.dt) if anchored and name == "I" else _filtered(flight.dt, not anchored)
    x, copies = passed(logged), passed(replayed)
    rms = lambda x: float(np.sqrt(np.mean(x**2)))
    first, others = copies[:, 0], copies[:, 1:]
    of_log = rms(passed(_rounding_error(logged, step, np.random.default_rng(1))))
    rounding = float(np.hypot(rms(others - first[:, None]), of_log))
    left = np.sqrt(max(rms(x - first) ** 2 - rounding**2, 0.0))
    power = max(float(first @ first), 1e-300)
    independent = max(2 * _BAND * x.size, 1.0)  # samples of a signal in this band
    error = rms(x - first) / np.sqrt(power / x.size) / np.sqrt(independent)
    return TermReplay(
        float(np.std(logged)), float(left), rounding, float(x @ first) / power, float(error), slower
    )


Passed = Callable[[np.ndarray], np.ndarray]


def _filtered(dt: float, drifts: bool) -> Passed:
    """Below a tenth of the log's rate; what drifts freely without its slow part."""
    from scipy.signal import butter, sosfiltfilt

    band = [_SLOWEST, _BAND / dt] if drifts else _BAND / dt
    sections = butter(3, band, "bandpass" if drifts else "lowpass", fs=1 / dt, output="sos")
    return lambda x: sosfiltfilt(sections, x, axis=0)[max(1, round(_SETTLED / dt)) :]


def _grown(dt: float) -> Passed:
    """By how much since its last start."""
    every = max(1, round(_WINDOW / dt))
    return lambda x: (x - x[every * (np.arange(len(x)) // every)])[every:]
