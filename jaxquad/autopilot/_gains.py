"""Gains in SI units as the firmwares' parameters and back, and what cannot be expressed."""

from collections.abc import Mapping
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import as_float, Number, pick_gain, require_positive
from jaxquad.control import AdaptiveLADRC, LADRC, PID, ScheduledLADRC
from jaxquad.records import AXES

from ._firmware import firmware_named
from ._parameters import names_by_field


class RateGains(NamedTuple):
    """A rate PID, u = kp e + ki int e - kd y', of rates in rad/s."""

    kp: float  # in units of u per rad/s
    ki: float  # per rad
    kd: float  # per rad/s^2


def _names(firmware: str, axis: str) -> list[str]:
    """The parameters of P, I and D. Raises ValueError for an unknown axis."""
    names = names_by_field(firmware, _number(axis))
    return [names[field] for field in firmware_named(firmware).fields]


def _number(axis: str) -> int:
    if axis not in AXES:
        raise ValueError(f"axis is {axis!r}: give one of {', '.join(AXES)}.")
    return AXES.index(axis)


def rate_parameters(
    firmware: str, axis: str, gains: RateGains, *, torque_per_unit: Number = 1.0
) -> dict[str, float]:
    """The P, I and D parameters of a rate PID in SI units, not rounded.

    **Arguments:**

    - `axis`: "roll", "pitch" or "yaw".
    - `gains`: in N m.
    - `torque_per_unit`: in N m per unit of PX4's or ArduPilot's output, per 1000 units of
        Betaflight's pidsum, per 65535 of the Crazyflie's command: `torque_per_unit`. Where a record
        of the firmware's own output gave the plant K in rad/s^2 per unit of it, give K (Betaflight
        1000 K, Crazyflie 65535 K) and gains of the angular acceleration: no thrust, arm or inertia
        is needed.

    **Raises:**

    - `ValueError`: the axis is unknown, or `torque_per_unit` is not above 0.
    """
    names = _names(firmware, axis)
    require_positive("torque_per_unit", torque_per_unit, "give the plant's gain")
    triples = zip(names, gains, firmware_named(firmware).si_scales(axis), strict=True)
    return {name: gain * scale / torque_per_unit for name, gain, scale in triples}


def rate_gains(
    firmware: str, axis: str, values: Mapping[str, Number], *, torque_per_unit: Number = 1.0
) -> RateGains:
    """The rate PID in SI units that parameters are: the inverse of `rate_parameters`.

    With `torque_per_unit` the `motor_share` of the axis, the gains are the relative thrust of a
    motor per rad/s, in which the firmwares can be compared.

    **Raises:**

    - `ValueError`: the axis is unknown, or a parameter is missing.
    """
    names = _names(firmware, axis)
    missing = [name for name in names if name not in values]
    if missing:
        raise ValueError(f"the parameters lack {', '.join(missing)}: give P, I and D of the axis.")
    pairs = zip(names, firmware_named(firmware).si_scales(axis), strict=True)
    return RateGains(*(values[name] / scale * torque_per_unit for name, scale in pairs))


def motor_share(firmware: str, axis: str) -> float:
    """Relative thrust of a motor of a quad X per unit of the output that moves it."""
    return float(firmware_named(firmware).motor_shares[_number(axis)])


def torque_per_unit(
    firmware: str, axis: str, *, thrust: Number, arm: Number = 0.0, drag: Number = 0.0
) -> float:
    """N m of a quad X per unit of the firmware's output, in the units of `rate_parameters`.

    **Arguments:**

    - `thrust`: of one motor at full command in N, or four times less where the curve is steeper.
    - `arm`: from the centre to a motor in m, for roll and pitch.
    - `drag`: torque over thrust of a rotor in m, for yaw.

    **Raises:**

    - `ValueError`: the thrust, and the arm or drag that the axis needs, is not above 0.
    """
    lever = drag if axis == "yaw" else arm / np.sqrt(2)
    require_positive("thrust", thrust, "give N")
    require_positive("drag" if axis == "yaw" else "arm", lever, "give m")
    return float(4 * lever * motor_share(firmware, axis) * thrust)


class Cascade(NamedTuple):
    """An angle P around a rate PI: r = p (angle error), u = rate_p e + rate_i int e."""

    p: Float[Array, "..."]  # in 1/s
    rate_p: Float[Array, "..."]  # in units of u per rad/s
    rate_i: Float[Array, "..."]  # in units of u per rad


def cascade_of(
    kp: Float[ArrayLike, "..."], ki: Float[ArrayLike, "..."], kd: Float[ArrayLike, "..."]
) -> Cascade:
    """The cascade that equals u = kp e + ki int e - kd y' of an angle, e = r - y.

    p is the larger root of kd p^2 - kp p + ki = 0, rate_i = ki/p, rate_p = kd.

    **Raises:**

    - `ValueError`: kd is not above 0, or kp^2 < 4 kd ki: no cascade has these gains.
    """
    kp, ki, kd = as_float(kp), as_float(ki), as_float(kd)
    require_positive("kd", kd, "a cascade needs feedback of the rate")
    room = kp**2 - 4 * kd * ki
    if np.any(np.asarray(room) < 0) or np.any(np.asarray(kp) <= 0):
        raise ValueError(
            f"No cascade of angle P and rate PI has kp = {kp}, ki = {ki}, kd = {kd}: it needs "
            f"kp^2 >= 4 kd ki, so lower ki to {kp**2 / (4 * kd)} or less."
        )
    p = (kp + jnp.sqrt(room)) / (2 * kd)
    return Cascade(p, kd, ki / p)


