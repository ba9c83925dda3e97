"""A firmware that is no part of the package: its log leads to its own parameter file."""

from typing import Any, ClassVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.signal import cont2discrete, lfilter, max_len_seq

import jaxquad as jq
from jaxquad.autopilot import (
    Channels,
    FilterChain,
    Firmware,
    FlownLoop,
    Numbers,
    Parameter,
    RateLoop,
)
from jaxquad.control import Setpoint
from jaxquad.records.firmware import FirmwareLog, Log, Reader, Setup, Table
from jaxquad.workflows import autopilot, AutopilotSettings


DT, GAIN, LAG, LATE = 0.004, 30.0, 0.03, 2  # s, rad/s^2, s, samples
P, I = 0.25, 0.3
AXES = ("roll", "pitch", "yaw")


class KestrelRate(RateLoop):
    """u = P e + I int e."""

    firmware: ClassVar[str] = "kestrel"
    p: Array
    i: Array
    d: Array
    gyro: FilterChain = FilterChain()
    dt: float = eqx.field(static=True, default=DT)

    def gains(self):
        return {"p": self.p, "i": self.i}

    def rest(self, zero):
        return {"integral": zero}

    def advance(self, memory, excess, reference, measurement):
        wanted = reference.angle if isinstance(reference, Setpoint) else reference
        error = wanted - measurement
        integral = memory["integral"] + self.i * error * self.dt
        zero = jnp.zeros_like(error)
        terms = {"P": self.p * error, "I": integral, "D": zero, "F": zero}
        return {"integral": integral}, terms["P"] + integral, terms


def setup(log, wanted):
    axis = wanted.axis or "roll"
    if not np.ptp(log.tables[""].columns[f"target_{axis}"]):
        raise jq.records.RecordError(f"the target of {axis} rests")
    return Setup(
        axis, {f"u_{axis}": 1.0}, f"rate_{axis}", f"target_{axis}", injected_at="rate"
    )  # fmt: skip


def load(path):
    with np.load(path) as file:
        columns: dict[str, Any] = dict(file)
    time, gains = columns.pop("time"), columns.pop("gains")
    settings = {f"K{'PI'[k]}_{x.upper()}": str(gain) for k, gain in enumerate(gains) for x in AXES}
    units = {f"{name}_{x}": "rad/s" for name in ("rate", "target") for x in AXES}
    return Log({"": Table(columns, time, units)}, vehicle="kestrel", settings=settings)


class Kestrel(Firmware):
    """All of it."""

    log = FirmwareLog(
        name="kestrel", title="Kestrel", setup=setup, hold=lambda log: (DT, ()),
        rates=[f"rate_{x}" for x in AXES], setpoints=[f"target_{x}" for x in AXES],
        reader=Reader("a Kestrel log", lambda head, path: path.suffix == ".kst", load),
    )  # fmt: skip
    parameters: ClassVar = {
        f"K{letter}_{x.upper()}": Parameter(
            f"K{letter}_{x.upper()}", "", 0.2, 0.01, 5.0, False, letter.lower(), k
        )
        for letter in "PI"
        for k, x in enumerate(AXES)
    }

    def flown_loop(self, values, version, *, throttle, tracked_hz):
        read = Numbers(values)
        p, i = (jnp.array([read.number(f"K{x}_{axis.upper()}") for axis in AXES]) for x in "PI")
        return FlownLoop(KestrelRate(p=p, i=i, d=jnp.zeros(3)))

    def channels(self, prefix, axis, values):
        x = AXES[axis]
        return Channels(terms=[f"p_{x}", f"i_{x}"], output={f"u_{x}": 1.0})

    def what_to_fly(self, axis):
        return f"Fly a chirp on {axis}"


@pytest.fixture
def kestrel(monkeypatch):
    """Known for the time of a test."""
    for registry in ("autopilot._firmware._FIRMWARES", "records._firmwares._OFFERED"):
        monkeypatch.setattr(f"jaxquad.{registry}", {})
    jq.autopilot.register(Kestrel())


@pytest.fixture
def flight(tmp_path):
    """A log of 40 s with a binary signal on the target of roll, in gusts and gyro noise."""
    count, random = 10_000, np.random.default_rng(3)
    target = np.repeat(max_len_seq(10)[0] - 0.5, 12)[:count]
    target = lfilter([0.2], [1, -0.8], np.pad(target, (0, count - target.size)))
    gust = lfilter([1], [1, -0.99], 0.03 * random.standard_normal(count))
    rates, inputs = np.array([[-1 / LAG, 0], [1, 0]]), np.array([[GAIN / LAG, 0], [0, 1]])
    discrete: Any = cont2discrete((rates, inputs, np.eye(2), 0), DT)
    A, B, *_ = discrete
    state, queue, integral, rows = np.zeros(2), [0.0] * LATE, 0.0, []
    for k in range(count):
        rate = state[1] + 0.002 * random.standard_normal()
        error = target[k] - rate
        integral += I * error * DT
        queue.append(P * error + integral)
        rows.append((rate, P * error, integral, queue[-1]))
        state = A @ state + B @ [queue.pop(0), gust[k]]
    rate, p, i, u = np.transpose(rows)
    flown = {"rate": rate, "target": target, "p": p, "i": i, "u": u}
    columns = {f"{name}_roll": x for name, x in flown.items()}
    columns |= {f"{name}_{x}": np.zeros(count) for name in flown for x in AXES[1:]}
    path = tmp_path / "flight.kst"
    with path.open("wb") as file:
        np.savez(file, time=DT * np.arange(count), gains=[P, I], **columns)
    return path


@pytest.mark.slow
def test_its_log_is_understood_and_its_gains_are_tuned_into_its_own_file(kestrel, flight, tmp_path):
    assert {"rate_roll", "u_yaw"} <= {channel.name for channel in jq.records.channels(flight)}
    proposal = jq.propose(flight)
    assert proposal.vehicle == "kestrel" and proposal.setup.hold == DT
    settings = AutopilotSettings(axis="roll", members=8, fresh=32, keep_filters=True)
    found: Any = autopilot(flight, settings)
    fit = found.identification.fit
    assert abs(fit["gain"] - GAIN) < 3 * fit.standard_errors[fit.names.index("gain")]
    assert found.reproduction.kind == "flown" and found.kind == "proposed", str(found)
    assert found.old == pytest.approx({"KP_ROLL": P, "KI_ROLL": I}, rel=1e-6)  # single precision
    assert set(found.new) == set(found.old)
    assert found.new["KP_ROLL"] > P and found.stages[-1].rejection < 0.9
    files = {path.name: path.read_text() for path in found.write(tmp_path / "out")}
    assert f"KP_ROLL,{found.new['KP_ROLL']:g}" in files["proposal_100.param"].splitlines()
    assert "KP_ROLL,0.25" in files["proposal_revert.param"].splitlines()
    assert "Kestrel" not in str(found) and "kestrel" in str(found)


def test_a_firmware_that_no_one_registered_is_named_with_those_that_are(flight):
    with pytest.raises(ValueError, match="'kestrel': give one of ardupilot, px4, betaflight, cra"):
        jq.autopilot.firmware_named("kestrel")
