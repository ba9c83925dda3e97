"""Gains of a firmware's rate loop over the plants that a fit leaves uncertain, and what they give.

P, I and D enter a rate loop's response one by one as factors, and the identified plant under a held
command has a closed form: a design is a search over three numbers, and no flight is simulated.
Source: docs/autopilots.md.
"""

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Complex, Float

from jaxquad._core import Number
from jaxquad.control.autopilots import (
    ArduPilotRate,
    BetaflightPID,
    Firmware,
    firmware_of,
    Parameter,
    PARAMETERS,
    PX4Rate,
    store_parameters,
    without_gyro_filters,
)
from jaxquad.identify import draw_models, Fit
from jaxquad.records import AXES


RateLaw = BetaflightPID | PX4Rate | ArduPilotRate
Gains = Float[np.ndarray, "designs gains"]
FIELDS = ("p", "i", "d")
_LOWEST = 0.05  # rad/s, below which only the integrals count
_FREQUENCIES = 300
_POINTS, _LEVELS, _NARROWED = 7, 6, 0.4  # of the search, along each gain and one after the other
_RESERVE = 0.97  # of the limit, because fresh plants reach further than those that were tuned on


class LoopQualities(NamedTuple):
    """What gains give, for each design and plant.

    **Attributes:**

    - `stable`: by Nyquist's criterion on the sampled loop.
    - `peak`: Ms; `resonance`: of the response from set-point to rate, without feed-forward.
    - `crossover`: the highest frequency with |L| = 1, in rad/s.
    - `rejection`: root of the integrated square of the rate after a step of torque, relative.
    - `noise`: rms of the command of white noise before the gyro's filters, relative.
    """

    stable: Bool[np.ndarray, "designs plants"]
    peak: Float[np.ndarray, "designs plants"]
    resonance: Float[np.ndarray, "designs plants"]
    crossover: Float[np.ndarray, "designs plants"]
    rejection: Float[np.ndarray, "designs plants"]
    noise: Float[np.ndarray, "designs plants"]


@dataclasses.dataclass(frozen=True)
class RateLoops:
    """The open rate loops of one axis for all plants, on a grid of frequencies.

    **Attributes:**

    - `omega`: rad/s.
    - `feedback`: of the law, from the rate to minus the command, per unit of P, I and D.
    - `ahead`: likewise from the set-point to the command.
    - `plants`: from the command to the logged rate in rad/s, the hold included.
    - `noise`: magnitude of the gyro's filters, which the logged noise has passed.
    - `ceiling`: by which factor D can rise in flight (D_MAX); 1 where it cannot.
    """

    omega: Float[np.ndarray, " frequencies"]
    feedback: Complex[np.ndarray, "gains frequencies"]
    ahead: Complex[np.ndarray, "gains frequencies"]
    plants: Complex[np.ndarray, "plants frequencies"]
    noise: Float[np.ndarray, " frequencies"]
    ceiling: float = 1.0

    def joined(self, others: "RateLoops", gains: Gains, count: int) -> "RateLoops":
        """With the plants of `others` that have the greatest peaks under these gains."""
        found = others.qualities(gains)
        peak = np.where(found.stable, np.maximum(found.peak, found.resonance), np.inf)
        worst = others.plants[np.argsort(peak.max(axis=0))[-count:]]
        return dataclasses.replace(self, plants=np.concatenate([self.plants, worst]))

    def qualities(self, gains: Gains) -> LoopQualities:
        """What each row of P, I and D gives; stability and Ms with D at its ceiling, too."""
        base = self._qualities(gains)
        if self.ceiling == 1:
            return base
        raised = self._qualities(gains * np.array([[1.0, 1.0, self.ceiling]]))
        return base._replace(
            stable=base.stable & raised.stable,
            peak=np.maximum(base.peak, raised.peak),
            resonance=np.maximum(base.resonance, raised.resonance),
            crossover=np.maximum(base.crossover, raised.crossover),
        )

    def _qualities(self, gains: Gains) -> LoopQualities:
        feedback = (gains @ self.feedback)[:, None]
        through = feedback * self.plants[None]
        distance = 1 + through
        phase = np.unwrap(np.angle(distance), axis=-1)
        # From -pi at the double integrator to 0; 2 pi higher for each pair of unstable poles.
        begun = phase[..., 0] - 2 * np.pi * np.round(phase[..., -1] / (2 * np.pi))
        above = np.where(np.abs(through) > 1, self.omega, 0.0)
        torque = np.abs(self.plants[None] / distance / self.omega) ** 2
        command = np.abs(feedback * self.noise / distance) ** 2
        return LoopQualities(
            begun < 0,
            1 / np.min(np.abs(distance), axis=-1),
            np.max(np.abs((gains @ self.ahead)[:, None] * self.plants / distance), axis=-1),
            np.max(above, axis=-1),
            np.sqrt(np.trapezoid(torque, self.omega, axis=-1)),
            np.sqrt(np.trapezoid(command, self.omega, axis=-1)),
        )


