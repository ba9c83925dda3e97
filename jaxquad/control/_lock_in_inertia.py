import functools as ft
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxquad.models._parameters import as_float

from ._filters import motion, no_past, Past
from ._inertia_estimate import (
    doubted,
    Held,
    InertiaEstimate,
    judged,
    nothing_held,
    plant_ensemble,
    require_above_zero,
    require_plant,
)
from ._lock_in_solution import solve
from ._lock_in_windows import LockInWindows, WindowSums
from ._per_axis import full_shape
from ._probe_tones import ProbeTones


class LockInState(NamedTuple):
    past: Past
    sums: WindowSums
    held: Held
    stiffness: Float[Array, " axes *ensemble"]  # N m/rad
    exciting: Float[Array, " axes *ensemble"]  # 1 while the tones are on


class LockInInertia(eqx.Module):
    """Inertia at the frequencies of its own test tones: torque over acceleration, in phase.

    Both sides of the sampled equation of motion are correlated with each tone over Hann windows of
    `window` seconds, one beginning each half window. A tone makes a whole number of periods in a
    window. Whatever makes another whole number, such as a constant torque or the rig's 5 s sine,
    drops out exactly; a motor's lag and damping fall in quadrature; the ends of a window, where
    encoder noise would enter, do not count. A delay of d seconds costs 1 - cos(omega d). A
    stiffness k leaves J - k / omega^2 at one tone; `nuisance=("angle",)` with two tones or more
    takes it out. An encoder bends angles of a count or two by 0.5 to 4 %, unless noise stirs them.

    The standard deviation is that of one window, from the disturbance two periods a window beside
    its tones, with four degrees of freedom: it is known to a third, and assumes a spectrum that
    is flat from there to the tone. Between windows the estimate is held and ages by `drift` in
    relative deviation per root second. Only windows throughout which the tones were on count, and
    tones of `contrast` times the power beside them; trust takes a relative deviation of `trust`.
    A change of the inertia counts in full after the first window that begins after it, which is
    one window and a half at the latest. Source: docs/control.md.
    Raises `ValueError` for tones that do not fit the window or each other.
    """

    torque_gain: Float[Array, "..."] = eqx.field(converter=as_float)  # N m per unit of command
    nominal: Float[Array, "..."] = eqx.field(converter=as_float)  # kg m^2
    tones: ProbeTones = eqx.field(default_factory=ProbeTones)
    window: float = eqx.field(static=True, default=5.0)  # s
    nuisance: tuple[str, ...] = eqx.field(static=True, default=())
    contrast: float = eqx.field(static=True, default=10.0)
    trust: float = eqx.field(static=True, default=0.1)
    drift: float = eqx.field(static=True, default=0.01)  # 1/sqrt(s)
    dt: float = eqx.field(static=True, default=0.002)  # s

    def __check_init__(self):
        require_plant(self.torque_gain, self.nominal)
        require_above_zero("s", dt=self.dt, window=self.window)
        if self.nuisance not in ((), ("angle",)):
            raise ValueError(f"nuisance is {self.nuisance}: give () or ('angle',)")
        if self.nuisance and len(self.tones.frequencies) < 2:
            raise ValueError(
                f"one tone, {self.tones.frequencies} Hz, cannot tell stiffness from inertia: "
                "give the probe two frequencies, or leave the nuisance 'angle' out"
            )
        self._windows()

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the parameters, () for one estimator."""
        return plant_ensemble(self.torque_gain, self.nominal)

    def _windows(self) -> LockInWindows:
        return LockInWindows(self.tones.frequencies, self.window, self.dt)

    def init(self, like: Float[Array, " axes *ensemble"]) -> LockInState:
        """Before the first sample; shaped as the measurement `like` and as the ensemble."""
        like = zero = jnp.zeros(full_shape(like, self.ensemble), like.dtype)
        held = nothing_held(self.nominal, like)
        return LockInState(no_past(like), self._windows().init(like), held, zero, zero + 1)

    def update(
        self,
        state: LockInState,
        command: Float[Array, " axes *ensemble"],
        measurement: Float[Array, " axes *ensemble"],
    ) -> LockInState:
        """Hear the command held during the last sample and the angle at its end."""
        past, now = motion(state.past, self.torque_gain, command, measurement, self.dt)
        windows = self._windows()
        pair = now.valid * jnp.stack([now.acceleration, now.torque])
        sums = windows.add(state.sums, pair, state.exciting)
        aged = state.held._replace(age=state.held.age + self.drift**2 * self.dt)
        held, stiffness = jax.lax.cond(
            windows.ends(sums),
            ft.partial(self._renewed, windows),
            lambda sums, *kept: kept,
            sums, aged, state.stiffness,
        )  # fmt: skip
        exciting = self.tones.switch(state.exciting, judged(held, self.nominal, self.trust))
        return LockInState(past, sums, held, stiffness, exciting)

    def _renewed(self, windows, sums, held, stiffness):
        """The estimate of the window that has just ended, where it shows one."""
        done, whole = windows.ended(sums)
        solved = solve(
            done[:, :, :, 0], done[:, :, :, 1], windows.square(whole),
            contrast=self.contrast, stiff=bool(self.nuisance),
        )  # fmt: skip
        new = Held(solved.inertia, solved.variance, jnp.zeros_like(whole), solved.informed)
        renew = ft.partial(jnp.where, (whole > 0) & (solved.informed > 0))
        return jax.tree.map(renew, (new, solved.stiffness), (held, stiffness))

    def estimate(self, state: LockInState) -> InertiaEstimate:
        """That of the last whole window in which a tone stood out."""
        return judged(state.held, self.nominal, self.trust)

    def stiffness(self, state: LockInState) -> Float[Array, " axes *ensemble"]:
        """In N m/rad beside the inertia; 0 unless the nuisance is "angle"."""
        return state.stiffness

    def probe(self, state: LockInState) -> Float[Array, " axes *ensemble"]:
        """The test signal to add to the next command."""
        phase = self._windows().phase(state.sums.index).astype(state.exciting.dtype)
        return self.tones.wave(phase, state.exciting)

    def excite(self, state: LockInState) -> LockInState:
        """On demand: the estimate is in doubt from now on, which starts the tones."""
        return state._replace(held=doubted(state.held))
