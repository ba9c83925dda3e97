"""The Crazyflie: its rate and attitude PID, parameters and files."""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import as_float, as_float_or_none, broadcast_gain, per_member, require_positive
from jaxquad.control import Reference, Setpoint
from jaxquad.records import AXES

from .._filters import Butterworth, FilterChain
from .._firmware import (
    Channels,
    Firmware,
    joined_lines,
    number_text,
    Parameter,
    Range,
    rows_of_axes,
)
from .._law import (
    Advance,
    AngleLoop,
    bounded,
    DEGREES,
    Memories,
    RateLoop,
    require_gains,
    Signal,
    split_reference,
    sum_of,
)
from ._logs import CRAZYFLIE as LOG


class CrazyflieRate(RateLoop):
    """The Crazyflie's rate loop (controller 1): rates in rad/s in, the int16 command out.

        u = kp e + ki sat(int e, integral_limit) - kd y' + kff r    in deg/s, before truncation

    The integral is used at once, and its limit is on the integral of the error in deg. Pitch has
    the firmware's inverted sign. Not modelled: the truncation of u to whole numbers. Source:
    docs/autopilots.md.

    !!! example

        ```python
        law = CrazyflieRate(250, 500, 2.5, gyro=FilterChain((Butterworth(80.0),), 1000.0))
        ```

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `kp`, `ki`, `kd`, `kff`: pid_rate.roll_kp and so on.
    - `gyro`: filters at the gyro's rate, 80 Hz at 1 kHz in the firmware.
    - `derivative_hz`: of the Butterworth filter of y' (30 Hz where pid_rate.rateFiltEn is 1); None
        is off.
    - `integral_limit`: in deg, 33.3 for roll and pitch, 166.7 for yaw.
    - `limit`: of |u|; `dt`: in s.
    """

    firmware: ClassVar[str] = "crazyflie"
    tuned: ClassVar[tuple[str, ...]] = ("kp", "ki", "kd")
    feed_forward: ClassVar[tuple[str, ...]] = ("kff",)
    limits: ClassVar[tuple[str, ...]] = ("integral_limit", "limit")
    kp: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    ki: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    kd: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    kff: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    gyro: FilterChain = FilterChain()
    derivative_hz: Float[Array, "..."] | None = per_member(
        rank=1, converter=as_float_or_none, default=None
    )
    integral_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=33.3)
    limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=32767.0)
    dt: float = eqx.field(static=True, default=0.002)  # s

    def __check_init__(self):
        self._slope()  # refuses what lies beyond half of the loop's rate

    def _slope(self) -> FilterChain:
        cutoff = self.derivative_hz
        return FilterChain(() if cutoff is None else (Butterworth(cutoff),), 1 / self.dt)

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        slope = self._slope().init(zero)
        return {"gyro": self.gyro_rest(zero), "slope": slope, "y": zero, "integral": zero}

    def advance(
        self, memory: Memories, excess: Signal, reference: Reference, measurement: Signal
    ) -> Advance:
        r, _ = split_reference(reference, measurement, self.dt)
        gyro, (y, _) = self.filter_gyro(memory["gyro"], DEGREES * measurement)
        error = DEGREES * r - y
        slope, falling = self._slope().step(memory["slope"], (memory["y"] - y) / self.dt)
        integral = bounded(memory["integral"] + error * self.dt, self.integral_limit)
        at = lambda gain: broadcast_gain(gain, measurement)
        terms = {
            "P": at(self.kp) * error, "I": at(self.ki) * integral,
            "D": at(self.kd) * falling, "F": at(self.kff) * DEGREES * r,
        }  # fmt: skip
        next = {"gyro": gyro, "slope": slope, "y": y, "integral": integral}
        return next, bounded(sum_of(terms), self.limit), terms


