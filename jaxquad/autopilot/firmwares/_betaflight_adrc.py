"""Betaflight's proposed ADRC (pull request 15400): its law, and what a log says of it."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float, PyTree

from jaxquad._core import (
    as_float,
    as_messages,
    broadcast_gain,
    Message,
    per_member,
    require_positive,
)
from jaxquad.control import Reference
from jaxquad.identify import B0Law, B0Schedule
from jaxquad.records import AXES

from .._filters import Filter, FilterChain, PT2
from .._law import (
    bounded,
    DEGREES,
    filter_gyro,
    FlownLoop,
    gyro_rest,
    low_pass_share,
    RateLoop,
    require_gains,
    require_gyro_rate,
    Signal,
    split_reference,
    sum_of,
    Terms,
)
from .._parameters import list_parameters
from ._betaflight import betaflight_loop, flies_adrc, FlownBetaflight
from ._betaflight_law import F_SCALE


class BetaflightADRC(RateLoop):
    """The ADRC proposed for Betaflight (pull request 15400): rates in rad/s in, pidsum units out.

    An observer of y'' = b u + f, y the rate in deg/s, estimates y, y' and f by forward Euler:

        z1 += T (z2 - 3 wo e),  z2 += T (z3 + b u - 3 wo^2 e),  z3 += -T (sigma z3 + wo^3 e)
        b u = wc^2 (r - z1) - 2 wc z2 - z3,    e = z1 - y before the update

    where u in the observer is the command that reached the mixer. In the air: the gate before
    liftoff is not modelled. wo is at most 0.5/T. Source: docs/autopilots.md.

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `wc`, `wo`: adrc_wc, adrc_wo in rad/s.
    - `b0`: adrc_b0 in deg/s^3 per unit of pidsum, see `adrc_b0`.
    - `f`: feed-forward as in `BetaflightPID`.
    - `gyro`, `filters`: as in `BetaflightPID`; `lowpass`: adrc_gyro_lpf_hz, a pt2 at 150 Hz.
    - `setpoint_lowpass_hz`: adrc_td_hz, 0 is off.
    - `b0_scale`: of b0 by the throttle.
    - `forgetting`: adrc_sigma_decay / 10 in 1/s.
    - `limit`: pidsum_limit; `dt`: in s.

    **Raises:**

    - `ValueError`: a gain is not finite, the gyro's rate is no multiple of 1/dt, or a filter lies
        beyond half of its rate.
    """

    firmware: ClassVar[str] = "betaflight"
    feed_forward: ClassVar[tuple[str, ...]] = ("f",)
    of_sticks: ClassVar[bool] = True
    wc: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=60.0)
    wo: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=100.0)
    b0: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=2000.0)
    f: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    gyro: FilterChain = FilterChain()
    filters: tuple[Filter, ...] = ()
    lowpass: tuple[Filter, ...] | None = None
    setpoint_lowpass_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    b0_scale: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    forgetting: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.3)
    limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=500.0)
    dt: float = eqx.field(static=True, default=1 / 4000)  # s

    def __check_init__(self):
        for name, gain in self.gains().items():
            require_positive(name, gain)
        require_gains(self.dt, {**self.gains(), "f": self.f}, {"limit": self.limit})
        require_gyro_rate(self.gyro, self.dt)
        self._chain()  # refuses what lies beyond half of the loop's rate

    def _chain(self) -> FilterChain:
        """All filters of the rate at the loop's rate."""
        lowpass = (PT2(150.0),) if self.lowpass is None else self.lowpass
        return FilterChain((*self.filters, *lowpass), 1 / self.dt)

    def gyro_chains(self) -> list[FilterChain]:
        return [self.gyro, FilterChain(self.filters, 1 / self.dt)] if self.filters else [self.gyro]

    def without_gyro_filters(self) -> "BetaflightADRC":
        return dataclasses.replace(self, gyro=FilterChain(), filters=())

    def gains(self) -> dict[str, Array]:
        return {"wc": self.wc, "wo": self.wo, "b0": self.b0}

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        return {
            "gyro": gyro_rest(self.gyro, zero), "filters": self._chain().init(zero),
            "reference": zero, "slow": zero, "z": (zero, zero, zero), "command": zero,
        }  # fmt: skip

    def advance(
        self,
        memory: Mapping[str, PyTree],
        excess: Signal,
        reference: Reference,
        measurement: Signal,
    ) -> tuple[dict[str, PyTree], Signal, Terms]:
        at = lambda gain: broadcast_gain(gain, measurement)
        r, speed = split_reference(reference, memory["reference"], self.dt)
        gyro, (smooth, _) = filter_gyro(self.gyro, self.dt, memory["gyro"], DEGREES * measurement)
        filters, y = self._chain().step(memory["filters"], smooth)
        share = low_pass_share(self.setpoint_lowpass_hz, self.dt, r)
        slow = memory["slow"] + share * (DEGREES * r - memory["slow"])
        b, wc = at(self.b0) * at(self.b0_scale), at(self.wc)
        z = self._observed(memory["z"], b * (memory["command"] - excess), y, b)
        terms = {
            "P": wc**2 * (slow - z[0]) / b, "I": -z[2] / b, "D": -2 * wc * z[1] / b,
            "F": F_SCALE * at(self.f) * DEGREES * speed,
        }  # fmt: skip
        command = bounded(sum_of(terms), self.limit)
        next = {
            "gyro": gyro, "filters": filters, "reference": r, "slow": slow, "z": z,
            "command": command,
        }  # fmt: skip
        return next, command, terms

    def _observed(self, z, drive, y, b):
        at = lambda gain: broadcast_gain(gain, y)
        wo, dt = jnp.minimum(at(self.wo), 0.5 / self.dt), self.dt
        error = z[0] - y
        most = at(self.limit) * b
        first = z[0] + dt * (z[1] - 3 * wo * error)
        second = z[1] + dt * (z[2] + drive - 3 * wo**2 * error)
        third = z[2] - dt * (at(self.forgetting) * z[2] + wo**3 * error)
        return (
            jnp.clip(first, -8000.0, 8000.0),
            jnp.clip(second, -1e5, 1e5),
            jnp.clip(third, -most, most),
        )


