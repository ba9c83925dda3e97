"""Betaflight's proposed ADRC of a log: its law, and how b0 follows the throttle."""

import dataclasses
from collections.abc import Mapping, Sequence

import equinox as eqx

from jaxquad._core import as_messages, Message
from jaxquad.identify import B0Law, B0Schedule
from jaxquad.records import AXES

from .._filters import PT2
from .._flown import betaflight_loop, FlownBetaflight, FlownLoop
from .._parameters import list_parameters
from ._law import BetaflightADRC


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
    found = {
        f"{name}_{axis}": value
        for name, line in _OF_AXES.items() if line in values
        for axis, value in zip(AXES, _three(values, line), strict=True)
    }  # fmt: skip
    return found | {name: float(values[name]) for name in _OF_ALL if name in values}


def flies_adrc(values: Mapping[str, str]) -> bool:
    """Whether a Betaflight header is of a flight with the proposed ADRC: pid_type is 1.

    **Arguments:**

    - `values`: the header's lines by name, `jq.records.read_settings(path).values`.
    """
    return values.get("pid_type", "0").strip().upper() in ("1", "ADRC")


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
    common: list[str] = [each for each in pid.unmodelled if each.kind in ("notch", "feedforward")]
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