class CrazyflieAttitude(AngleLoop):
    """The Crazyflie's angle PID around its rate loop: angles in rad in, the int16 command out.

    Source: docs/autopilots.md.

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `rate`: the `CrazyflieRate` inside.
    - `kp`, `ki`, `kd`: pid_attitude.roll_kp and so on, from deg to deg/s.
    - `integral_limit`: of the integral of the error, in deg s.

    **Raises:** `ValueError`: `kp` is not above 0.
    """

    outer: ClassVar[tuple[str, ...]] = ("kp", "ki", "kd")
    rate: CrazyflieRate
    kp: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=6.0)
    ki: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=3.0)
    kd: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    integral_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=20.0)

    def __check_init__(self):
        require_positive("kp", self.kp, "give 1/s")
        limits = {"integral_limit": self.integral_limit}
        require_gains(self.dt, {"ki": self.ki, "kd": self.kd}, limits)

    def outer_rest(self, zero: Signal) -> dict[str, PyTree]:
        return {"integral": zero}

    def wanted_rate(
        self, memory: Memories, aim: Setpoint, angle: Signal, rate: Signal
    ) -> tuple[dict[str, PyTree], Signal]:
        at = lambda gain: broadcast_gain(gain, angle)
        error = DEGREES * (aim.angle - angle)
        integral = bounded(memory["integral"] + error * self.dt, self.integral_limit)
        wanted = at(self.kp) * error + at(self.ki) * integral - at(self.kd) * DEGREES * rate
        return {"integral": integral}, wanted / DEGREES


_of = lambda end, group="pid_rate": [f"{group}.{axis}_{end}" for axis in AXES]
_FREE: Range = (-np.inf, np.inf)
_ROWS = [
    *rows_of_axes(_of("kp"), "1/(deg/s)", (250, 250, 120), _FREE, "kp"),
    *rows_of_axes(_of("ki"), "1/deg", (500, 500, 16.7), _FREE, "ki"),
    *rows_of_axes(_of("kd"), "1/(deg/s^2)", (2.5, 2.5, 0), _FREE, "kd"),
    *rows_of_axes(_of("kff"), "1/(deg/s)", (0, 0, 0), _FREE, "kff"),
    *rows_of_axes(_of("kp", "pid_attitude"), "1/s", (6, 6, 6), _FREE, "angle.kp"),
    *rows_of_axes(_of("ki", "pid_attitude"), "1/s^2", (3, 3, 1), _FREE, "angle.ki"),
    *rows_of_axes(_of("kd", "pid_attitude"), "", (0, 0, 0.35), _FREE, "angle.kd"),
    Parameter("pid_rate.rateFiltEn", "", 0, 0, 1, True),
    *rows_of_axes([f"pid_rate.om{x}FiltCut" for x in "xyz"], "Hz", (30,) * 3, (0, 250), ""),
]


class Crazyflie(Firmware):
    """The firmware of the Crazyflie, whose logs hold no parameters."""

    log = LOG
    parameters = {row.name: row for row in _ROWS}
    fields = ("kp", "ki", "kd")
    suffix = "yaml"
    motor_shares = (0.5, 0.5, 1.0)

    def flown_loop(self, values, version, *, throttle, tracked_hz):
        raise ValueError("logs of the Crazyflie hold no parameters, so they do not tell its loop")

    def channels(self, prefix: str, axis: int, values: Mapping[str, str]) -> Channels:
        return Channels()

    def si_scales(self, axis: str) -> tuple[float, float, float]:
        return 65535 / DEGREES, 65535 / DEGREES, 65535 / DEGREES

    def angle_parameters(self, axis: str, p: float) -> dict[str, float]:
        return {f"pid_attitude.{axis}_kp": p, f"pid_attitude.{axis}_ki": 0.0}

    def parameter_file(self, values, title, *, version, profile, raised, words):
        rows = ["params:"]
        for row, value, _ in values:
            rows += [
                f"  {row.name}:",
                f"    default_value: {number_text(row.default, row.integer)}",
                "    is_stored: true",
                f"    stored_value: {number_text(value, row.integer)}",
            ]
        head = [f"# {title}"] if title else []
        return joined_lines([*head, *rows, "type: persistent_param_state", "version: '1'"])


FIRMWARE = Crazyflie()
