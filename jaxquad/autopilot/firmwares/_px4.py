"""PX4: its rate and attitude loops, parameters, channels and files."""

import dataclasses
from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._core import as_float, broadcast_gain, Message, per_member, require_positive
from jaxquad.control import Reference, Setpoint
from jaxquad.records import AXES

from .._filters import BandwidthNotch, Butterworth, Filter, FilterChain, PT1, Section
from .._firmware import (
    Channels,
    Firmware,
    Numbers,
    OuterLoop,
    Parameter,
    Range,
    RecipeOption,
    rows_of_axes,
)
from .._law import (
    Advance,
    AngleLoop,
    bounded,
    FlownLoop,
    Memories,
    RateLoop,
    Signal,
    split_reference,
    sum_of,
)
from ._logs import PX4 as LOG


_FADED = np.deg2rad(400.0)  # rad/s of error at which the integral no longer grows


class PX4Rate(RateLoop):
    """PX4's rate loop: rates in rad/s in, the normalised torque set-point out.

        u = K P e + I - K D y' + FF r,    I += (1 - (e / 400 deg/s)^2) K I_gain T e afterwards

    The derivative is taken and low-passed at the gyro's rate, and acts on the measurement alone.
    The integral stops where the allocator gave less than was asked for (`applied`). Source:
    docs/autopilots.md.

    !!! example

        ```python
        law = PX4Rate(p=0.15, i=0.2, d=0.003, gyro=FilterChain((Butterworth(40.0),), 8000.0))
        ```

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `p`, `i`, `d`, `k`, `ff`: MC_xRATE_P, _I, _D, _K, _FF; ff is not multiplied by k.
    - `gyro`: filters at the gyro's rate: notches and IMU_GYRO_CUTOFF (40 Hz).
    - `derivative_hz`: IMU_DGYRO_CUTOFF, 0 is off.
    - `torque_hz`: MC_YAW_TQ_CUTOFF on yaw (2 Hz), 0 is off and belongs on roll and pitch.
    - `integral_limit`: MC_xR_INT_LIM.
    - `dt`: of the rate loop in s, 1/IMU_GYRO_RATEMAX.
    """

    firmware: ClassVar[str] = "px4"
    factors: ClassVar[tuple[str, ...]] = ("k",)
    feed_forward: ClassVar[tuple[str, ...]] = ("ff",)
    limits: ClassVar[tuple[str, ...]] = ("integral_limit", "derivative_hz", "torque_hz")
    p: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    i: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    d: Float[Array, "..."] = per_member(rank=1, converter=as_float)
    k: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=1.0)
    ff: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    gyro: FilterChain = FilterChain()
    derivative_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=20.0)
    torque_hz: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.0)
    integral_limit: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=0.3)
    dt: float = eqx.field(static=True, default=1 / 400)  # s

    def derivative_chain(self, axis: int) -> FilterChain:
        cutoff = float(np.broadcast_to(self.derivative_hz, (3,))[axis])
        return FilterChain((PT1(cutoff),) if cutoff > 0 else (), self.gyro.rate_hz)

    def without_gyro_filters(self) -> "PX4Rate":
        # The derivative stays at the gyro's rate.
        open = FilterChain((PT1(0.0),), self.gyro.rate_hz) if self.gyro.filters else FilterChain()
        return dataclasses.replace(self, gyro=open)

    @property
    def _derivative(self) -> tuple[Section, ...]:
        """The difference at the gyro's rate, and its low-pass."""
        rate_hz = self.gyro.rate_hz if self.gyro.filters else 1 / self.dt
        slope = jnp.full((), rate_hz, self.p.dtype)
        difference = Section(slope, -slope, jnp.zeros_like(slope))
        return difference, *PT1(self.derivative_hz).sections(rate_hz)

    def rest(self, zero: Signal) -> dict[str, PyTree]:
        gyro = self.gyro_rest(zero, *self._derivative)
        return {"gyro": gyro, "integral": zero, "torque": zero}

    def advance(
        self, memory: Memories, excess: Signal, reference: Reference, measurement: Signal
    ) -> Advance:
        at = lambda gain: broadcast_gain(gain, measurement)
        r, _ = split_reference(reference, measurement, self.dt)
        gyro, (y, slope) = self.filter_gyro(memory["gyro"], measurement, *self._derivative)
        error, k, integral = r - y, at(self.k), memory["integral"]
        terms = {
            "P": k * at(self.p) * error, "I": integral,
            "D": -k * at(self.d) * slope, "F": at(self.ff) * r,
        }  # fmt: skip
        open = jnp.where(excess > _UNALLOCATED, jnp.minimum(error, 0.0), error)
        open = jnp.where(excess < -_UNALLOCATED, jnp.maximum(open, 0.0), open)
        fade = jnp.maximum(0.0, 1 - (open / _FADED) ** 2)
        grown = integral + fade * k * at(self.i) * open * self.dt
        torque = self.low_passed(self.torque_hz, memory["torque"], sum_of(terms))
        integral = bounded(grown, self.integral_limit)
        return {"gyro": gyro, "integral": integral, "torque": torque}, torque, terms


