"""A logged flight again: the law's terms, the whole loop in time, and its response to set-points.

What is not linear in a law, such as a relaxed or limited integral, is in its equations and so in
its replay. Source: docs/autopilots.md, "Which gains flew".
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree

from jaxquad._core import plain_content
from jaxquad.control import LinearController, LinearisableController, Setpoint
from jaxquad.identify import (
    as_sampled,
    filter_response,
    Fit,
    KnownFilter,
    MISFIT,
    model_response,
    usable,
)
from jaxquad.models import LaggedIntegrator
from jaxquad.records import Record, select
from jaxquad.spectra import frequency_response, FrequencyResponse, LocalPolynomial

from ._law import FlownLoop, linear_responses


Samples = Float[Array | np.ndarray, "samples axes"]
Series = Float[Array | np.ndarray, " samples"]
_BLOCK = 1 << 15  # samples of the loop: programs of other lengths would be compiled anew


class _Row(NamedTuple):
    """What a law sees at one sample of the loop, and where its integral begins anew."""

    setpoint: Array
    speed: Array
    rate: Array
    moment: tuple[Array, ...]  # of `FlownLoop.at_moment`
    integral: Array
    anew: Array


def replay_terms(
    flown: FlownLoop, setpoint: Samples, gyro: Samples, throttle: Series, *, dt: float,
    feed_forward: Samples | None = None, integral: Samples | None = None,
    mixer_range: Series | None = None, late: float = 0.0, restart: float = 0.5,
) -> dict[str, Float[np.ndarray, "samples axes"]]:  # fmt: skip
    """P, I, D and F of a log again, from its set-point and its filtered gyro.

    The law runs at the loop's rate; between the samples of the log its signals are taken as
    straight. A log rounds them, and the integral of what is lost drifts away: with `integral`, the
    I term of the log, it starts anew from the log every `restart` seconds. Filters start at rest.

    **Arguments:**

    - `flown`: of the log's parameters, `betaflight_loop`, `px4_loop` or `ardupilot_loop`.
    - `setpoint`, `gyro`: in rad/s; `gyro` as it was logged, behind the gyro's filters.
    - `throttle`: 0 to 1; `dt`: the interval of the log in s.
    - `feed_forward`: the logged F of Betaflight, which takes it from the sticks between their
        samples and raises D by its speed; None takes the slope of the set-point.
    - `integral`: the logged I term; None lets the integral run freely from 0.
    - `mixer_range`: highest less lowest motor over the mixer's range, which until Betaflight 4.5
        slows the integral.
    - `late`: s after its stamp at which the set-point acts; `restart`: in s.

    **Returns:** the terms "P", "I", "D" and "F" in the firmware's units, at the log's samples.

    **Raises:**

    - `ValueError`: the log's interval is below the loop's.
    """
    if dt < 0.5 * flown.law.dt:
        raise ValueError(
            f"the log's interval is {dt:g} s, below the loop's {flown.law.dt:g} s: read "
            "the log at the loop's rate or below"
        )
    grid = _Grid(flown, len(setpoint), dt)
    rows = grid.rows(
        setpoint, throttle, late, feed_forward, grid.fine(gyro), mixer_range, integral, restart
    )
    behind = dataclasses.replace(flown, law=flown.law.without_gyro_filters())
    terms = _replayed(behind, rows)
    return {name: grid.coarse(np.asarray(term)) for name, term in terms.items()}


def fly_again(
    flown: FlownLoop, plant: LaggedIntegrator, setpoint: Series, throttle: Series, *, dt: float,
    feed_forward: Series | None = None, injected: Series | None = None, late: float = 0.0,
) -> Float[np.ndarray, " samples"]:  # fmt: skip
    """The rate before the gyro's filters that law and plant make of a logged set-point, in rad/s.

    The closed loop in time, undisturbed; `injected` is added to the command behind the law, and
    `plant` is from the held command to the rate in rad/s.
    """
    from scipy.linalg import expm

    dt_loop = flown.law.dt
    grid, column = _Grid(flown, len(setpoint), dt), lambda x: np.asarray(x)[:, None]
    added = np.zeros_like(setpoint) if injected is None else injected
    forward = None if feed_forward is None else column(feed_forward)
    rows = grid.rows(column(setpoint), throttle, late, forward, grid.fine(column(added), late))
    # Torque and rate over a sample, exactly: by the state, the command before and the one now.
    gain, lag, delay, damping = map(float, (plant.gain, plant.lag, plant.delay, plant.damping))
    lag, late_part = max(lag, 1e-3 * dt_loop), delay % dt_loop
    generator = np.zeros((3, 3))
    generator[0, 0], generator[0, 2] = -1 / lag, gain / lag
    generator[1, 0], generator[1, 1] = 1.0, -damping
    over = lambda span: expm(span * generator)
    rest = over(dt_loop - late_part)
    before = rest[:2, :2] @ over(late_part)[:2, 2]
    step = over(dt_loop)[:2, :2], before, rest[:2, 2]
    wait = max(int(np.floor(delay / dt_loop + 1e-9)), 0)
    return grid.coarse(np.asarray(_flown_again(flown, step, wait, rows))[:, 0])


class _Grid:
    """The loop's samples in the span of a log, and signals on either."""

    def __init__(self, flown: FlownLoop, count: int, dt: float):
        self.flown, self.log, self.interval = flown, dt * np.arange(count), flown.law.dt
        size = int(np.floor(self.log[-1] / self.interval + 1e-6)) + 1
        self.loop = self.interval * np.arange(size)

    def fine(self, signal: Samples | Series, late: float = 0.0) -> np.ndarray:
        """At the loop's samples; what is `late` acts so long after its stamp."""
        return _straight(self.loop - late, self.log, np.asarray(signal, float))

    def coarse(self, signal: np.ndarray) -> np.ndarray:
        """At the log's samples, of a series that may have been padded."""
        return _straight(self.log, self.loop, signal[: self.loop.size])

    def rows(
        self, setpoint: Samples, throttle: Series, late: float, feed_forward: Samples | None,
        rate: np.ndarray, mixer_range: Series | None = None, integral: Samples | None = None,
        restart: float = 1.0,
    ) -> "_Row":  # fmt: skip
        """What the law sees, up to a whole number of blocks by the last samples."""
        flown, r = self.flown, self.fine(setpoint, late)
        speed = np.diff(r, axis=0, prepend=r[:1]) / self.interval
        if feed_forward is not None:
            speed = flown.setpoint_speed(speed, self.fine(feed_forward))
        mixed = None if mixer_range is None else self.fine(mixer_range, self.interval)
        moments = flown.moments(self.fine(throttle), self.fine(throttle, self.interval), mixed)
        start, anew = np.zeros_like(r), np.zeros(len(r), bool)
        if integral is not None:
            start = self.fine(integral, self.interval)  # what the law adds to at this sample
            anew = np.arange(len(r)) % max(1, round(restart / self.interval)) == 0
        more = -(-len(r) // _BLOCK) * _BLOCK - len(r)
        pad = lambda x: jnp.asarray(np.concatenate([x, np.repeat(x[-1:], more, axis=0)]))
        return _Row(*jax.tree.map(pad, (r, speed, rate, moments, start, anew)))


def _straight(at: np.ndarray, time: np.ndarray, signal: np.ndarray) -> np.ndarray:
    return np.apply_along_axis(lambda column: np.interp(at, time, column), 0, signal)


@eqx.filter_jit
def _replayed(flown: FlownLoop, rows: _Row):
    zero = jnp.zeros_like(rows.rate[0])

    def sample(memory, row: _Row):
        memory = {**memory, "integral": jnp.where(row.anew, row.integral, memory["integral"])}
        reference = Setpoint(row.setpoint, row.speed, zero)
        memory, _, terms = flown.at_moment(*row.moment).advance(memory, zero, reference, row.rate)
        return memory, terms

    return jax.lax.scan(sample, flown.law.rest(zero), rows)[1]


@eqx.filter_jit
def _flown_again(flown: FlownLoop, step: tuple[Array | np.ndarray, ...], wait: int, rows: _Row):
    zero = jnp.zeros_like(rows.setpoint[0])
    queue = jnp.zeros((wait + 1, *zero.shape))
    matrix, before, now = map(jnp.asarray, step)

    def sample(carry, row: _Row):
        memory, state, queue = carry
        rate = state[1]
        reference = Setpoint(row.setpoint, row.speed, zero)
        memory, command, _ = flown.at_moment(*row.moment).advance(memory, zero, reference, rate)
        queue = jnp.concatenate([(command + row.rate)[None], queue])  # the newest one first
        moved = matrix @ state + jnp.outer(now, queue[-2]) + jnp.outer(before, queue[-1])
        return (memory, moved, queue[:-1]), rate

    start = (flown.law.rest(zero), jnp.zeros((2, *zero.shape)), queue)
    return jax.lax.scan(sample, start, rows)[1]


def predict_loop(
    law: LinearController,
    plant: Complex[Array | np.ndarray, "... frequencies"],
    omega: Float[Array | np.ndarray, " frequencies"],
) -> Complex[np.ndarray, "... frequencies"]:
    """The closed loop's response from set-point to measurement.

    **Arguments:**

    - `law`: of one axis, `law.linear(axis)`; of the rate, for a plant up to the rate.
    - `plant`: its response from the command to the measurement in rad or rad/s, the hold of the
        command included (`hold_response`); draws of it on leading axes.
    - `omega`: rad/s, below pi/dt.
    """
    ahead, back = linear_responses(law, np.asarray(omega))
    plant = np.asarray(plant)
    return plant * ahead / (1 - plant * back)


def hold_response(
    omega: Float[Array | np.ndarray, " frequencies"], dt: float
) -> Complex[np.ndarray, " frequencies"]:
    """Of a command that is held over samples of `dt` seconds, at `omega` in rad/s."""
    half = np.asarray(omega) * dt / 2
    return np.sinc(half / np.pi) * np.exp(-1j * half)


_CHANGE = 1e-4  # of a parameter, for slopes
_CLOSE = 0.05  # relative misfit that no pilot sees
_BLIND = 0.2  # relative error from which a response says nothing of a loop
_VAGUE = 0.1  # standard error of the gains' scale from which a log knows no gains
_FEWEST = 6  # frequencies

Frequencies = Float[np.ndarray, " frequencies"]
Response = Complex[np.ndarray, " frequencies"]


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
    fit: Fit, controller: LinearisableController,
    flown: Record | Sequence[Record] | FrequencyResponse, *,
    plant: Callable[[PyTree], PyTree] | None = None, unit: Literal["rad/s", "deg/s"] = "rad/s",
    filters: Sequence[KnownFilter] = (), axis: int = 0, band: tuple[float, float] | None = None,
) -> Reproduction:  # fmt: skip
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
    if not isinstance(controller, LinearisableController):
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
    loops = predict_loop(law, np.stack(plants), omega)
    by_gain = (predict_loop(louder, plants[0], omega) / loops[0] - 1) / _CHANGE
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
