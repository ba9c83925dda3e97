"""Simulated flights of a PX4 in acro, by its equations in plain numbers, and their logs."""

import struct
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from log_writers import structured, ULog


GYRO_HZ, EACH = 8000, 20  # samples of the gyro for one of the loop, at 400 Hz
DT = EACH / GYRO_HZ
CUTOFF, SLOPE_HZ = 40.0, 30.0


def low_pass(cutoff: float) -> tuple[float, float, float]:
    """LowPassFilter2p: bilinear Butterworth, as its coefficients."""
    k = float(np.tan(np.pi * cutoff / GYRO_HZ))
    c = 1 + 2**0.5 * k + k * k
    return k * k / c, 2 * (k * k - 1) / c, (1 - 2**0.5 * k + k * k) / c


class Vehicle(NamedTuple):
    """A plant and its rate loop, the defaults of PX4."""

    gain: float = 60.0  # rad/s^2 per unit of torque
    lag: float = 0.03  # s
    late: int = 32  # samples of the gyro
    gains: tuple[float, float, float] = (0.15, 0.2, 0.003)
    cutoff: float = CUTOFF  # Hz, of the gyro
    slope: float = SLOPE_HZ  # Hz, of the D term
    curve: float = 0.0  # f of the thrust f x^2 + (1 - f) x; the gain is that at half throttle

    @property
    def parameters(self) -> dict[str, float]:
        """Those of its log."""
        return {
            **{f"MC_{axis}RATE_{k}": x for axis in ("ROLL", "PITCH", "YAW")
               for k, x in zip("PID", self.gains, strict=True)},
            "IMU_GYRO_RATEMAX": 400.0, "IMU_GYRO_CUTOFF": self.cutoff,
            "IMU_DGYRO_CUTOFF": self.slope,
        }  # fmt: skip

    def proposed(self, new: Mapping[str, float]) -> "Vehicle":
        """With what a proposal changes of roll."""
        gains = [new.get(f"MC_ROLLRATE_{k}", x) for k, x in zip("PID", self.gains, strict=True)]
        return self._replace(
            gains=tuple(gains),
            cutoff=new.get("IMU_GYRO_CUTOFF", self.cutoff),
            slope=new.get("IMU_DGYRO_CUTOFF", self.slope),
        )

    @property
    def share(self) -> float:
        """Of the D term's low-pass."""
        turn = 2 * np.pi * self.slope / GYRO_HZ
        return turn / (1 + turn)

    def at(self, throttle: float) -> "Vehicle":
        """The same at one throttle, which is the motors' command."""
        return self._replace(gain=self.gain * (1 - self.curve + 2 * self.curve * throttle), curve=0)

    def fly(
        self,
        seconds=30.0,
        amplitude=1.5,
        noise=0.05,
        gust=0.02,
        seed=3,
        throttles=(0.5,),
        setpoint=None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Set-point, torque and filtered rate at 400 Hz.

        A chirp from 0.5 to 30 Hz at each throttle, which take equal shares of the seconds, or
        another set-point at 400 Hz.
        """
        p, i, d = self.gains
        rng = np.random.default_rng(seed)
        each = int(seconds * GYRO_HZ) // len(throttles)
        steps = each * len(throttles)
        gains = np.repeat([self.at(x).gain for x in throttles], each).tolist()
        time = np.arange(steps) % each / GYRO_HZ
        rise = np.log(60.0) / (each / GYRO_HZ)
        sweep = np.sin(2 * np.pi * 0.5 * (np.exp(rise * time) - 1) / rise)
        r = (amplitude * sweep[::EACH] if setpoint is None else setpoint).tolist()
        jitter = (noise * rng.standard_normal(steps)).tolist()
        gusts = np.repeat(gust * rng.standard_normal(steps // 160 + 1), 160).tolist()
        decay, share = float(np.exp(-1 / (GYRO_HZ * self.lag))), self.share
        b, a1, a2 = low_pass(self.cutoff)
        sent, push, rate, u, integral = [0.0] * (steps + self.late), 0.0, 0.0, 0.0, 0.0
        s1 = s2 = y = slope = 0.0
        rates, torques = [], []
        for k in range(steps):
            before, now = y, rate + jitter[k]
            y = b * now + s1
            s1, s2 = 2 * b * now - a1 * y + s2, b * now - a2 * y
            slope += share * ((y - before) * GYRO_HZ - slope)
            if k % EACH == 0:
                error = r[k // EACH] - y
                u = p * error + integral - d * slope
                integral += max(0.0, 1 - (error / np.deg2rad(400.0)) ** 2) * i * error * DT
                rates.append(y)
                torques.append(u)
            sent[k + self.late] = u
            wanted = gains[k] * (sent[k] + gusts[k])
            rate += (wanted + (push - wanted) * self.lag * GYRO_HZ * (1 - decay)) / GYRO_HZ
            push = wanted + (push - wanted) * decay
        return np.array(r), np.array(torques), np.array(rates)

    def effect(self) -> float:
        """Root mean square of the rate in gusts alone: without bound where the loop is unstable."""
        rates = self.fly(seconds=5.0, amplitude=0.0, noise=0.0)[2]
        return float(np.sqrt(np.mean(rates**2)))

    def loop(self, omega: np.ndarray) -> np.ndarray:
        """L, from the same equations in the frequency domain."""
        p, i, d = self.gains
        s, z, gyro = 1j * omega, np.exp(1j * omega * DT), np.exp(1j * omega / GYRO_HZ)
        hold = (1 - 1 / z) / (s * DT)
        plant = self.gain / (s * (self.lag * s + 1)) * np.exp(-s * self.late / GYRO_HZ) * hold
        b, a1, a2 = low_pass(self.cutoff)
        smooth = b * (1 + 1 / gyro) ** 2 / (1 + a1 / gyro + a2 / gyro**2)
        slope = (1 - 1 / gyro) * GYRO_HZ * self.share / (1 - (1 - self.share) / gyro)
        return plant * smooth * (p + i * DT / (z - 1) + d * slope)


def write_log(path: Path, flown, parameters: Mapping[str, float], throttles=()) -> Path:
    """A ULog of a flight in acro, with the throttles if they are given."""
    r, u, y = flown
    log = ULog()
    for name, value in parameters.items():
        log.info(f"float {name}", struct.pack("<f", value), kind="P")
    log.define("vehicle_angular_velocity:uint64_t timestamp;float[3] xyz;")
    log.define("vehicle_torque_setpoint:uint64_t timestamp;float[3] xyz;")
    log.define("vehicle_rates_setpoint:uint64_t timestamp;float roll;float pitch;float yaw;")
    log.define("vehicle_status:uint64_t timestamp;uint8_t nav_state;")
    stamps = np.round(1e6 * (10 + np.arange(len(r)) * DT)).astype("<u8")
    clock, three = {"timestamp": ("<u8", stamps)}, np.array([[1.0, 0.0, 0.0]])
    tables = {
        "vehicle_angular_velocity": {"xyz": ("(3,)<f4", (y[:, None] * three).astype("<f4"))},
        "vehicle_torque_setpoint": {"xyz": ("(3,)<f4", (u[:, None] * three).astype("<f4"))},
        "vehicle_rates_setpoint": {
            name: ("<f4", r if name == "roll" else 0 * r) for name in ("roll", "pitch", "yaw")
        },
        "vehicle_status": {"nav_state": ("u1", np.full(len(r), 10))},
    }
    if throttles:
        log.define("vehicle_thrust_setpoint:uint64_t timestamp;float[3] xyz;")
        up = np.repeat(throttles, -(-len(r) // len(throttles)))[: len(r)]
        down = np.stack([0 * up, 0 * up, -up], axis=1).astype("<f4")
        tables["vehicle_thrust_setpoint"] = {"xyz": ("(3,)<f4", down)}
    for number, (name, columns) in enumerate(tables.items()):
        log.subscribe(number, name)
        log.write_rows(number, structured(clock | columns))
    path.write_bytes(log.content)
    return path