_UNALLOCATED = 1e-6  # of the normalised torque, above which the axis counts as saturated


class PX4Attitude(AngleLoop):
    """PX4's attitude loop around a rate loop: angles in rad in, normalised torque out.

    The rate's set-point is `p` times the error of the angle, plus a `Setpoint`'s rate, within
    `rate_limit`. There is no integral and no derivative of the angle. Source: docs/autopilots.md.

    **Arguments:** (each number is a scalar, one value per axis, or `[axes, *ensemble]`)

    - `rate`: the `PX4Rate` inside.
    - `p`: MC_ROLL_P, MC_PITCH_P, MC_YAW_P in 1/s.
    - `rate_limit`: MC_xRATE_MAX in rad/s, 220 deg/s by default.

    **Raises:** `ValueError`: `p` or the limit is not above 0.
    """

    rate: PX4Rate
    p: Float[Array, "..."] = per_member(rank=1, converter=as_float, default=4.0)
    rate_limit: Float[Array, "..."] = per_member(
        rank=1, converter=as_float, default=np.deg2rad(220.0)
    )

    def __check_init__(self):
        require_positive("p", self.p, "give 1/s")
        require_positive("rate_limit", self.rate_limit, "give rad/s")

    def wanted_rate(
        self, memory: Memories, aim: Setpoint, angle: Signal, rate: Signal
    ) -> tuple[dict[str, PyTree], Signal]:
        wanted = broadcast_gain(self.p, angle) * (aim.angle - angle) + aim.rate
        return {}, bounded(wanted, self.rate_limit)


_of = lambda end: [f"MC_{axis.upper()}RATE_{end}" for axis in AXES]


def px4_loop(values: Mapping[str, str], *, gyro_rate_hz: float = 8000.0) -> FlownLoop[PX4Rate]:
    """The rate loop of PX4's parameters.

    **Arguments:**

    - `values`: the parameters by name.
    - `gyro_rate_hz`: at which the gyro's filters run, which no parameter says; it is rounded to a
        multiple of the loop's.

    **Raises:** `ValueError`: a gain is missing.
    """
    read = Numbers(values)
    rate = read.number("IMU_GYRO_RATEMAX", 400.0) or 400.0
    chain: list[Filter] = [
        BandwidthNotch(centre, read.number(f"IMU_GYRO_NF{k}_BW", 20.0))
        for k in (0, 1) if (centre := read.number(f"IMU_GYRO_NF{k}_FRQ", 0.0)) > 0
    ]  # fmt: skip
    cutoff = read.number("IMU_GYRO_CUTOFF", 40.0)
    chain += [Butterworth(cutoff)] if cutoff > 0 else []
    per_axis = lambda end, default=None: [read.number(name, default) for name in _of(end)]
    law = PX4Rate(
        p=per_axis("P"), i=per_axis("I"), d=per_axis("D"), k=per_axis("K", 1.0),
        ff=per_axis("FF", 0.0),
        gyro=FilterChain(tuple(chain), rate * max(1, round(gyro_rate_hz / rate))),
        derivative_hz=read.number("IMU_DGYRO_CUTOFF", 20.0),
        torque_hz=[0.0, 0.0, read.number("MC_YAW_TQ_CUTOFF", 0.0)],
        integral_limit=[read.number(f"MC_{x}R_INT_LIM", 0.3) for x in "RPY"], dt=1 / rate,
    )  # fmt: skip
    left_out = {
        "IMU_GYRO_DNF_EN": ("dynamic notches follow motors or spectrum", "notch"),
        "MC_BAT_SCALE_EN": ("the torque is scaled by the battery's voltage", ""),
    }
    return FlownLoop(law, tuple(
        Message(f"{name}: {what}", kind)
        for name, (what, kind) in left_out.items() if read.number(name, 0.0) > 0
    ))  # fmt: skip


_ESTIMATE = 0.004  # s, from one attitude estimate to the next
_ABOVE: Range = (0, np.inf)
_ROWS = [
    *rows_of_axes(_of("P"), "", (0.15, 0.15, 0.2), ((0.01, 0.5), (0.01, 0.6), (0, 0.6)), "p"),
    *rows_of_axes(_of("I"), "1/s", (0.2, 0.2, 0.1), _ABOVE, "i"),
    *rows_of_axes(_of("D"), "s", (0.003, 0.003, 0), ((0, 0.01), _ABOVE, _ABOVE), "d"),
    *rows_of_axes(_of("K"), "", (1, 1, 1), (0.01, 5), "k"),
    *rows_of_axes(_of("FF"), "", (0, 0, 0), _ABOVE, "ff"),
    *rows_of_axes([f"MC_{x}R_INT_LIM" for x in "RPY"], "", (0.3,) * 3, _ABOVE, "integral_limit"),
    *rows_of_axes(
        [f"MC_{axis.upper()}_P" for axis in AXES], "1/s", (4, 4, 2.8),
        ((0, 12), (0, 12), (0, 5)), "angle.p",
    ),
    *rows_of_axes(_of("MAX"), "deg/s", (220, 220, 200), (0, 1800), ""),
    Parameter("MC_YAW_TQ_CUTOFF", "Hz", 2, 0, np.inf, False, "torque_hz", 2),
    Parameter("IMU_GYRO_CUTOFF", "Hz", 40, 0, 1000, False, "gyro"),
    Parameter("IMU_DGYRO_CUTOFF", "Hz", 20, 0, 1000, False, "derivative_hz"),
    *(Parameter(f"IMU_GYRO_NF{k}_FRQ", "Hz", 0, 0, np.inf) for k in (0, 1)),
    *(Parameter(f"IMU_GYRO_NF{k}_BW", "Hz", 20, 0, np.inf) for k in (0, 1)),
    Parameter("IMU_GYRO_RATEMAX", "Hz", 400, 100, 2000, True),
    Parameter("THR_MDL_FAC", "", 0, 0, 1),
    Parameter("MC_AIRMODE", "", 0, 0, 2, True),
]  # fmt: skip


