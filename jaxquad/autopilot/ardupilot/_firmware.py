"""ArduPilot (Copter): its flown loop, parameters, channels and files."""

import dataclasses
import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxquad._core import Message
from jaxquad.identify import CurveFirmware
from jaxquad.records import AXES

from .._filters import Butterworth, FilterChain, PT1
from .._firmware import Channels, Firmware, LowPass, Numbers, OuterLoop, Parameter, rows_of_axes
from .._law import FlownLoop
from ._law import ArduPilotRate, HarmonicNotch, read_harmonic_notches, Tracking
from ._log import LOG


class FlownArduPilot(FlownLoop[ArduPilotRate]):
    """ArduPilot's rate loop of a log, with the notches that follow the throttle.

    **Arguments:** (those of `FlownLoop`, and)

    - `tracking`: which of the gyro's filters follow the throttle, and how.
    """

    tracking: tuple[Tracking, ...] = eqx.field(static=True, default=())

    def at(self, throttle: Float[ArrayLike, "..."]) -> ArduPilotRate:
        """The law at a throttle of 0 to 1: where its notches are."""
        filters = list(self.law.gyro.filters)
        for notch_tracking in self.tracking:
            notch = filters[notch_tracking.place]
            assert isinstance(notch, HarmonicNotch)
            filters[notch_tracking.place] = dataclasses.replace(
                notch, centre_hz=notch_tracking.centre_hz(throttle)
            )
        chain = FilterChain(tuple(filters), self.law.gyro.rate_hz)
        return dataclasses.replace(self.law, gyro=chain)


def ardupilot_loop(
    values: Mapping[str, str],
    *,
    throttle: float = 0.3,
    tracked_hz: Mapping[int, Sequence[float]] | None = None,
) -> FlownArduPilot:
    """The rate loop of ArduPilot's parameters (Copter).

    **Arguments:**

    - `values`: the parameters by name. The gyro's rate is rounded up to a multiple of the loop's.
    - `throttle`: 0 to 1 of the mixer (`RATE.AOut`), where notches are that follow it.
    - `tracked_hz`: what harmonic notches follow that go by an RPM sensor (2, 5), ESC telemetry (3)
        or the gyro's spectrum (4), in Hz: by INS_HNTCH_MODE, with a number for each source.

    **Raises:**

    - `ValueError`: a gain is missing.
    """
    read = Numbers(values)
    rate = read.number("SCHED_LOOP_RATE", 400.0)
    gyro_rate = 1000.0 * 2 ** read.number("INS_GYRO_RATE", 0.0)
    gyro_rate = rate * max(1, math.ceil(gyro_rate / rate - 1e-9))
    per_axis = lambda end, default=None: [
        read.number(f"ATC_RAT_{x}_{end}", default) for x in ("RLL", "PIT", "YAW")
    ]
    limit = np.array(per_axis("PDMX", 0.0))
    cutoff = read.number("INS_GYRO_FILTER", 20.0)
    notches = read_harmonic_notches(read.number, tracked_hz or {})
    low_pass = (Butterworth(cutoff),) if cutoff > 0 else ()
    law = ArduPilotRate(
        p=per_axis("P"), i=per_axis("I"), d=per_axis("D"), ff=per_axis("FF", 0.0),
        d_ff=per_axis("D_FF", 0.0), gyro=FilterChain((*notches.filters, *low_pass), gyro_rate),
        target_hz=per_axis("FLTT", 20.0), error_hz=per_axis("FLTE", 0.0),
        derivative_hz=per_axis("FLTD", 20.0), integral_limit=per_axis("IMAX", 0.5),
        pd_limit=np.where(limit > 0, limit, np.inf), dt=1 / rate,
    )  # fmt: skip
    switched = {
        **{f"ATC_RAT_{x}_SMAX": "the slew limiter lowers P and D" for x in ("RLL", "PIT", "YAW")},
        **{
            f"ATC_RAT_{x}_{n}": Message("a notch", "notch")
            for x in ("RLL", "PIT", "YAW")
            for n in ("NTF", "NEF")
        },
        "FSTRATE_ENABLE": "the rate loop runs faster than SCHED_LOOP_RATE",
    }
    left_out = [
        Message(f"{name}: {what}", Message(what).kind)
        for name, what in switched.items()
        if read.number(name, 0.0) > 0
    ]
    flown = FlownArduPilot(law, (*left_out, *notches.unmodelled), notches.tracking)
    return dataclasses.replace(flown, law=flown.at(throttle))


def _table() -> list[Parameter]:
    short = ("RLL", "PIT", "YAW")
    of = lambda end: [f"ATC_RAT_{axis}_{end}" for axis in short]
    two = lambda level, yaw: (level, level, yaw)
    return [
        *rows_of_axes(of("P"), "", (0.135, 0.135, 0.18), two((0.01, 0.5), (0.1, 2.5)), "p"),
        *rows_of_axes(of("I"), "1/s", (0.135, 0.135, 0.018), two((0.01, 2), (0.01, 1)), "i"),
        *rows_of_axes(of("D"), "s", (0.0036, 0.0036, 0), two((0, 0.05), (0, 0.02)), "d"),
        *rows_of_axes(of("FF"), "", (0, 0, 0), (0, 0.5), "ff"),
        *rows_of_axes(of("D_FF"), "s", (0, 0, 0), (0, 0.02), "d_ff"),
        *rows_of_axes(of("IMAX"), "", (0.5,) * 3, (0, 1), "integral_limit"),
        *rows_of_axes(of("FLTT"), "Hz", (20,) * 3, two((5, 100), (1, 50)), "target_hz"),
        *rows_of_axes(of("FLTE"), "Hz", (0, 0, 2.5), two((0, 100), (0, 20)), "error_hz"),
        *rows_of_axes(of("FLTD"), "Hz", (20,) * 3, two((5, 100), (5, 50)), "derivative_hz"),
        *rows_of_axes(of("SMAX"), "", (0,) * 3, (0, 200), ""),
        *rows_of_axes(
            [f"ATC_ANG_{axis}_P" for axis in short], "1/s", (4.5,) * 3, (3, 12), "angle.p"
        ),
        Parameter("INS_GYRO_FILTER", "Hz", 20, 0, 256, True, "gyro"),
        Parameter("MOT_THST_EXPO", "", 0.65, -1, 1),
    ]