def make_loops(law: RateLaw, axis: int, fit: Fit, unit: str, plants: int, seed: int) -> RateLoops:
    """The loops of a flown law with so many plants drawn from a fit up to the logged rate.

    Raises ValueError where a drawn gain is not above 0.
    """
    omega = np.geomspace(_LOWEST, 0.999 * np.pi / law.dt, _FREQUENCIES)
    seen = without_gyro_filters(law)  # the logged rate is behind them: they are in the plant
    each = [_alone(seen, name) for name in FIELDS]
    ahead, back = np.stack([law_responses(one, axis, omega) for one in each], axis=1)
    per_radian = np.pi / 180 if unit == "deg/s" else 1.0
    responses = per_radian * _sampled_plants(fit, omega, law.dt, plants, seed)
    passed = np.abs(law_responses(_alone(law, "p"), axis, omega)[1] / back[0])
    return RateLoops(omega, -back, ahead, responses, passed, _ceiling(law, axis))


def _alone(law: RateLaw, name: str) -> RateLaw:
    """The law with a gain of 1, none of the other two and no feed-forward."""
    gains = {other: jnp.full_like(law.p, float(other == name)) for other in FIELDS}
    if isinstance(law, ArduPilotRate):
        none = jnp.zeros_like(law.p)
        return dataclasses.replace(law, ff=none, d_ff=none, **gains)
    ahead = "f" if isinstance(law, BetaflightPID) else "ff"
    return dataclasses.replace(law, **gains, **{ahead: jnp.zeros_like(law.p)})


def law_responses(
    law: RateLaw, axis: int, omega: Float[np.ndarray, " frequencies"]
) -> Complex[np.ndarray, "inputs frequencies"]:
    """From the set-point and from the rate, both in rad/s, to the command."""
    linear = law.linear(axis)
    A, c = np.asarray(linear.A), np.asarray(linear.C)
    into = np.stack([linear.reference_in, linear.measurement_in], axis=1)
    through = np.array([linear.reference_through, linear.measurement_through])
    z = np.exp(1j * omega * linear.dt)[:, None, None]
    inner = np.linalg.solve(z * np.eye(len(A)) - A, np.broadcast_to(into, (len(z), *into.shape)))
    return (c @ inner + through).T


def _sampled_plants(
    fit: Fit, omega: Float[np.ndarray, " frequencies"], dt: float, count: int, seed: int
) -> Complex[np.ndarray, "plants frequencies"]:
    """K e^(-delay s) / (s (lag s + 1)) behind a hold, exactly: its modified z-transform."""
    scores = np.random.default_rng(seed).standard_normal((len(fit.names), count))
    models = draw_models(fit, jnp.asarray(scores))
    wide = lambda x: np.broadcast_to(np.asarray(x, float), (count,))[:, None]
    gain, lag, delay = (wide(x) for x in (models.gain, models.lag, models.delay))
    if np.any(gain <= 0):
        raise ValueError(
            f"the gain from the command to the rate is not above 0 in {int(np.sum(gain <= 0))} of "
            f"{count} plants drawn from the fit: check the sign of the input, or fly more "
            "excitation"
        )
    lag, delay = np.maximum(lag, 1e-6), np.maximum(delay, 0.0)
    whole = np.floor(delay / dt)
    ahead = dt * (whole + 1) - delay  # from the command's arrival to the next sample
    q = np.exp(-1j * omega * dt)[None]
    steps = dt * q / (1 - q) ** 2 + (ahead - lag) / (1 - q)
    steps = steps + lag * np.exp(-ahead / lag) / (1 - np.exp(-dt / lag) * q)
    return gain * (1 - q) * q ** (whole + 1) * steps