# Default and high-rate topics; a log that a switch starts. Then what the firmware has.
_LOGGING = {"SDLOG_PROFILE": 1 + 16, "SDLOG_MODE": 3}
_USUAL_LOGGING = {"SDLOG_PROFILE": 1, "SDLOG_MODE": 0, "RC_MAP_AUX1": 0}
_LOG_SWITCH = RecipeOption("switch", 8, 5, 18, "the RC channel of the switch that starts the log")


class PX4(Firmware):
    """PX4, multicopters."""

    log = LOG
    parameters = {row.name: row for row in _ROWS}
    unit = "torque set-point"
    suffix = "params"
    file_head = ("#", "# Vehicle-Id Component-Id Name Value Type")
    motor_shares = (np.sqrt(0.5), np.sqrt(0.5), 1.0)
    averages_gyro = True
    thrust_curve = "THR_MDL_FAC"
    weighs_setpoint = True
    notches = tuple((f"IMU_GYRO_NF{k}_FRQ", f"IMU_GYRO_NF{k}_BW") for k in (0, 1))

    def flown_loop(self, values, version, *, throttle, tracked_hz):
        return px4_loop(values)

    def channels(self, prefix: str, axis: int, values: Mapping[str, str]) -> Channels:
        return Channels(
            unfiltered=[f"sensor_combined.gyro_rad[{k}]" for k in range(3)],
            motors=[f"actuator_motors.control[{k}]" for k in range(4)],
            output={f"vehicle_torque_setpoint.xyz[{axis}]": 1.0},
        )

    def recipe(self, axes, *, amplitude=None, switch=None):
        if amplitude is not None:
            text = f"`amplitude` is {amplitude:g}, but PX4 is excited by the sticks: leave it out."
            raise ValueError(text)
        channel = int(_LOG_SWITCH.choose(switch))
        lines = lambda values: [f"param set {x} {value}" for x, value in values.items()]
        sticks, length = " stick, then ".join(axes), "20 s each" if len(axes) > 1 else "20 s"
        paste = _LOGGING | {"RC_MAP_AUX1": channel}
        return self.make_recipe(
            axes, lines(paste), lines(_USUAL_LOGGING), load=(paste, _USUAL_LOGGING),
            before="Save all parameters to a file. Type the lines into the MAVLink console, or "
            "load them as a file (.params) in QGroundControl, then restart. RC channel "
            f"{channel} has to be a free switch: it starts the log, which has to be flown in Acro "
            "from beginning to end. Put Acro on the mode switch (6 in one of COM_FLTMODE1 to "
            "COM_FLTMODE6). Full stick (MC_ACRO_R_MAX, MC_ACRO_P_MAX, MC_ACRO_Y_MAX) is 100 deg/s "
            "by default.",
            flight=f"in Position mode. Change to Acro, turn the log's switch (channel {channel}) "
            f"on, and give strong and quick {sticks} stick for {length}: to both sides in turn, "
            "0.2 to 0.5 s long, at 50 to 100 deg/s. Turn the log's switch off before you leave "
            "Acro.",
            abort="Change to Position mode: it levels the vehicle and holds it.",
            after="Land and download the log. It holds vehicle_angular_velocity and "
            "vehicle_torque_setpoint at 100 Hz or more, vehicle_rates_setpoint, which follows the "
            "sticks, and vehicle_status.nav_state 10 (Acro) throughout.",
            log="flight.ulg",
        )  # fmt: skip

    def angle_loop(self, values, axis, dt, *, levelled):
        name = f"MC_{AXES[axis].upper()}_P"
        return OuterLoop.of(values, name, 1.0, 0.5 * _ESTIMATE + dt, closed=True)

    def notch(self, centre_hz: float, half_width: float) -> tuple[float, Filter]:
        width = float(np.rint(2 * half_width * centre_hz))
        return width, BandwidthNotch(centre_hz, width)

    def file_line(self, name: str, text: str, is_whole: bool) -> str:
        return f"1\t1\t{name}\t{text}\t{6 if is_whole else 9}"  # int32, float


FIRMWARE = PX4()
