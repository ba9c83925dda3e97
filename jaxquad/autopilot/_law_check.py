"""Whether gains, law and plant are those that flew: replayed, and flown again, on the log.

The law alone is replayed on set-point and gyro. Each term is compared with the logged one: by its
size, and by what the replay leaves of it beyond what the log's rounding explains. Then law and
plant are simulated in time, undisturbed. Source: docs/autopilots.md, "Which gains flew".
"""

import dataclasses
from collections.abc import Mapping
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad._core import plain_content
from jaxquad.identify import filter_response, MISFIT, usable
from jaxquad.plot import FlownAgain
from jaxquad.records import Record
from jaxquad.spectra import frequency_response, JointInputOutput, LocalPolynomial

from ._flight_channels import FlightChannels, FlownAutopilot, IdentifiedPlant
from ._law import FlownLoop, pick_axis
from ._replay import fly_again, replay_terms


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
    """One term of the law beside the logged one; root mean squares in the firmware's unit."""

    rms: float  # of the logged term
    left: float  # of what the replay leaves, without what rounding explains
    rounding: float  # what that explains
    size: float  # the logged term over the replayed one, by least squares
    size_error: float  # its standard error
    # Octaves by which the log is slower than a quarter of the loop's rate: what happens between its
    # samples is not in the replay.
    slower: float

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
    """The terms of the law that flew, replayed."""

    # "P", "I", "D" where they are logged, and "output", their sum with feed-forward.
    terms: Mapping[str, TermReplay]
    late: float = 0.0  # s after its stamp at which the set-point acted
    shifted: bool = False  # whether that was found in this log, and not known of the firmware
    slewed: float = 0.0  # by which a slew limiter (SMAX) lowered P and D on the average, of 1

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
        return bool(self.terms) and not self.wrong

    @property
    def text(self) -> str:
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
        terms = {name: x._asdict() | {"share": x.share} for name, x in self.terms.items()}
        return {
            "flew": self.flew,
            "text": self.text,
            "setpoint_late_s": self.late,
            "shift_found": self.shifted,
            "lowered_by_slew_limit": self.slewed,
            "terms": {name: plain_content(term) for name, term in terms.items()},
        }


def check_law(flown: FlownLoop, axis: int, flight: FlightChannels) -> LawCheck:
    """Replay the law of one axis on a flight.

    Where more than 2 % of the output are left, the set-point is tried one loop earlier and later.
    """
    law = pick_axis(flown, axis)
    stated = _checked(law, flight, flight.late)
    output = stated.terms.get("output")
    if output is None or output.share <= _SHIFTED:
        return stated
    step = flown.law.dt
    others = [_checked(law, flight, flight.late + way * step) for way in (1, -1)]
    best = min(others, key=lambda check: check.terms["output"].left)
    if best.terms["output"].left > _BETTER * output.left:
        return stated
    return dataclasses.replace(best, shifted=True)


