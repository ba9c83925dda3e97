"""Whether law and plant are the loop that flew: both flown again on the log's own set-point.

The flight is simulated in time with all of the law that is not linear, undisturbed, and compared
with the log where the excitation is coherent. Source: docs/autopilots.md, "Which gains flew".
"""

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad._core import plain_content
from jaxquad.identify import filter_response, Fit, MISFIT, usable
from jaxquad.records import Record
from jaxquad.spectra import (
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
)

from ._flight_channels import FlightChannels
from ._flown_autopilot import FlownAutopilot
from ._identified import IdentifiedPlant
from ._law import pick_axis
from ._law_check import LawCheck
from ._replay import fly_again, HeldPlant


_CLOSE = 0.1  # relative misfit of the closed loop up to which plants are believed
_BLIND = 0.25  # relative random error from which a response says nothing
_FEWEST = 6  # frequencies
_COHERENT = 0.6
_POINTS = 40
_SATURATED = 0.02  # share of samples with a motor at its limit that is worth a word
_SLEWED = 0.02  # by which a slew limiter lowered P and D, likewise
_SHOWN = 4.0  # s of the flight on the page

Samples = Float[np.ndarray, " samples"]
Frequencies = Float[np.ndarray, " frequencies"]
Kind = Literal["flown", "not flown", "unknown"]


@dataclasses.dataclass(frozen=True)
class LoopCheck:
    """The flight again, of law and plant.

    **Attributes:**

    - `law`: the law alone, replayed.
    - `omega`: rad/s; `measured`, `predicted`: responses from the excitation to the rate, of log and
        simulation; `error`: relative random error of the former; `used`: where it is coherent.
    - `limited`: share of samples with a motor at an end of its range.
    - `plant_misfit`: of the plant's fit, relative to its errors.
    - `time`, `setpoint`, `rate`, `again`: a part of the flight, in s and rad/s.
    """

    law: LawCheck
    omega: Frequencies
    measured: Complex[np.ndarray, " frequencies"]
    error: Frequencies
    predicted: Complex[np.ndarray, " frequencies"]
    used: Bool[np.ndarray, " frequencies"]
    limited: float
    plant_misfit: float
    time: Samples
    setpoint: Samples
    rate: Samples
    again: Samples

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
    def kind(self) -> Kind:
        """What the log says of law and plant together."""
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
        numbers = f"law and plant, flown on the logged set-point, miss the rate by {self._percent}"
        if self.kind == "flown":
            return f"{self.law.text}; {numbers}{self._limits}"
        worst = int(np.argmax(np.where(self.used, np.abs(self.predicted - self.measured), 0.0)))
        at = f"most at {self.omega[worst] / (2 * np.pi):.1f} Hz"
        if self.law.slewed > _SLEWED:
            cause = (
                f"SMAX lowered P and D by {100 * self.law.slewed:.0f} % on the average, so these "
                "gains did not fly: fly with less amplitude, or with SMAX 0"
            )
        elif self.limited > _SATURATED:
            cause = (
                f"motors were at their limits in {100 * self.limited:.1f} % of the flight: fly "
                "with less amplitude"
            )
        else:
            cause = (
                f"the law is right, so it is the plant (misfit {self.plant_misfit:.2g} times its "
                "errors): fly more excitation on this axis, in calm air"
            )
        return f"{numbers}, {at}. {cause[0].upper()}{cause[1:]}"

    @property
    def _percent(self) -> str:
        return f"{100 * self.misfit:.2g} %"

    @property
    def _limits(self) -> str:
        if self.limited <= _SATURATED:
            return ""
        return f" (a motor was at its limit in {100 * self.limited:.1f} % of the flight)"

    def content(self) -> dict[str, object]:
        """All numbers, for JSON."""
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
                "measured": _parts(self.measured),
                "measured_error": self.error,
                "predicted": _parts(self.predicted),
            }
        )


def _parts(response: Complex[np.ndarray, " frequencies"]) -> dict[str, object]:
    return {"magnitude": np.abs(response), "phase_rad": np.angle(response)}


def check_loop(
    found: IdentifiedPlant, flown: FlownAutopilot, flight: FlightChannels, law: LawCheck
) -> LoopCheck:
    """Fly the loop again on the excitation that the log holds."""
    forward, injected = flight.terms.get("F"), flight.injected
    added = flight.not_carried if injected is None else injected
    again = fly_again(
        pick_axis(flown.loop, flown.axis), plant_of(found.fit, _unit(found)), flight.setpoint,
        flight.followed, dt=flight.dt, late=law.late, feed_forward=forward, injected=added,
    )  # fmt: skip
    drive = flight.setpoint if injected is None else injected
    response = _responses(found, flight, drive, again)
    omega = np.asarray(response.omega)
    both = np.asarray(response.response)[:, :, 0]
    passed = filter_response(flown.filters, omega)
    used = np.asarray(usable(response, None, _COHERENT))[:, 0, 0]
    part, time = _liveliest(drive, flight.dt), flight.start + flight.dt * np.arange(len(drive))
    chain = _filtered(again, flown, flight.dt)
    return LoopCheck(
        law, omega, both[:, 0], np.asarray(response.random_error)[:, 0, 0], both[:, 1] * passed,
        used & np.isfinite(both).all(axis=1), float(np.mean(flight.limited)),
        float(np.sqrt(found.fit.chi_squared)), time[part],
        flight.setpoint[part], flight.rates[flown.axis][part], chain[part],
    )  # fmt: skip


def plant_of(fit: Fit, unit: str) -> HeldPlant:
    """The fit's plant, in rad/s^2 per unit of the command."""
    values = {name: float(np.asarray(value)) for name, value in vars(fit.model).items()}
    per_radian = np.pi / 180 if unit == "deg/s" else 1.0
    return HeldPlant(
        per_radian * values["gain"], values["lag"], values["delay"], values.get("damping", 0.0)
    )


def _unit(found: IdentifiedPlant) -> str:
    return found.records[0].output_units[0]


def _responses(
    found: IdentifiedPlant, flight: FlightChannels, drive: Samples, again: Samples
) -> FrequencyResponse:
    """From the excitation to the logged and to the simulated rate, with one estimator."""
    rate = flight.rates[flight.axis]
    external = flight.reference
    record = Record(
        flight.start + flight.dt * np.arange(len(drive)), drive, np.stack([rate, again], axis=1),
        external, input_names=["drive"], output_names=["logged", "again"],
        reference_names=None if external is None else ["excitation"],
    )  # fmt: skip
    low, high = found.band
    omega = np.geomspace(low, min(high, 0.4 * 2 * np.pi / flight.dt), _POINTS)
    estimator = LocalPolynomial() if external is None else JointInputOutput()
    return frequency_response(record, omega, estimator=estimator)


def _liveliest(drive: Samples, dt: float) -> slice:
    """The part of the flight with the most excitation."""
    size = min(int(_SHOWN / dt), len(drive))
    power = np.cumsum(np.concatenate([[0.0], (drive - drive.mean()) ** 2]))
    start = int(np.argmax(power[size:] - power[:-size]))
    return slice(start, start + size)


def _filtered(again: Samples, flown: FlownAutopilot, dt: float) -> Samples:
    """Through the gyro's filters, as the log has it."""
    omega = 2 * np.pi * np.fft.rfftfreq(2 * len(again), dt)
    limited = np.minimum(omega, 0.499 * 2 * np.pi / flown.law.dt)
    passed = filter_response(flown.filters, limited)
    return np.fft.irfft(np.fft.rfft(again, 2 * len(again)) * passed, 2 * len(again))[: len(again)]
