"""Inertia by least squares: torque on acceleration, both filtered alike."""

import functools as ft
import math
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxquad._core import as_float, require_all_positive, require_positive, signal_shape

from ._lock_in import (
    AbstractInertia,
    empty_past,
    LastEstimate,
    motion,
    NoProbe,
    Past,
    ProbeState,
    ProbeTones,
)
from ._protocols import Signal


Terms = Float[Array, " signals axes *ensemble"]
NUISANCES = ("offset", "rate", "angle")


class Sums(NamedTuple):
    """Weighted sums over the samples: products of the terms, and the scatter of the score."""

    products: Float[Array, " signals signals axes *ensemble"]
    recent: Signal  # scores of the last moment
    scatter: Signal  # long-run variance of the sum of scores


class Solution(NamedTuple):
    """A regression solved for the inertia alone."""

    inertia: Signal  # kg m^2
    variance: Signal  # (kg m^2)^2
    weight: Signal  # samples that count
    informed: Signal  # 1 where the acceleration stands out


def _inverse(x, safe):
    return jnp.where(safe, 1 / jnp.where(safe, x, 1), 0)


class FilterState(NamedTuple):
    past: Past
    stages: tuple[Float[Array, " signals axes *ensemble"], ...]


def has_settled(terms: Float[Array, " signals axes *ensemble"]) -> Signal:
    """1 once the filter has forgotten its start, 0 before.

    The first difference of a counted angle is wrong by up to a count per sample interval, which
    the filter takes for a jump of the rate, 0.4 rad/s on the Hover.
    """
    return (terms[0] > 0.999).astype(terms.dtype)


class AbstractRegression(AbstractInertia):
    """The options that both regressions share.

    Filtered torque is regressed on filtered acceleration beside the `nuisance` terms. Estimates
    count as informed with an acceleration of `excitation` rad/s^2 rms after the filter.

    Every term of the equation of motion passes the same discrete low-pass filter: `order` equal
    stages (1 - a) / (1 - a/z), a = exp(-bandwidth dt), so that the filtered equation is as exact as
    the sampled one. Source: Eq. (19) of the paper, discretised exactly (docs/equations.md). A
    filter of the rate under zero-order hold, q0' = bandwidth (rate - q0), would bias the inertia by
    bandwidth dt / 2.
    """

    bandwidth: Float[Array, ""] = eqx.field(converter=as_float, default=15.0, kw_only=True)  # rad/s
    order: int = eqx.field(static=True, default=3, kw_only=True)  # stages of the filter
    nuisance: tuple[str, ...] = eqx.field(static=True, default=("offset", "rate"), kw_only=True)
    tones: ProbeTones | NoProbe = eqx.field(default=NoProbe(), kw_only=True)
    excitation: float = eqx.field(static=True, default=0.02, kw_only=True)  # rad/s^2
    correlation: float = eqx.field(static=True, default=0.5, kw_only=True)  # s

    def __check_init__(self):
        require_all_positive(correlation=self.correlation)
        unknown = set(self.nuisance) - set(NUISANCES)
        if unknown or len(set(self.nuisance)) != len(self.nuisance):
            raise ValueError(
                f"nuisance is {self.nuisance}: choose each of 'offset', 'rate' and 'angle' at most "
                "once."
            )
        require_positive("bandwidth", self.bandwidth, "give rad/s, 10 for an encoder of 8192")
        if self.order not in (1, 2, 3):
            raise ValueError(
                f"order is {self.order}: filter by 1, 2 or 3 stages; behind an encoder take 3."
            )

    def _at_rest(self, like: Signal) -> tuple[FilterState, Sums]:
        signals, zero = 5 if "angle" in self.nuisance else 4, jnp.zeros_like(like)
        stage = jnp.zeros((signals, *like.shape), like.dtype)
        products = jnp.zeros((signals, signals, *like.shape), like.dtype)
        filters = FilterState(empty_past(like), (stage,) * self.order)
        return filters, Sums(products, zero, zero)

    def _filter(
        self, state: FilterState, command: Signal, measurement: Signal
    ) -> tuple[FilterState, Terms]:
        """1, rate, angle where it is a nuisance, acceleration and torque, filtered alike.

        The filtered 1 carries a constant disturbance through the start.
        """
        past, now = motion(state.past, self.torque_gain, command, measurement, self.dt)
        middle = (now.rate, now.angle) if "angle" in self.nuisance else (now.rate,)
        terms = (jnp.ones_like(measurement), *middle, now.acceleration, now.torque)
        out = now.valid * jnp.stack(terms)
        leak = -jnp.expm1(-self.bandwidth * self.dt).astype(out.dtype)
        stages = []
        for stage in state.stages:
            out = stage + leak * (out - stage)
            stages.append(out)
        return FilterState(past, tuple(stages)), out

    def _add(
        self, sums: Sums, terms: Terms, keep: Signal, last: LastEstimate
    ) -> tuple[Sums, Solution]:
        """The sums after one more sample, old ones weighted by `keep`, and what they say.

        Where the acceleration that the nuisance terms leave is below `excitation` the last inertia
        stays. The scores x e of neighbouring samples are correlated, since both are filtered: the
        variance of their sum weighs pairs of samples by (1 - dt / correlation)^|k - l|.
        """
        products = keep[None, None] * sums.products + terms[:, None] * terms[None]
        # Gauss' elimination of the nuisance terms, without pivoting, as the matrix is definite;
        # entry by entry, which compiles to one pass over the ensemble.
        a, u, eps = len(terms) - 2, len(terms) - 1, 64 * jnp.finfo(terms.dtype).eps
        left = {(i, j): products[i, j] for i in range(len(terms)) for j in range(i, len(terms))}
        now, pivots = list(terms), [NUISANCES.index(name) for name in self.nuisance]
        for n, k in enumerate(pivots):
            row = {j: left[min(j, k), max(j, k)] for j in (*pivots[n + 1 :], a, u)}
            inverse = _inverse(left[k, k], left[k, k] > eps * products[k, k])
            ratio = {j: x * inverse for j, x in row.items()}
            for i in row:
                now[i] = now[i] - ratio[i] * now[k]
            for i, j in left:
                if i in row and j in row:
                    left[i, j] = left[i, j] - ratio[i] * row[j]
        # What no nuisance term explains.
        square, product, acceleration, torque = left[a, a], left[a, u], now[a], now[u]
        weight = products[0, 0]
        floor = eps * products[-2, -2]
        informed = square > jnp.maximum(weight * self.excitation**2, floor)
        inverse = _inverse(square, informed)
        inertia = jnp.where(informed, product * inverse, last.inertia)
        score = acceleration * (torque - inertia * acceleration)
        recent = (1 - min(1.0, self.dt / self.correlation)) * keep * sums.recent
        scatter = keep**2 * sums.scatter + score * (score + 2 * recent)
        variance = jnp.maximum(scatter, 0) * inverse**2
        solved = Solution(inertia, variance, weight, informed.astype(terms.dtype))
        return Sums(products, recent + score, scatter), solved

    def probe(self, state: "WindowedState | RecursiveState") -> Signal:
        """The test signal to add to the next command."""
        return self.tones.signal(state.probe, self.dt)