def _checked(law: FlownLoop, flight: FlightChannels, late: float) -> LawCheck:
    logged = {name: x for name, x in flight.terms.items() if name != "F" and np.any(x)}
    logged = logged if {"P", "I"} <= set(logged) else {}  # else the output alone
    forward, output = flight.terms.get("F"), flight.output
    roundings, many = np.random.default_rng(0), 1 + _COPIES
    of_rate, of_term = flight.resolution
    copies = lambda x, step: np.stack(
        [x, *(x + _rounding_error(x, step, roundings) for _ in range(_COPIES))], axis=1
    )
    repeated = lambda x: np.repeat(x[:, None], many, axis=1)
    motors, reach = flight.motors, np.ptp(flight.motor_ends)
    terms = replay_terms(
        law, copies(flight.setpoint, of_rate), copies(flight.rates[flight.axis], of_rate),
        flight.followed, dt=flight.dt, feed_forward=None if forward is None else repeated(forward),
        integral=copies(flight.terms["I"], of_term) if "I" in flight.terms else None,
        mixer_range=None if motors is None else np.ptp(motors, axis=1) / reach, late=late,
        restart=_WINDOW,
    )  # fmt: skip
    if flight.slewed is not None:
        terms |= {name: terms[name] * flight.slewed[:, None] for name in "PD"}
    if "I" in logged and any(text.kind == "anti-gravity" for text in law.unmodelled):
        terms["I"] = repeated(logged.pop("I"))  # not judged
    if forward is not None:
        terms["F"] = repeated(forward)
    if output is not None:
        if flight.injected is not None:  # without what was injected, when it acts
            time = flight.dt * np.arange(len(flight.setpoint))
            output = output - np.interp(time - late, time, flight.injected)
        logged["output"] = output
        terms["output"] = terms["P"] + terms["I"] + terms["D"] + terms["F"]
    slower = max(0.0, float(np.log2(flight.dt / law.law.dt)) - 2)
    compared = {x: _compared(logged[x], terms[x], x, flight, slower) for x in logged}
    slewed = 0.0 if flight.slewed is None else float(1 - np.mean(flight.slewed))
    return LawCheck(compared, late, slewed=slewed)


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
    from scipy.signal import butter, sosfiltfilt

    dt, step, anchored = flight.dt, flight.resolution[1], "I" in flight.terms
    # What drifts freely is compared without its slow part.
    band, kind = (_BAND / dt, "lowpass") if anchored else ([_SLOWEST, _BAND / dt], "bandpass")
    sections = butter(3, band, kind, fs=1 / dt, output="sos")
    every = max(1, round(_WINDOW / dt))

    def passed(x: np.ndarray) -> np.ndarray:
        if anchored and name == "I":
            return (x - x[every * (np.arange(len(x)) // every)])[every:]
        return sosfiltfilt(sections, x, axis=0)[max(1, round(_SETTLED / dt)) :]

    x, copies = passed(logged), passed(replayed)
    rms = lambda x: float(np.sqrt(np.mean(x**2)))
    first, others = copies[:, 0], copies[:, 1:]
    of_log = rms(passed(_rounding_error(logged, step, np.random.default_rng(1))))
    rounding = float(np.hypot(rms(others - first[:, None]), of_log))
    left = np.sqrt(max(rms(x - first) ** 2 - rounding**2, 0.0))
    power = max(float(first @ first), 1e-300)
    independent = max(2 * _BAND * x.size, 1.0)  # samples of a signal in this band
    error = rms(x - first) / np.sqrt(power / x.size) / np.sqrt(independent)
    size = float(x @ first) / power
    return TermReplay(float(np.std(logged)), float(left), rounding, size, float(error), slower)


_CLOSE = 0.1  # relative misfit of the closed loop up to which plants are believed
_BLIND = 0.25  # relative random error from which a response says nothing
_FEWEST = 6  # frequencies
_COHERENT = 0.6
_POINTS = 40
_SATURATED = 0.02  # share of samples with a motor at its limit that is worth a word
_SLEWED = 0.02  # by which a slew limiter lowered P and D, likewise
_SHOWN = 4.0  # s of the flight on the page


Frequencies = Float[np.ndarray, " frequencies"]


@dataclasses.dataclass(frozen=True)
class LoopCheck:
    """The flight again, of law and plant."""

    law: LawCheck  # alone, replayed
    omega: Frequencies  # rad/s
    measured: Complex[np.ndarray, " frequencies"]  # from the excitation to the logged rate
    error: Frequencies  # its relative random error
    predicted: Complex[np.ndarray, " frequencies"]  # likewise to the simulated one
    used: Bool[np.ndarray, " frequencies"]  # where the former is coherent
    limited: float  # share of samples with a motor at an end of its range
    plant_misfit: float  # of the plant's fit, relative to its errors
    shown: FlownAgain  # a part of the flight, of the page

    @property
    def misfit(self) -> float:
        """Root of the mean square of predicted - measured, over that of measured, where used."""
        if not self.used.any():
            return float("nan")
        off, size = (self.predicted - self.measured)[self.used], self.measured[self.used]
        return float(np.sqrt(np.mean(np.abs(off) ** 2) / np.mean(np.abs(size) ** 2)))

    @property
    def visible(self) -> bool:
        """Whether the log's own response is sharp enough to tell."""
        error = self.error[self.used]
        return error.size >= _FEWEST and float(np.median(error)) <= _BLIND

    @property
    def kind(self) -> Literal["flown", "not flown", "unknown"]:
        if not self.law.terms:
            return "unknown"
        if not self.law.flew:
            return "not flown"
        if not self.visible:
            return "unknown"
        random = float(np.sqrt(2) * np.median(self.error[self.used]))
        return "flown" if self.misfit <= max(_CLOSE, MISFIT * random) else "not flown"

    @property
    def verdict(self) -> str:
        """In words; where it misses, which part it is."""
        if not self.law.flew:
            return self.law.text
        if not self.visible:
            return (
                f"{self.law.text}; the excitation is too weak to fly the loop again: it is "
                f"coherent at {int(self.used.sum())} frequencies"
            )
        missed = f"miss the rate by {100 * self.misfit:.2g} %"
        numbers = f"law and plant, flown on the logged set-point, {missed}"
        limited = f"{100 * self.limited:.1f} % of the flight"
        if self.kind == "flown":
            often = self.limited > _SATURATED
            limits = f" (a motor was at its limit in {limited})" if often else ""
            return f"{self.law.text}; {numbers}{limits}"
        worst = int(np.argmax(np.where(self.used, np.abs(self.predicted - self.measured), 0.0)))
        at = f"most at {self.omega[worst] / (2 * np.pi):.1f} Hz"
        if self.law.slewed > _SLEWED:
            cause = (
                f"SMAX lowered P and D by {100 * self.law.slewed:.0f} % on the average, so these "
                "gains did not fly: fly with less amplitude, or with SMAX 0"
            )
        elif self.limited > _SATURATED:
            cause = f"motors were at their limits in {limited}: fly with less amplitude"
        else:
            cause = (
                f"the law is right, so it is the plant (misfit {self.plant_misfit:.2g} times its "
                "errors): fly more excitation on this axis, in calm air"
            )
        return f"{numbers}, {at}. {cause[0].upper()}{cause[1:]}"

    def content(self) -> dict[str, object]:
        parts = lambda x: {"magnitude": np.abs(x), "phase_rad": np.angle(x)}
        return plain_content(
            {
                "kind": self.kind,
                "verdict": self.verdict,
                "law": self.law.content(),
                "misfit": self.misfit,
                "motors_limited": self.limited,
                "plant_misfit_over_errors": self.plant_misfit,
                "omega": self.omega,
                "used": self.used.tolist(),
                "measured": parts(self.measured),
                "measured_error": self.error,
                "predicted": parts(self.predicted),
            }
        )


def check_loop(plant: IdentifiedPlant, flown: FlownAutopilot) -> LoopCheck:
    """Replay the law, and fly the loop again on the excitation that the log holds."""
    flight = flown.flight
    assert flight is not None
    law = check_law(flown.loop, flown.axis, flight)
    forward, injected = flight.terms.get("F"), flight.injected
    added = flight.not_carried if injected is None else injected
    per_radian = np.pi / 180 if plant.records[0].output_units[0] == "deg/s" else 1.0
    model = dataclasses.replace(plant.fit.model, gain=per_radian * plant.fit.model.gain)
    again = fly_again(
        pick_axis(flown.loop, flown.axis), model, flight.setpoint, flight.followed,
        dt=flight.dt, late=law.late, feed_forward=forward, injected=added,
    )  # fmt: skip
    drive, count = flight.setpoint if injected is None else injected, len(again)
    time, rate = flight.start + flight.dt * np.arange(count), flight.rates[flown.axis]
    external = flight.reference
    record = Record(
        time, drive, np.stack([flight.rates[flight.axis], again], axis=1), external,
        input_names=["drive"], output_names=["logged", "again"],
        reference_names=None if external is None else ["excitation"],
    )  # fmt: skip
    low, high = plant.band
    omega = np.geomspace(low, min(high, 0.4 * 2 * np.pi / flight.dt), _POINTS)
    estimator = LocalPolynomial() if external is None else JointInputOutput()
    response = frequency_response(record, omega, estimator=estimator)
    omega, both = np.asarray(response.omega), np.asarray(response.response)[:, :, 0]
    used = np.asarray(usable(response, None, _COHERENT))[:, 0, 0]
    # The part with the most excitation, through the gyro's filters as the log has it.
    size = min(int(_SHOWN / flight.dt), count)
    power = np.cumsum(np.concatenate([[0.0], (drive - drive.mean()) ** 2]))
    start = int(np.argmax(power[size:] - power[:-size]))
    part = slice(start, start + size)
    all_omega = 2 * np.pi * np.fft.rfftfreq(2 * count, flight.dt)
    limited = np.minimum(all_omega, 0.499 * 2 * np.pi / flown.law.dt)
    passed = filter_response(flown.filters, limited)
    behind = np.fft.irfft(np.fft.rfft(again, 2 * count) * passed, 2 * count)
    return LoopCheck(
        law, omega, both[:, 0], np.asarray(response.random_error)[:, 0, 0],
        both[:, 1] * filter_response(flown.filters, omega),
        used & np.isfinite(both).all(axis=1), float(np.mean(flight.limited)),
        float(np.sqrt(plant.fit.chi_squared)),
        FlownAgain(time[part], flight.setpoint[part], rate[part], behind[part]),
    )  # fmt: skip
