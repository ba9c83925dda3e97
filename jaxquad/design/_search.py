"""Powers and phases in turn: which power is best depends on the crest factors of the phases."""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Complex, Float

from ._criteria import Criterion
from ._phases import least_peak_phases, peaks
from ._powers import certify, optimal_powers, Powers


class Limits(NamedTuple):
    """Signals made from the input by a filter each, and the peaks that they may have."""

    names: tuple[str, ...]
    filters: Complex[np.ndarray, "limits frequencies"]
    peaks: Float[np.ndarray, " limits"]

    def costs(self, crest: Float[np.ndarray, " limits"]) -> Float[np.ndarray, "limits frequencies"]:
        """Share of each limit that unit mean square at a line takes, at these crest factors."""
        return np.abs(self.filters) ** 2 * (crest / self.peaks)[:, None] ** 2


def gather_limits(
    omega: Float[np.ndarray, " frequencies"],
    responses: Sequence[Complex[np.ndarray, "frequencies outputs"]],
    amplitude: float | int,
    rate: float | int | None,
    output_amplitude: float | int | Sequence[float] | None,
) -> Limits:
    """The limits that are asked for; an output's holds for every model of an ensemble."""
    names, filters, peaks = ["amplitude"], [np.ones(omega.size, complex)], [amplitude]
    if rate is not None:
        names, filters, peaks = [*names, "rate"], [*filters, 1j * omega], [*peaks, rate]
    outputs = responses[0].shape[1]
    for o, peak in enumerate(_per_output(output_amplitude, outputs)):
        for m, response in enumerate(responses):
            if peak < np.inf:
                which = f" {o}" if outputs > 1 else ""
                names.append(f"output{which}" + (f", model {m}" if len(responses) > 1 else ""))
                filters.append(response[:, o])
                peaks.append(peak)
    for name, peak in zip(names, peaks, strict=True):
        if not 0 < peak < np.inf:
            raise ValueError(f"the limit of {name} is {peak}: it has to be positive and finite")
    return Limits(tuple(names), np.array(filters), np.array(peaks, float))


def _per_output(limit: float | int | Sequence[float] | None, outputs: int) -> list[float]:
    if limit is None:
        return [np.inf] * outputs
    given = [float(limit)] * outputs if isinstance(limit, int | float) else list(limit)
    if len(given) != outputs:
        raise ValueError(
            f"output_amplitude has {len(given)} values for {outputs} outputs: give one for each, "
            "inf where there is no limit"
        )
    return given


_CREST = 1.5  # before phases are known
_ROUNDS = 2  # of powers, phases, and the crest factors that they have
_FAINT = 3e-3  # power, to that of the strongest line in its share of the limits, that is left out

Lines = Float[np.ndarray, " frequencies"]


class Plan(NamedTuple):
    """What a design may use and what it is for."""

    omega: Lines  # rad/s
    orders: np.ndarray
    samples: int  # of a period
    names: tuple[str, ...]
    per_power: Float[np.ndarray, "models frequencies parameters parameters"]
    limits: Limits
    criterion: Criterion


class Trial(NamedTuple):
    """Lines scaled to the limits by their actual peaks."""

    power: Lines
    phase: Lines
    peaks: Float[np.ndarray, " limits"]  # to their limits
    dispersion: Lines
    efficiency: float
    value: float  # log information
    lines: int


def search(plan: Plan, lines: tuple[int, ...], seed: int) -> Trial:
    """The most informative trial, over the least numbers of `lines` and some rounds of each."""
    trials = []
    for least in lines:
        crest = np.full(plan.limits.peaks.size, _CREST)
        for _ in range(_ROUNDS):
            trial, crest = _trial(plan, least, crest, seed)
            trials.append(trial)
    return max(trials, key=lambda trial: trial.value)


def _trial(
    plan: Plan, lines: int, crest: Float[np.ndarray, " limits"], seed: int
) -> tuple[Trial, Float[np.ndarray, " limits"]]:
    """One design for these crest factors, and those that it has."""
    costs, problem = plan.limits.costs(crest), jnp.asarray(plan.per_power)
    share = jnp.asarray(1 / lines, dtype=problem.dtype)
    found = optimal_powers(problem, jnp.asarray(costs), plan.criterion, plan.names, share)
    power = _without_faint(np.asarray(found.power), costs)
    phase = least_peak_phases(plan.orders, _signals(plan, power), seed=seed)
    reached = peaks(plan.orders, phase, _signals(plan, power))
    power, reached = power / reached.max() ** 2, reached / reached.max()
    crest = reached / np.sqrt(0.5 * np.sum(np.abs(_signals(plan, power)) ** 2, axis=1))
    proof = certify(
        Powers(jnp.asarray(power), found.price), problem, jnp.asarray(plan.limits.costs(crest)),
        plan.criterion, plan.names, share,
    )  # fmt: skip
    dispersion = len(plan.names) * np.asarray(proof.dispersion)
    efficiency = min(1.0, float(np.exp(-np.asarray(proof.gap))))
    return Trial(power, phase, reached, dispersion, efficiency, _value(plan, power), lines), crest


def _without_faint(power: Lines, costs: Float[np.ndarray, "limits frequencies"]) -> Lines:
    share = costs.max(axis=0) * power
    return np.where(share > _FAINT * share.max(), power, 0.0)


def _signals(plan: Plan, power: Lines) -> Complex[np.ndarray, "limits frequencies"]:
    """Complex amplitudes of what is limited, in units of the limits."""
    return plan.limits.filters * np.sqrt(2 * power) / plan.limits.peaks[:, None]


def _value(plan: Plan, power: Lines) -> float:
    totals = np.einsum("f,mfpq->mpq", power, plan.per_power)
    each = [plan.criterion.log_information(jnp.asarray(m), plan.names) for m in totals]
    return float(np.mean([float(value) for value in each]))