def adrc_b0(gain: Float[ArrayLike, "..."], lag: Float[ArrayLike, "..."]) -> Float[Array, "..."]:
    """b0 of `BetaflightADRC` in deg/s^3 per pidsum, of an identified plant gain/(s (lag s + 1)).

    Differentiable: `fit.derived` propagates the covariance of gain and lag.

    **Arguments:**

    - `gain`: from the sum that the mixer gets over 1000 to the angular acceleration, in rad/s^2.
    - `lag`: of the motors in s.
    """
    return DEGREES * as_float(gain) / (1000 * as_float(lag))


_NUMBERED: tuple[B0Law, ...] = ("QUADRATIC", "SQRT", "LINEAR", "FIXED")  # as the header counts them
_LARGEST_WITHOUT_LAW = 9.0  # adrc_b0_scale_max of a build without adrc_b0_law


class FlownADRC(FlownLoop[BetaflightADRC]):
    """Betaflight's proposed ADRC of a log, with its dynamic cutoffs and b0 over the throttle.

    **Arguments:** (those of `FlownLoop`, and)

    - `pid`: the PID of the same header, which did not fly, for the gyro's filters.
    - `schedule`: of b0.
    """

    pid: FlownBetaflight = eqx.field(kw_only=True)
    schedule: B0Schedule = eqx.field(static=True, kw_only=True)

    def parameters(self) -> dict[str, float]:
        """The values that flew, by the names of `PARAMETERS`."""
        law = self.law
        return list_parameters(law) | {
            "adrc_gyro_lpf_hz": self.lowpass_hz,
            "adrc_td_hz": float(law.setpoint_lowpass_hz),
            "adrc_hover_throttle": 100 * self.schedule.hover,
            "adrc_sigma_decay": 10 * float(law.forgetting),
        }

    @property
    def lowpass_hz(self) -> float:
        """adrc_gyro_lpf_hz; 0 is off."""
        cutoffs = [float(x.cutoff_hz) for x in self.law.lowpass or () if isinstance(x, PT2)]
        return cutoffs[0] if cutoffs else 0.0

    def at(self, throttle: float) -> BetaflightADRC:
        """The law at a throttle of 0 to 1: dynamic cutoffs and the scale of b0."""
        scale = float(self.schedule.scale(throttle))
        return dataclasses.replace(self.law, filters=self.pid.at(throttle).filters, b0_scale=scale)


_OF_AXES = {"adrc_wc": "adrcWC", "adrc_wo": "adrcWO", "adrc_b0": "adrcB0"}
_OF_ALL = ("adrc_gyro_lpf_hz", "adrc_td_hz", "adrc_hover_throttle", "adrc_sigma_decay")