def _ceiling(law: RateLaw, axis: int) -> float:
    if not isinstance(law, BetaflightPID) or law.d_max is None:
        return 1.0
    base, most = (float(np.broadcast_to(x, (3,))[axis]) for x in (law.d, law.d_max.ceiling))
    return max(1.0, most / base) if base > 0 else 1.0


def gains_of(law: RateLaw, axis: int) -> Float[np.ndarray, " gains"]:
    """P, I and D of one axis."""
    return np.array([float(np.broadcast_to(vars(law)[name], (3,))[axis]) for name in FIELDS])


class Targets(NamedTuple):
    """What a search keeps.

    **Attributes:**

    - `peak`: Ms at most; `resonance`: the peak from set-point to rate at most.
    - `noise`: of the flown gains' noise, at most.
    - `change`: factor by which a gain may rise or fall.
    - `crossover`: rad/s at most, where the identified band ends.
    """

    peak: float
    resonance: float
    noise: float
    change: float
    crossover: float


def search_gains(
    loops: RateLoops,
    flown: Float[np.ndarray, " gains"],
    targets: Targets,
    firmware: Firmware,
    axis: int,
) -> Float[np.ndarray, " gains"]:
    """The stored gains that reject torque best within the targets, on all plants of `loops`.

    Gains of 0 stay. Where nothing keeps the targets, the gains that come nearest.
    """
    free = np.flatnonzero(flown > 0)
    rows = [_row(firmware, axis, FIELDS[k]) for k in free]
    least = np.array([max(row.low, 1e-9) for row in rows])
    most = np.array([row.high for row in rows])
    low = np.clip(flown[free] / targets.change, least, most)
    high = np.clip(flown[free] * targets.change, least, most)
    score = _Score(loops, flown, free, targets)
    middle, half = np.log(low * high) / 2, np.log(high / low) / 2
    for _ in range(_LEVELS):
        axes = [
            np.clip(np.linspace(m - h, m + h, _POINTS), np.log(a), np.log(b))
            for m, h, a, b in zip(middle, half, low, high, strict=True)
        ]
        points = np.stack([x.ravel() for x in np.meshgrid(*axes, indexing="ij")], axis=1)
        middle, half = points[np.argmin(score(np.exp(points)))], _NARROWED * half
    stored = _stored_near(np.exp(middle), rows, low, high)
    gains = flown.copy()
    gains[free] = stored[np.argmin(score(stored))]
    return gains


