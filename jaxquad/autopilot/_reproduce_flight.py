"""Whether a controller and a plant are the loop that flew: predicted and measured r -> y."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal, Protocol, runtime_checkable

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Complex, Float, PyTree

from jaxquad._core import plain_content
from jaxquad.control import LinearController
from jaxquad.identify import (
    as_sampled,
    filter_response,
    Fit,
    KnownFilter,
    MISFIT,
    model_response,
    usable,
)
from jaxquad.records import Record, select
from jaxquad.spectra import frequency_response, FrequencyResponse, LocalPolynomial

from ._replay import predict_loop


_CHANGE = 1e-4  # of a parameter, for slopes
_CLOSE = 0.05  # relative misfit that no pilot sees
_BLIND = 0.2  # relative error from which a response says nothing of a loop
_VAGUE = 0.1  # standard error of the gains' scale from which a log knows no gains
_FEWEST = 6  # frequencies

Frequencies = Float[np.ndarray, " frequencies"]
Response = Complex[np.ndarray, " frequencies"]


@runtime_checkable
class FlownController(Protocol):
    """A controller with a linear form, as those of `jq.autopilot` are."""

    def linear(self, axis: int = 0) -> LinearController:
        """One axis, for small signals."""
        ...


class Reproduction(eqx.Module):
    """The response from set-point to rate: measured, and predicted of a controller and a plant.

    Both have relative standard errors (of magnitude, and in rad).
    """

    omega: Frequencies  # rad/s
    measured: Response
    measured_error: Frequencies  # by the noise of the record
    predicted: Response
    predicted_error: Frequencies  # by the covariance of the fit
    used: Bool[np.ndarray, " frequencies"]
    # The factor on the controller's gains with which the prediction comes nearest, 1 if they flew.
    scale: float
    scale_error: float  # standard error
    plant_misfit: float = 1.0  # of the plant's fit, relative to its errors

    @property
    def misfit(self) -> float:
        """Root of the mean square of measured / predicted - 1, at the frequencies used."""
        if not self.used.any():
            return float("nan")
        return float(np.sqrt(np.mean(np.abs(self._off[self.used]) ** 2)))

    @property
    def ratio(self) -> float:
        """The misfit relative to its errors, each point by its own: about 1 for the right loop."""
        if not self.used.any():
            return float("nan")
        variance = 2 * (self.measured_error**2 + self.predicted_error**2)
        return float(np.sqrt(np.mean((np.abs(self._off) ** 2 / variance)[self.used])))

    @property
    def kind(self) -> Literal["flown", "not flown", "unknown"]:
        """What the record says of the loop."""
        error = np.hypot(self.measured_error, self.predicted_error)[self.used]
        if error.size < _FEWEST or np.median(error) > _BLIND or self.scale_error > _VAGUE:
            return "unknown"
        near = self.ratio <= MISFIT or self.misfit <= _CLOSE
        steady = abs(self.scale - 1) <= max(_CLOSE, 3 * self.scale_error)
        return "flown" if near and steady else "not flown"

    @property
    def verdict(self) -> str:
        """In words."""
        if self.kind == "unknown":
            error = np.hypot(self.measured_error, self.predicted_error)[self.used]
            size = f", and its error is {100 * np.median(error):.0f} %" if error.size else ""
            return (
                f"this log cannot tell which gains flew: the response from set-point to rate is "
                f"usable at {error.size} frequencies{size}; fly a chirp or more stick on this axis"
            )
        numbers = (
            f"{100 * self.misfit:.2g} % off (root mean square), {self.ratio:.2g} times the errors"
        )
        if self.kind == "flown":
            return f"the loop of these gains is the one that flew: {numbers}"
        if self.plant_misfit > MISFIT:
            return (
                f"the loop of these gains is {numbers}, but the plant's own fit misses by "
                f"{self.plant_misfit:.2g} times its errors, so this does not say that other gains "
                "flew; fly a chirp of the rate set-point, or strong and quick stick on this axis, "
                "for 20 s or more"
            )
        worst = int(np.argmax(np.where(self.used, np.abs(self._off), 0.0)))
        return (
            f"the loop of these gains is not the one that flew: {numbers}, most at "
            f"{self.omega[worst] / (2 * np.pi):.1f} Hz; nearest with all gains times "
            f"{self.scale:.2f} +- {1.96 * self.scale_error:.2g} (95 %). Check profile, filters, "
            "throttle and parameters changed in flight before these gains are changed"
        )

    def to_dict(self) -> dict[str, object]:
        """All numbers as JSON holds them."""
        parts = lambda x, error: {
            "magnitude": np.abs(x), "phase_rad": np.angle(x), "error": error,
        }  # fmt: skip
        content = {
            "kind": self.kind,
            "verdict": self.verdict,
            "misfit": self.misfit,
            "misfit_over_errors": self.ratio,
            "plant_misfit_over_errors": self.plant_misfit,
            "gain_scale": self.scale,
            "gain_scale_standard_error": self.scale_error,
            "omega": self.omega,
            "used": self.used.tolist(),
            "measured": parts(self.measured, self.measured_error),
            "predicted": parts(self.predicted, self.predicted_error),
        }
        return plain_content(content)

    def __str__(self) -> str:
        return self.verdict

    @property
    def _off(self) -> Response:
        return self.measured / self.predicted - 1


def reproduce_flight(
    fit: Fit,
    controller: FlownController,
    flown: Record | Sequence[Record] | FrequencyResponse,
    *,
    plant: Callable[[PyTree], PyTree] | None = None,
    unit: Literal["rad/s", "deg/s"] = "rad/s",
    filters: Sequence[KnownFilter] = (),
    axis: int = 0,
    band: tuple[float, float] | None = None,
) -> Reproduction:
    """Compare the closed loop that a controller and an identified plant predict with a record.

    A plant, gains and filters that do not reproduce the response that was flown are no basis for
    others. The errors of both count as independent, which is cautious where the plant is of the
    same record. Its `verdict` is in words. Source: docs/autopilots.md.

    **Arguments:**

    - `fit`: of the plant, from the controller's command to the rate before its filters.
    - `controller`: as flown, with `linear()`; set-points and rates in rad/s.
    - `flown`: a record whose first reference is the set-point and whose output is the rate, in one
        unit, or its response from set-point to rate.
    - `plant`: from the fit's model to the plant, such as `lambda m: m.at(1)` for a level of
        `jq.identify.gain_over_throttle`.
    - `unit`: of the rate in the fit.
    - `filters`: those that the rate passed before it was logged, if the plant is without them. A
        plant that contains them goes with the law's `without_gyro_filters()`.
    - `axis`: of the controller.
    - `band`: (low, high) in rad/s; by default where the response is coherent.

    **Raises:**

    - `ValueError`: the controller has no linear form, or the record no reference.
    """
    if not isinstance(controller, FlownController):
        raise ValueError(
            f"the controller is a {type(controller).__name__}: give one with a method linear(), "
            "such as jq.autopilot.BetaflightPID"
        )
    if not isinstance(flown, FrequencyResponse):
        records = [flown] if isinstance(flown, Record) else list(flown)
        if not records or not all(x.reference_names for x in records):
            raise ValueError(
                "the record has no reference: give the set-point of the rate loop as references="
            )
        closed = [
            select(x, inputs=x.reference_names[0], outputs=x.output_names[0]) for x in records
        ]
        low, high = band or (2 * np.pi * 0.7, 2 * np.pi * min(60.0, records[0].sample_rate / 8))
        lines = np.geomspace(low, high, 50)
        flown = frequency_response(closed, lines, estimator=LocalPolynomial())
    law, omega = controller.linear(axis), np.asarray(flown.omega)
    used = np.asarray(usable(flown, band, 0.6))[:, 0, 0]
    like = dataclasses.replace(flown, dt=law.dt, hold=law.dt)
    factor = np.pi / 180 if unit == "deg/s" else 1.0
    of_plant = lambda model: model if plant is None else plant(model)
    at = lambda model: factor * model_response(as_sampled(of_plant(model), like), omega)[:, 0, 0]
    # Slopes of ln T by relative changes of the parameters, and of all gains.
    plants = [at(fit.model)]
    for k in range(len(fit.names)):
        moved = np.array(fit.values, float)
        moved[k] += _CHANGE * fit.units[k]
        plants.append(at(fit.parameters.replace(fit.model, moved)))
    louder = dataclasses.replace(
        law,
        C=(1 + _CHANGE) * law.C,
        reference_through=(1 + _CHANGE) * law.reference_through,
        measurement_through=(1 + _CHANGE) * law.measurement_through,
    )
    loops = np.asarray(predict_loop(law, np.stack(plants), omega))
    by_gain = (np.asarray(predict_loop(louder, plants[0], omega)) / loops[0] - 1) / _CHANGE
    slopes = (loops[1:] / loops[0] - 1) / _CHANGE
    spread = np.real(np.einsum("pf,pq,qf->f", slopes.conj(), fit.relative_covariance, slopes))
    predicted = loops[0] * filter_response(filters, omega)
    measured = np.asarray(flown.response)[:, 0, 0]
    errors = np.asarray(flown.random_error)[:, 0, 0], np.sqrt(np.maximum(spread, 0.0) / 2)
    # The relative change of all gains nearest to the misfit, and its standard error.
    scale, doubt = 0.0, float("inf")
    if used.any():
        weight = 1 / (errors[0] ** 2 + errors[1] ** 2)[used]
        slope, off = by_gain[used], (measured / predicted - 1)[used]
        information = float(np.sum(weight * np.abs(slope) ** 2))
        scale = float(np.sum(weight * np.real(slope.conj() * off))) / information
        left = np.mean(weight * np.abs(off - scale * slope) ** 2) / 2
        doubt = float(np.sqrt(max(left, 1.0) / information))
    compared = omega, measured, errors[0], predicted, errors[1], used
    return Reproduction(*compared, 1 + scale, doubt, float(np.sqrt(fit.chi_squared)))
