"""Two flights of one made quadrotor as tables with PX4's names, for docs/ten_tasks.md."""

from pathlib import Path

import numpy as np

import jaxquad as jq


RATE_HZ = 250.0
TRUE = {"Lp": -1.0, "Lu": 1500.0, "Mq": -0.8, "Mu": 1125.0, "motor": -25.0, "delay": 0.01}
COLUMNS = (
    "timestamp", "vehicle_torque_setpoint.xyz[0]", "vehicle_torque_setpoint.xyz[1]",
    "vehicle_angular_velocity.xyz[0]", "vehicle_angular_velocity.xyz[1]",
)  # fmt: skip
NOISE = 0.02  # rad/s


def quadrotor() -> jq.StateSpace:
    """Torque set-points of roll and pitch to the rates p and q, with lags and delays."""
    t = TRUE
    F = np.diag([t["Lp"], t["Mq"], t["motor"], t["motor"]])
    F[0, 2], F[1, 3], F[1, 2] = t["Lu"], t["Mu"], 150.0  # roll pitches a little
    return jq.StateSpace(F, np.eye(4)[:, 2:], np.eye(4)[:2], input_delay=[t["delay"]] * 2)


def write_flights(folder: Path) -> None:
    """`first.csv`, a multisine on both axes at once, and `second.csv`, two sweeps in turn."""
    lines = jq.excitation.harmonics(1.0, 60.0, period=20.0)
    apart = [
        jq.multisine(lines[k::2], period=20.0, sample_rate=RATE_HZ, amplitude=0.1, periods=2).signal
        for k in (0, 1)
    ]
    sweep = jq.sweep(1.0, 60.0, duration=20.0, sample_rate=RATE_HZ, amplitude=0.1).signal
    still = np.zeros_like(sweep)
    turns = [np.concatenate([sweep, still]), np.concatenate([still, sweep])]
    for seed, (name, torques) in enumerate({"first": apart, "second": turns}.items()):
        _write(folder / f"{name}.csv", np.stack(torques, axis=1), seed)


def _write(path: Path, torques: np.ndarray, seed: int) -> None:
    rates = jq.models.simulate_linear(quadrotor(), torques, 1 / RATE_HZ)
    rates = np.asarray(rates) + np.random.default_rng(seed).normal(0.0, NOISE, rates.shape)
    stamps = 5_000_000 + np.round(np.arange(len(rates)) * 1e6 / RATE_HZ)  # us
    table = np.column_stack([stamps, torques, rates])
    np.savetxt(
        path, table, fmt=("%d", *["%.9g"] * 4), delimiter=",", header=",".join(COLUMNS), comments=""
    )
