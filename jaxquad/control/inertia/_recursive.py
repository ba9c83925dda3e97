import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad._core import as_float, full_shape

from ._estimate import (
    doubted,
    Held,
    InertiaEstimate,
    judged,
    nothing_held,
    plant_ensemble,
    require_above_zero,
    require_plant,
)
from ._filters import FilterState, MatchedFilters, settled
from ._probe_tones import NoProbe, ProbeState, ProbeTones
from ._regression import learn, no_sums, require_nuisance, Sums


class RecursiveState(NamedTuple):
    filters: FilterState
    power: Float[Array, " axes *ensemble"]  # of the filtered acceleration, (rad/s^2)^2
    sums: Sums
    held: Held
    probe: ProbeState


class RecursiveInertia(eqx.Module):
    """Recursive least squares with exponential forgetting over `memory` seconds.

    The regression of `jq.control.WindowedInertia`, renewed every sample. Nothing is learnt or forgotten in
    the dead zone, where the filtered acceleration of the last half second is below `excitation`
    rad/s^2 rms, nor while the probe tones are off; meanwhile the estimate ages by `drift` in
    relative deviation per root second. Trust takes half a `memory` of excited samples and a
    relative deviation of `trust`.

    The standard deviation is the sandwich's: it needs no noise level and allows for residuals that
    are correlated over `correlation` seconds. In gusts it is 1.1 to 1.6 times too wide. It knows
    nothing of the bias by disturbances that feedback correlates with the acceleration (on the rig
    1 to 5 % in gusts, 60 to 300 % under the paper's sine) and by encoder noise in the acceleration
    (1 to 6 % where nothing stirs the counts): tests/benchmarks/inertia_study.py.
    Source: Eq. (19) and (24), corrected; docs/control.md.
    Raises `ValueError` for what cannot work.
    """

    torque_gain: Float[Array, "..."] = eqx.field(converter=as_float)  # N m per unit of command
    nominal: Float[Array, "..."] = eqx.field(converter=as_float)  # kg m^2
    memory: float = eqx.field(static=True, default=3.0)  # s
    bandwidth: Float[Array, ""] = eqx.field(converter=as_float, default=15.0)  # rad/s
    order: int = eqx.field(static=True, default=3)
    nuisance: tuple[str, ...] = eqx.field(static=True, default=("offset", "rate"))
    tones: ProbeTones | NoProbe = NoProbe()
    excitation: float = eqx.field(static=True, default=0.02)  # rad/s^2
    trust: float = eqx.field(static=True, default=0.1)
    correlation: float = eqx.field(static=True, default=0.5)  # s
    drift: float = eqx.field(static=True, default=0.01)  # 1/sqrt(s)
    dt: float = eqx.field(static=True, default=0.002)  # s

    def __check_init__(self):
        require_plant(self.torque_gain, self.nominal)
        require_nuisance(self.nuisance)
        require_above_zero("s", dt=self.dt, memory=self.memory, correlation=self.correlation)
        if self.memory < 100 * self.dt:
            raise ValueError(
                f"a memory of {self.memory} s is short for samples of {self.dt} s: give it "
                f"{100 * self.dt:g} s or more"
            )
        self._filters()

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the parameters, () for one estimator."""
        return plant_ensemble(self.torque_gain, self.nominal)

    def _filters(self) -> MatchedFilters:
        angle = "angle" in self.nuisance
        return MatchedFilters(self.torque_gain, self.bandwidth, self.order, self.dt, angle)

    def init(self, like: Float[Array, " axes *ensemble"]) -> RecursiveState:
        """Before the first sample; shaped as the measurement `like` and as the ensemble."""
        like = jnp.zeros(full_shape(like, self.ensemble), like.dtype)
        filters = self._filters()
        return RecursiveState(
            filters.init(like), jnp.zeros_like(like), no_sums(filters.signals, like),
            nothing_held(self.nominal, like), self.tones.init(like),
        )  # fmt: skip

    def update(
        self,
        state: RecursiveState,
        command: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"],
    ) -> RecursiveState:
        """Hear the command held during the last sample and the angle at its end."""
        filters, terms = self._filters()(state.filters, command, measurement)
        power = state.power + self.dt / 0.5 * (terms[-2] ** 2 - state.power)
        lively = (power > self.excitation**2).astype(power.dtype)
        heard = lively * settled(terms) * state.probe.exciting
        forget = heard * (self.dt / self.memory)
        sums, solved = learn(
            state.sums, terms * heard[None], 1 - forget, nuisance=self.nuisance,
            excitation=self.excitation, forget=min(1.0, self.dt / self.correlation),
            previous=state.held.inertia,
        )  # fmt: skip
        age = (1 - forget) * state.held.age + (1 - heard) * self.drift**2 * self.dt
        grown = solved.weight > -math.expm1(-0.5) * self.memory / self.dt
        held = Held(solved.inertia, solved.variance, age, jnp.where(grown, solved.informed, 0))
        probe = self.tones.step(state.probe, judged(held, self.nominal, self.trust))
        return RecursiveState(filters, power, sums, held, probe)

    def estimate(self, state: RecursiveState) -> InertiaEstimate:
        """That of the samples heard so far."""
        return judged(state.held, self.nominal, self.trust)

    def probe(self, state: RecursiveState) -> Float[Array, " axes *ensemble"]:
        """The test signal to add to the next command."""
        return self.tones.signal(state.probe, self.dt)

    def excite(self, state: RecursiveState) -> RecursiveState:
        """On demand: the estimate is in doubt from now on, which starts the tones."""
        return state._replace(held=doubted(state.held))