class WindowedState(NamedTuple):
    filters: FilterState
    sums: Sums
    last: LastEstimate
    probe: ProbeState
    index: Int[Array, ""]  # of the sample within the window


class WindowedInertia(AbstractRegression):
    """The disturbance observer's inertia: least squares over windows, one after the other.

    Filtered torque is regressed on filtered acceleration and on the `nuisance` terms over `window`
    seconds; the estimate is held until the next window ends. Without nuisance terms this is the
    integral of the paper; a constant disturbance then biases it unless the window holds whole
    periods of the motion. The default terms, a constant and the rate, are exact for any window.
    "angle" removes a stiffness k, which one tone cannot separate from inertia: the estimate is then
    J - k / omega^2 without the term and uninformed with it.

    The standard deviation allows for residuals that are correlated over `correlation` seconds; in
    windows below some 3 s it is too small, by 1.2 to 1.7 at 1 s. It covers neither disturbances
    that feedback correlates with the acceleration, nor encoder noise in the acceleration, which
    shrinks the estimate; `jq.control.LockInInertia` suffers little from either. An estimate from
    enough excitation is trusted with a relative deviation of `trust`; while held, its relative
    deviation grows by `drift` per root second.
    Source: Eq. (15)-(24) of the paper, corrected as docs/equations.md lists:
    `jq.control.paper_inertia` is the same in the paper's symbols.

    **Arguments:**

    - `torque_gain`: in N m per unit of command; `nominal`: the design's inertia in kg m^2. Both are
        scalars, one value per axis, or `[axes, *ensemble]`.
    - `window`: in s, 50 samples or more.
    - `bandwidth`, `order`: of the filters, in rad/s and stages; an encoder needs 3 stages.
    - `nuisance`: any of "offset", "rate" and "angle".
    - `tones`: the test signal, `ProbeTones(..)`; by default none.
    - `excitation`: in rad/s^2 rms; `correlation`: in s; `trust`; `drift`: in 1/sqrt(s).
    - `dt`: in s.

    **Raises:** `ValueError`: a value is not positive, an option is unknown, or the window is too
    short.
    """

    window: float = eqx.field(static=True, default=5.0)  # s

    def __check_init__(self):
        require_all_positive(dt=self.dt, window=self.window)
        if self.samples < 50:
            raise ValueError(
                f"A window of {self.window} s holds {self.samples} samples of {self.dt} s: give "
                "it 50 or more."
            )

    @property
    def samples(self) -> int:
        return round(self.window / self.dt)

    def init(self, like: Signal) -> WindowedState:
        """Before the first sample; shaped as the measurement `like` and as the ensemble."""
        like = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        last, index = self._start(like), jnp.zeros((), jnp.int32)
        return WindowedState(*self._at_rest(like), last, self.tones.init(like), index)

    def update(self, state: WindowedState, command: Signal, measurement: Signal) -> WindowedState:
        """Add the command held during the last sample and the angle at its end."""
        filters, terms = self._filter(state.filters, command, measurement)
        sums = jax.tree.map(lambda x: jnp.where(state.index == 0, 0, x), state.sums)
        counts = has_settled(terms) * state.probe.exciting
        one = jnp.ones_like(measurement)
        sums, solved = self._add(sums, terms * counts[None], one, state.last)
        done = state.index == self.samples - 1
        renew = done & (solved.informed > 0) & (solved.weight > 0.99 * self.samples)
        age = state.last.age + self.drift**2 * self.dt
        new = LastEstimate(solved.inertia, solved.variance, jnp.zeros_like(age), solved.informed)
        last = jax.tree.map(ft.partial(jnp.where, renew), new, state.last._replace(age=age))
        probe = self.tones.step(state.probe, self._assess(last))
        return WindowedState(filters, sums, last, probe, jnp.where(done, 0, state.index + 1))