_SHORT = ("RLL", "PIT", "YAW")
_POST, _BOTH = 4, 8  # of INS_RAW_LOG_OPT: behind the filters, or before and behind them
_GYRO = re.compile(r"(GYR(\d|\[\d\])?)\.GyrX")


class ArduPilot(Firmware):
    """ArduPilot, Copter; files hold a name and a value in a line, as Mission Planner has them."""

    log = LOG
    parameters = {row.name: row for row in _table()}
    unit = "ROut"
    motor_shares = (0.5, 0.5, 0.5)
    follows_throttle = True
    thrust_curve = "MOT_THST_EXPO"
    weighs_setpoint = True

    def flown_loop(
        self, values: Mapping[str, str], version: Sequence[int], *, throttle: float,
        tracked_hz: Mapping[int, Sequence[float]],
    ) -> FlownLoop:  # fmt: skip
        return ardupilot_loop(values, throttle=throttle, tracked_hz=tracked_hz)

    def channels(self, prefix: str, axis: int) -> Channels:
        letter = "RPY"[axis]
        return Channels(
            terms=[f"PID{letter}.{x}" for x in ("P", "I", "D", "FF")],
            motors=[f"RCOU.C{k}" for k in range(1, 5)],
            output={f"RATE.{letter}Out": 1.0},
            slewed={f"PID{letter}.Dmod": 1.0},
        )

    def what_to_fly(self, axis: str) -> str:
        rate = 7 + AXES.index(axis)
        return (
            f"Fly this: SID_AXIS {rate + 3} (mixer, {axis}; or {rate}, rate), SID_F_START_HZ 0.5, "
            "SID_F_STOP_HZ 20, SID_T_REC 30, LOG_BITMASK with fast attitude and PIDs; hover high "
            "and clear in Loiter, switch to mode SystemID for 30 s, back to end. Begin with a "
            "small SID_MAGNITUDE and raise it until the vehicle is seen to shake"
        )

    def unfiltered_gyro(
        self, names: frozenset[str], values: Mapping[str, str], median: Callable[[str], float]
    ) -> Sequence[str]:
        """That of the filter that flew, else the first; none where it is logged behind the filters.

        Its messages are GYR[0], in older logs GYR1 or GYR. Where both kinds are logged, those
        behind the filters have the higher numbers. The filter that flew is XKF4.PI, and each of
        them has an IMU of EK3_IMU_MASK.
        """
        options = int(float(values.get("INS_RAW_LOG_OPT", 0.0)))
        tables = [hit[1] for name in names if (hit := _GYRO.fullmatch(name))]
        if not tables or (options & _POST and not options & _BOTH):
            return []
        mask = int(float(values.get("EK3_IMU_MASK", 3.0)))
        imus, core = [i for i in range(8) if mask >> i & 1], int(median("XKF4[0].PI"))
        used = f"GYR[{imus[core] if core < len(imus) else 0}]"
        table = used if used in tables else min(tables)
        return [f"{table}.Gyr{letter}" for letter in "XYZ"]

    def tracked_channels(self) -> Mapping[int, str]:
        return {
            3: r"ESC(\[\d+\])?\.RPM", 2: r"RPM(\.rpm1|\[0\]\.RPM)",
            5: r"RPM(\.rpm2|\[1\]\.RPM)",
        }  # fmt: skip

    def motor_ends(self, values: Mapping[str, str]) -> tuple[float, float]:
        number = Numbers(values).number
        low, high = number("MOT_PWM_MIN", 1000.0), number("MOT_PWM_MAX", 2000.0)
        ends = number("MOT_SPIN_MIN", 0.15), number("MOT_SPIN_MAX", 0.95)
        return low + ends[0] * (high - low), low + ends[1] * (high - low)

    def angle_loop(
        self, values: Mapping[str, str], axis: int, dt: float, *, levelled: bool
    ) -> OuterLoop | None:
        return OuterLoop.of(values, f"ATC_ANG_{_SHORT[axis]}_P", 1.0, dt, closed=True)

    def low_passes(
        self, loop: FlownLoop, values: Mapping[str, str], version: Sequence[int], axis: int,
        throttle: float,
    ) -> Iterator[LowPass]:  # fmt: skip
        law, of_axis = loop.law, lambda x: float(np.broadcast_to(x, (3,))[axis])
        for x in law.gyro.filters:
            if isinstance(x, Butterworth):
                flown = {"INS_GYRO_FILTER": float(x.cutoff_hz)}
                yield LowPass("gyro", flown, x, law.gyro.rate_hz)
        slope = of_axis(law.derivative_hz)
        if slope > 0 and of_axis(law.d) > 0:
            flown = {f"ATC_RAT_{_SHORT[axis]}_FLTD": slope}
            yield LowPass("derivative", flown, PT1(slope), 1 / law.dt, shared=False)

    def curve_kind(self, version: Sequence[int]) -> CurveFirmware:
        return "ardupilot"

    def angle_parameters(self, axis: str, p: float) -> dict[str, float]:
        return {f"ATC_ANG_{_SHORT[AXES.index(axis)]}_P": p}


FIRMWARE = ArduPilot()