def pid_of(cascade: Cascade) -> tuple[Array, Array, Array]:
    """kp, ki and kd of the angle: the inverse of `cascade_of`."""
    p, rate_p, rate_i = cascade
    return rate_p * p + rate_i, rate_i * p, rate_p


class LADRCAsPID(NamedTuple):
    """A second-order LADRC as a PID behind a second-order low-pass of the measurement."""

    kp: Float[Array, "..."]
    ki: Float[Array, "..."]
    kd: Float[Array, "..."]
    frequency: Float[Array, "..."]  # natural one of the low-pass in rad/s
    damping: Float[Array, "..."]  # its damping ratio


def ladrc_as_pid(
    wc: Float[ArrayLike, "..."], wo: Float[ArrayLike, "..."], b0: Float[ArrayLike, "..."]
) -> LADRCAsPID:
    """The feedback of a continuous second-order LADRC, exactly, for firmwares that have none.

    The set-point passes differently: there a LADRC is slower than a PID. Its bandwidths `wc` and
    `wo` are in rad/s. Source: docs/autopilots.md; arXiv 2501.11374.
    """
    wc, wo, b0 = as_float(wc), as_float(wo), as_float(b0)
    d0, d1 = 3 * wo**2 + 6 * wo * wc + wc**2, 3 * wo + 2 * wc
    return LADRCAsPID(
        wc * wo**2 * (2 * wo + 3 * wc) / (b0 * d0), wc**2 * wo**3 / (b0 * d0),
        wo * (wo**2 + 6 * wo * wc + 3 * wc**2) / (b0 * d0), jnp.sqrt(d0), d1 / (2 * jnp.sqrt(d0)),
    )  # fmt: skip


def cascade_parameters(
    firmware: str, axis: str, controller: object, *, torque_per_unit: Number = 1.0
) -> dict[str, float]:
    """The parameters by which a firmware's angle and rate loop is an angle controller of jaxquad.

    The firmware's gyro filters take the place of the controller's own filter.

    **Arguments:**

    - `axis`: "roll", "pitch" or "yaw"; one Betaflight has one angle_p_gain for all.
    - `controller`: a `jq.PID` of the angle, in N m or as `rate_parameters` says.
    - `torque_per_unit`: as in `rate_parameters`.

    **Raises:**

    - `ValueError`: the firmware cannot express the controller; the message says what of it.
    """
    number = _number(axis)
    if reasons := find_inexpressible(firmware, controller):
        raise ValueError(" ".join(reasons))
    assert isinstance(controller, PID)
    at = lambda gain: pick_gain(gain, number if gain.size > 1 else 0, None)
    cascade = cascade_of(at(controller.kp), at(controller.ki), at(controller.kd))
    gains = RateGains(float(cascade.rate_p), float(cascade.rate_i), 0.0)
    rate = rate_parameters(firmware, axis, gains, torque_per_unit=torque_per_unit)
    return {**firmware_named(firmware).angle_parameters(axis, float(cascade.p)), **rate}


def find_inexpressible(firmware: str, controller: object) -> tuple[str, ...]:
    """What of a `jq.PID` of the angle a firmware cannot express, a sentence each; empty if nothing.

    A `LADRC` is never expressible: see `ladrc_as_pid`.
    """
    kind = firmware_named(firmware)
    name, reasons = kind.log.title, []
    if isinstance(controller, LADRC | ScheduledLADRC | AdaptiveLADRC):
        return (f"{name} cannot run a LADRC of the angle: {kind.no_ladrc}. Use ladrc_as_pid.",)
    if not isinstance(controller, PID):
        return (f"A {type(controller).__name__} is not known: give a jq.PID.",)
    if np.any(np.asarray(controller.derivative_weight) != 0):
        reasons.append(
            f"{name} takes its rate feedback from the measurement alone: derivative_weight must "
            "be 0."
        )
    if np.any(np.asarray(controller.proportional_weight) != 1):
        instead = (
            " A feed-forward of (weight - 1) times P does the same, and is negative below 1, "
            "beyond the documented range."
        )
        reasons.append(
            f"{name} has no weight of the set-point: proportional_weight must be 1."
            f"{instead if kind.weighs_setpoint else ''}"
        )
    if np.any(np.asarray(controller.feedforward) != 0):
        reasons.append(f"{name} feeds no angular acceleration forward: feedforward must be 0.")
    kp, ki, kd = (np.asarray(x) for x in (controller.kp, controller.ki, controller.kd))
    if np.any(kd <= 0):
        reasons.append(
            f"{name} has no angle loop without feedback of the rate: kd must be above 0."
        )
    elif np.any(kp**2 < 4 * kd * ki):
        reasons.append(
            f"{name} has no integral of the angle: the rate's does it only for ki of at most "
            f"kp^2/(4 kd) = {np.min(kp**2 / (4 * kd)):.4g}, and ki is {np.max(ki):.4g}."
        )
    return tuple(reasons)