class RecursiveState(NamedTuple):
    filters: FilterState
    power: Signal  # of the filtered acceleration, (rad/s^2)^2
    sums: Sums
    last: LastEstimate
    probe: ProbeState


class RecursiveInertia(AbstractRegression):
    """Recursive least squares with exponential forgetting over `memory` seconds.

    The regression of `jq.control.WindowedInertia`, renewed every sample. Nothing is learnt or
    forgotten in the dead zone, where the filtered acceleration of the last half second is below
    `excitation` rad/s^2 rms, nor while the test tones are off; meanwhile the relative deviation
    grows by `drift` per root second. An estimate is trusted after half a `memory` of excited
    samples, with a relative deviation of `trust`.

    The standard deviation is the sandwich's: it needs no noise level and allows for residuals that
    are correlated over `correlation` seconds. In gusts it is 1.1 to 1.6 times too wide. It does not
    cover the bias by disturbances that feedback correlates with the acceleration (on the Hover 1 to
    5 % in gusts, 60 to 300 % under the paper's sine) nor by encoder noise in the acceleration (1 to
    6 % where nothing moves the counts): tests/benchmarks/inertia_study.py.
    Source: Eq. (19) and (24) of the paper, corrected; docs/control.md.

    **Arguments:** `memory`: in s, 100 samples or more. All others are those of
    `jq.control.WindowedInertia`.

    **Raises:** `ValueError`: a value is not positive, an option is unknown, or the memory is too
    short.
    """

    memory: float = eqx.field(static=True, default=3.0)  # s

    def __check_init__(self):
        require_all_positive(dt=self.dt, memory=self.memory)
        if self.memory < 100 * self.dt:
            raise ValueError(
                f"A memory of {self.memory} s is short for samples of {self.dt} s: give it "
                f"{100 * self.dt:g} s or more."
            )

    def init(self, like: Signal) -> RecursiveState:
        """Before the first sample; shaped as the measurement `like` and as the ensemble."""
        like = jnp.zeros(signal_shape(like, self.ensemble), like.dtype)
        (filters, sums), power = self._at_rest(like), jnp.zeros_like(like)
        return RecursiveState(filters, power, sums, self._start(like), self.tones.init(like))

    def update(self, state: RecursiveState, command: Signal, measurement: Signal) -> RecursiveState:
        """Add the command held during the last sample and the angle at its end."""
        filters, terms = self._filter(state.filters, command, measurement)
        power = state.power + self.dt / 0.5 * (terms[-2] ** 2 - state.power)
        excited = (power > self.excitation**2).astype(power.dtype)
        counts = excited * has_settled(terms) * state.probe.exciting
        forget = counts * (self.dt / self.memory)
        sums, solved = self._add(state.sums, terms * counts[None], 1 - forget, state.last)
        age = (1 - forget) * state.last.age + (1 - counts) * self.drift**2 * self.dt
        enough = solved.weight > -math.expm1(-0.5) * self.memory / self.dt
        informed = jnp.where(enough, solved.informed, 0)
        last = LastEstimate(solved.inertia, solved.variance, age, informed)
        probe = self.tones.step(state.probe, self._assess(last))
        return RecursiveState(filters, power, sums, last, probe)


def paper_inertia(
    q0: Float[Array, " samples"], q1: Float[Array, " samples"], *, J_n: float | Float[Array, ""],
    dt: float,
) -> Float[Array, ""]:  # fmt: skip
    """Eq. (22)-(24): the inertia in kg m^2 over one window of samples.

    J_n cancels: what is left is the regression of q1 on q0'. It is the inertia itself where the
    integrals of q0 q0' and of q0' vanish, over whole periods of a steady motion.

    **Arguments:**

    - `q0`, `q1`: Eq. (19) at the same samples: `q0` of the mean rate over the sample interval, in
        rad/s, `q1` of the mean torque over it and the one before, in N m. For torques that are held
        over each interval the estimate is then exact.
    - `J_n`: the nominal inertia in kg m^2.
    - `dt`: the sample interval in s.

    **Returns:** The estimate of J_x.
    """
    q0_dot = jnp.diff(q0) / dt
    M_c = J_n * q0_dot - q1[1:]  # (18)
    dJ = -jnp.sum(M_c * q0_dot) / jnp.sum(q0_dot**2)  # (22) summed, (23)
    return J_n + dJ  # (24)