def adrc_parameters(values: Mapping[str, str]) -> dict[str, float]:
    """The parameters of the proposed ADRC that a Betaflight header holds, flown or not.

    **Arguments:**

    - `values`: the header's lines by name, `jq.records.read_settings(path).values`.

    **Returns:** values by the names of `PARAMETERS`; empty for a firmware without the ADRC.
    """
    parameters = {
        f"{name}_{axis}": value
        for name, line in _OF_AXES.items() if line in values
        for axis, value in zip(AXES, _three(values, line), strict=True)
    }  # fmt: skip
    return parameters | {name: float(values[name]) for name in _OF_ALL if name in values}


def betaflight_adrc_loop(
    values: Mapping[str, str], version: Sequence[int], *, throttle: float = 0.3
) -> FlownADRC:
    """The rate loop of a Betaflight header that was flown with the proposed ADRC.

    A header without adrc_b0_law is of a build in which b0 follows the square of the throttle.
    Source: docs/autopilots.md.

    **Arguments:**

    - `values`: the header's lines by name, `jq.records.read_settings(path).values`.
    - `version`: of the firmware, (2026, 6, 0).
    - `throttle`: 0 to 1, at which the cutoffs and b0 of `law` are.

    **Raises:**

    - `ValueError`: the PID flew, or the header lacks a number.
    """
    if not flies_adrc(values):
        raise ValueError(
            "the header has no pid_type of 1, so the PID flew: read it with betaflight_loop."
        )
    pid = betaflight_loop(values, version, throttle=throttle)
    lowpass = _number(values, "adrc_gyro_lpf_hz", 150.0)
    law = BetaflightADRC(
        wc=_three(values, "adrcWC"), wo=_three(values, "adrcWO"), b0=_three(values, "adrcB0"),
        f=pid.law.f * pid.law.f_share, gyro=pid.law.gyro, filters=pid.law.filters,
        lowpass=(PT2(lowpass),) if lowpass > 0 else (),
        setpoint_lowpass_hz=_number(values, "adrc_td_hz", 0.0),
        forgetting=_number(values, "adrc_sigma_decay", 3.0) / 10,
        limit=pid.law.limit, dt=pid.law.dt,
    )  # fmt: skip
    flown = FlownADRC(law, _unmodelled(values, pid), pid=pid, schedule=_schedule(values))
    return dataclasses.replace(flown, law=flown.at(throttle))


def b0_law(values: Mapping[str, str]) -> B0Law | None:
    """adrc_b0_law of a Betaflight header; None where it has none.

    **Arguments:**

    - `values`: the header's lines by name, `jq.records.read_settings(path).values`.

    **Raises:**

    - `ValueError`: the header's number stands for no law.
    """
    if "adrc_b0_law" not in values:
        return None
    number = int(values["adrc_b0_law"])
    if not 0 <= number < len(_NUMBERED):
        raise ValueError(f"adrc_b0_law is {number} in the header: 0 to {len(_NUMBERED) - 1} exist.")
    return _NUMBERED[number]


def _schedule(values: Mapping[str, str]) -> B0Schedule:
    law = b0_law(values)
    return B0Schedule(
        law or "QUADRATIC",
        _number(values, "adrc_hover_throttle", 35.0) / 100,
        _number(values, "adrc_b0_scale_min", 100.0) / 100,
        _number(values, "adrc_b0_scale_max", 3.0 if law else _LARGEST_WITHOUT_LAW),
    )


def _unmodelled(values: Mapping[str, str], pid: FlownBetaflight) -> tuple[Message, ...]:
    # What concerns P, I and D did not fly.
    common: list[str] = [text for text in pid.unmodelled if text.kind in ("notch", "feedforward")]
    common.append("the gate before liftoff, and wc on the ground")
    if _number(values, "adrc_sat_z3_inhibit", 0.0) > 0:
        common.append("adrc_sat_z3_inhibit: the observer's integrator rests at the mixer's limits")
    if any(float(x) != 100 for k in values if "adrc_zeta" in k for x in values[k].split(",")):
        common.append("adrc_zeta: the damping ratio is taken as 1")
    return as_messages(common)


def _three(values: Mapping[str, str], name: str) -> list[float]:
    if name not in values:
        raise ValueError(
            f"the header has no line {name}: the log's build of the ADRC is not that of pull "
            "request 15400."
        )
    return [float(x) for x in values[name].split(",")]


def _number(values: Mapping[str, str], name: str, default: float) -> float:
    return float(values.get(name, default))
