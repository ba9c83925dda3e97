import functools as ft
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

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


class WindowedState(NamedTuple):
    filters: FilterState
    sums: Sums
    held: Held
    probe: ProbeState
    index: Int[Array, ""]  # samples heard of the window


class WindowedInertia(eqx.Module):
    """The disturbance observer's inertia: least squares over windows, one after the other.

    Filtered torque is regressed on filtered acceleration and on the `nuisance` terms over `window`
    seconds; the estimate is held until the next window ends. Without nuisance terms this is the
    paper's integral; a constant disturbance then biases it unless the window holds whole periods
    of the motion. The default terms, a constant and the rate, are exact for any window; "angle"
    takes out a stiffness k, which one tone cannot tell from inertia: the estimate is then
    J - k / omega^2 without the term and uninformed with it.

    The standard deviation allows for residuals that are correlated over `correlation` seconds; in
    windows below some 3 s it is too small, by 1.2 to 1.7 at 1 s. It knows nothing of disturbances
    that feedback correlates with the acceleration, nor of encoder noise in the acceleration, which
    shrinks the estimate: `jq.control.LockInInertia` suffers little from either. Trusted are estimates from
    an acceleration of `excitation` rad/s^2 rms after the filter with a relative deviation of
    `trust`; a held one ages by `drift` in relative deviation per root second.
    Source: Eq. (15)-(24), corrected: Eq. (23) as printed is 0/0, and J_n + dJ is the regression
    int(q1 q0') / int(q0'^2), in which J_n cancels. Raises `ValueError` for what cannot work.
    """

    torque_gain: Float[Array, "..."] = eqx.field(converter=as_float)  # N m per unit of command
    nominal: Float[Array, "..."] = eqx.field(converter=as_float)  # kg m^2
    window: float = eqx.field(static=True, default=5.0)  # s
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
        require_above_zero("s", dt=self.dt, window=self.window, correlation=self.correlation)
        if self.samples < 50:
            raise ValueError(
                f"a window of {self.window} s holds {self.samples} samples of {self.dt} s: give "
                "it 50 or more"
            )
        self._filters()

    @property
    def samples(self) -> int:
        return round(self.window / self.dt)

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the parameters, () for one estimator."""
        return plant_ensemble(self.torque_gain, self.nominal)

    def _filters(self) -> MatchedFilters:
        angle = "angle" in self.nuisance
        return MatchedFilters(self.torque_gain, self.bandwidth, self.order, self.dt, angle)

    def init(self, like: Float[Array, " axes *ensemble"]) -> WindowedState:
        """Before the first sample; shaped as the measurement `like` and as the ensemble."""
        like = jnp.zeros(full_shape(like, self.ensemble), like.dtype)
        filters = self._filters()
        return WindowedState(
            filters.init(like), no_sums(filters.signals, like), nothing_held(self.nominal, like),
            self.tones.init(like), jnp.zeros((), jnp.int32),
        )  # fmt: skip

    def update(
        self,
        state: WindowedState,
        command: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"],
    ) -> WindowedState:
        """Hear the command held during the last sample and the angle at its end."""
        filters, terms = self._filters()(state.filters, command, measurement)
        sums = jax.tree.map(lambda x: jnp.where(state.index == 0, 0, x), state.sums)
        heard = settled(terms) * state.probe.exciting
        sums, solved = learn(
            sums, terms * heard[None], jnp.ones_like(measurement),
            nuisance=self.nuisance, excitation=self.excitation,
            forget=min(1.0, self.dt / self.correlation), previous=state.held.inertia,
        )  # fmt: skip
        done = state.index == self.samples - 1
        renew = done & (solved.informed > 0) & (solved.weight > 0.99 * self.samples)
        age = state.held.age + self.drift**2 * self.dt
        new = Held(solved.inertia, solved.variance, jnp.zeros_like(age), solved.informed)
        held = jax.tree.map(ft.partial(jnp.where, renew), new, state.held._replace(age=age))
        probe = self.tones.step(state.probe, judged(held, self.nominal, self.trust))
        return WindowedState(filters, sums, held, probe, jnp.where(done, 0, state.index + 1))

    def estimate(self, state: WindowedState) -> InertiaEstimate:
        """That of the last window that showed one."""
        return judged(state.held, self.nominal, self.trust)

    def probe(self, state: WindowedState) -> Float[Array, " axes *ensemble"]:
        """The test signal to add to the next command."""
        return self.tones.signal(state.probe, self.dt)

    def excite(self, state: WindowedState) -> WindowedState:
        """On demand: the estimate is in doubt from now on, which starts the tones."""
        return state._replace(held=doubted(state.held))
