"""The suite's controllers, from gains that are the same for every plant.

Gains are those of b u, in rad/s^2: a design fits any axis once it knows the axis' b = KT/J.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxquad.control import (
    AdaptiveLADRC,
    certainty_equivalence,
    Clamping,
    LADRC,
    LADRCLaw,
    LockInInertia,
    PID,
    ProbeTones,
)


class Design(NamedTuple):
    """A controller's law with its gains, before it knows the plant."""

    name: str
    data: dict[str, Any]  # of scenarios.toml
    gains: dict[str, float]  # wc and wo, or pole and filter, in rad/s; damping, ratio

    @property
    def law(self) -> str:
        return self.data["law"]

    @property
    def fixed(self) -> bool:
        """Whether b0 is what it is, whatever the inertia is believed to be."""
        return "fixed_b0" in self.data


class Belief(NamedTuple):
    """What a controller believes of its axes, [axes, members]."""

    torque_gain: np.ndarray  # N m per unit of command
    inertia: np.ndarray  # kg m^2
    nominal: np.ndarray  # b of the design's plant
    limit: np.ndarray  # of the command
    volts: np.ndarray  # [axes] units of command per volt of u

    @property
    def gain(self) -> np.ndarray:
        return self.torque_gain / self.inertia


class IgnoresDrive(eqx.Module):
    """A LADRC that ignores what its drive applied: its observer uses the command it asked for."""

    law: LADRC | LADRCLaw

    @property
    def dt(self) -> float:
        return self.law.dt

    @property
    def ensemble(self) -> tuple[int, ...]:
        return self.law.ensemble

    def prepared(self) -> Any:
        return self if isinstance(self.law, LADRCLaw) else IgnoresDrive(self.law.prepared())

    def init(self, like: Any) -> Any:
        return self.law.init(like)

    def step(self, state: Any, reference: Any, measurement: Any) -> Any:
        return self.law.step(state, reference, measurement)

    def signals(self, state: Any) -> Any:
        return self.law.signals(state)


def controller(
    design: Design,
    belief: Belief,
    *,
    dt: float,
    knows_limit: bool = True,
    second_gain: np.ndarray | float = 1.0,
    estimator: dict[str, Any] | None = None,
) -> Any:
    """The design on axes of which it has this `belief`; `second_gain` scales wo or the filter."""
    wide = lambda x: np.array(np.broadcast_to(x, belief.gain.shape), float)
    limit = belief.limit if knows_limit else wide(np.inf)
    if design.law == "pid":
        return _pid(design, belief, wide(second_gain), limit, knows_limit, dt)
    factor = lambda name: wide(design.data.get(name, 1.0))
    ladrc = LADRC(
        wide(design.gains["wc"]), wide(design.gains["wo"]) * wide(second_gain),
        b0_of(design, belief), feedback_factor=factor("feedback_factor"),
        observer_factor=factor("observer_factor"), limit=limit, dt=dt,
    )  # fmt: skip
    if design.law == "ladrc":
        return ladrc if knows_limit else IgnoresDrive(ladrc)
    return _adaptive(ladrc, design, belief, estimator or {}, dt)


def b0_of(design: Design, belief: Belief) -> np.ndarray:
    """b0 in rad/s^2 per unit of command; a fixed one is that multiple of b on every axis."""
    if not design.fixed:
        return design.data.get("b0", 1.0) * belief.gain
    first = belief.nominal[0] * belief.volts[0]  # of u in V
    return design.data["fixed_b0"] / first * belief.nominal


def _pid(
    design: Design,
    belief: Belief,
    second: np.ndarray,
    limit: np.ndarray,
    knows_limit: bool,
    dt: float,
) -> PID:
    per_unit, gains = 1 / belief.gain, design.gains
    kp, ki, kd = pid_gains(gains["pole"], gains.get("damping", 1.0), gains.get("ratio", 1.0))
    filter = gains["filter"] * second
    common: dict[str, Any] = {
        "limit": limit,
        "anti_windup": Clamping() if knows_limit else None,
        "dt": dt,
    }
    if design.data.get("filtered") == "measurement":
        return PID(
            kp * per_unit, ki * per_unit, kd * per_unit, measurement_filter=filter,
            proportional_weight=0 * per_unit, **common,
        )  # fmt: skip
    return PID(
        kp * per_unit, ki * per_unit, kd * per_unit, filter=filter,
        proportional_weight=design.data["proportional_weight"] + 0 * per_unit, **common,
    )  # fmt: skip


def pid_gains(pole: Any, damping: Any, ratio: Any) -> tuple[Any, Any, Any]:
    """kp, ki, kd of b u: poles of (s + ratio pole)(s^2 + 2 damping pole s + pole^2) on 1/s^2."""
    return (1 + 2 * damping * ratio) * pole**2, ratio * pole**3, (2 * damping + ratio) * pole


def _adaptive(
    ladrc: LADRC, design: Design, belief: Belief, changes: dict[str, Any], dt: float
) -> AdaptiveLADRC:
    given = design.data | changes
    # The same torque from the tones on every axis that a volt of u gives.
    amplitude = given["amplitude"] * np.broadcast_to(belief.volts[:, None], belief.gain.shape)
    tones = ProbeTones(tuple(given["tones"]), amplitude, above=given["above"], below=given["below"])
    estimator = LockInInertia(
        belief.torque_gain, belief.inertia, tones=tones, window=given["window"], dt=dt
    )
    gain, inertia = jnp.asarray(belief.torque_gain), jnp.asarray(belief.inertia)
    rule = certainty_equivalence(gain, inertia, factor=design.data.get("b0", 1.0))
    return AdaptiveLADRC(ladrc, estimator, rule)