class _Score:
    """What is least for the best design; designs beyond a target come after all that keep them."""

    def __init__(self, loops: RateLoops, flown: np.ndarray, free: np.ndarray, targets: Targets):
        self.loops, self.flown, self.free, self.targets = loops, flown, free, targets
        self.noise = loops.qualities(flown[None]).noise

    def __call__(self, points: Gains) -> Float[np.ndarray, " designs"]:
        gains = np.tile(self.flown, (len(points), 1))
        gains[:, self.free] = points
        parts = np.array_split(gains, max(1, len(gains) // 64))
        return np.concatenate([self._of(part) for part in parts])

    def _of(self, gains: Gains) -> Float[np.ndarray, " designs"]:
        found, targets = self.loops.qualities(gains), self.targets
        beyond = np.stack([
            np.max(found.peak, axis=1) / (_RESERVE * targets.peak),
            np.max(found.resonance, axis=1) / (_RESERVE * targets.resonance),
            np.mean(found.noise / self.noise, axis=1) / targets.noise,
            np.max(found.crossover, axis=1) / targets.crossover,
        ]).max(axis=0)  # fmt: skip
        beyond = np.where(np.all(found.stable, axis=1), beyond, 1e6 * beyond)
        rejection = np.sqrt(np.mean(found.rejection**2, axis=1))
        return np.where(beyond <= 1, rejection, 1e9 * beyond)


def _row(firmware: Firmware, axis: int, field: str) -> Parameter:
    rows = PARAMETERS[firmware].values()
    return next(row for row in rows if row.field == field and row.axis == axis)


def _stored_near(
    gains: np.ndarray, rows: Sequence[Parameter], low: np.ndarray, high: np.ndarray
) -> Gains:
    """The whole numbers, or numbers of three digits, around some gains, from `low` to `high`."""
    around = []
    for value, row, least, most in zip(gains, rows, low, high, strict=True):
        step = 1.0 if row.whole else 10 ** (np.floor(np.log10(value)) - 2)
        pair = np.round(np.array([np.floor(value / step), np.ceil(value / step)]) * step, 12)
        inside = (pair >= least * (1 - 1e-9)) & (pair <= most * (1 + 1e-9))
        around.append(np.unique(pair[inside] if inside.any() else pair))
    return np.array(list(itertools.product(*around)))


def parameters_of(law: RateLaw, axis: int, gains: Float[np.ndarray, " gains"]) -> dict[str, float]:
    """The parameters that stand for these gains; a ceiling of D rises with D."""
    firmware = firmware_of(law)
    flown = gains_of(law, axis)
    found = {
        _row(firmware, axis, name).name: float(gain)
        for name, gain, old in zip(FIELDS, gains, flown, strict=True)
        if old > 0
    }
    if (ceiling := _ceiling(law, axis)) > 1:
        found[f"d_max_{AXES[axis]}"] = ceiling * float(gains[2])
    return store_parameters(firmware, found)


def ceiling_in(law: RateLaw, axis: int, designs: Sequence[Mapping[str, Number]]) -> float:
    """The most by which D can rise in flight under one of these stored sets of parameters."""
    flown = _ceiling(law, axis)
    pairs = [(each.get(f"d_max_{AXES[axis]}"), gains_in(law, axis, each)[2]) for each in designs]
    return max([flown, *(float(top / base) for top, base in pairs if top and base > 0)])


def gains_in(
    law: RateLaw, axis: int, parameters: Mapping[str, Number]
) -> Float[np.ndarray, " gains"]:
    """P, I and D of parameters; those that are not named stay."""
    firmware, gains = firmware_of(law), gains_of(law, axis)
    for k, name in enumerate(FIELDS):
        gains[k] = parameters.get(_row(firmware, axis, name).name, gains[k])
    return gains


class Stage(NamedTuple):
    """What gains give on fresh plants.

    **Attributes:**

    - `gains`: P, I and D.
    - `stable`: share of the plants; `peak`, `resonance`: the greatest of them.
    - `crossover`: their median in rad/s.
    - `rejection`, `noise`: relative to what flew.
    """

    gains: tuple[float, ...]
    stable: float
    peak: float
    resonance: float
    crossover: float
    rejection: float
    noise: float


def certify_gains(loops: RateLoops, designs: Sequence[np.ndarray]) -> list[Stage]:
    """What each of the designs gives, the first of which is what flew."""
    found = loops.qualities(np.array(designs))
    rms = lambda x: np.sqrt(np.mean(x**2, axis=1))
    rejection, noise = rms(found.rejection), rms(found.noise)
    return [
        Stage(
            tuple(map(float, gains)),
            float(np.mean(found.stable[k])),
            float(np.max(found.peak[k])),
            float(np.max(found.resonance[k])),
            float(np.median(found.crossover[k])),
            float(rejection[k] / rejection[0]),
            float(noise[k] / noise[0]),
        )
        for k, gains in enumerate(designs)
    ]
