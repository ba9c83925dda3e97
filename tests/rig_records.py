"""Records of the rig's roll axis under a sampled LADRC, by NumPy alone: what an estimator hears.

J phi'' = KT u_m - k phi + d with the drive's lag u_m' = (u - u_m) / lag, stepped exactly.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import expm


DT = 0.002
INERTIA = 0.0552  # kg m^2
TORQUE_GAIN = 0.0234036  # N m/V, of V4 - V2
COUNT = 2 * np.pi / 8192


class RigRecord(NamedTuple):
    """`command[k]` was held during the 2 ms before `measurement[k]`; [samples, 1, members]."""

    command: np.ndarray  # V
    measurement: np.ndarray  # rad


def fly(
    *,
    duration: float,
    members: int = 1,
    seed: int = 0,
    inertia=lambda t: INERTIA,
    tones=((0.3, 2.0),),  # (V, Hz)
    sine: float = 0.0,  # N m, 5 s
    offset: float = 0.0,  # N m
    gust: float = 0.0,  # N m, standard deviation, corner 2 rad/s
    noise: float = 0.0,  # rad
    counted: bool = True,
    lag: float = 0.02,
    stiffness: float = 0.0,
    b0: float | None = None,
    torque_gain: float = TORQUE_GAIN,
    reference=lambda t: 0.0,
    closed: bool = True,
) -> RigRecord:
    rng = np.random.default_rng(seed)
    b0 = torque_gain / INERTIA if b0 is None else b0
    steps = {}
    samples = round(duration / DT)
    state = np.zeros((3, members))  # angle, rate, lagged command
    z = np.zeros((3, members))
    law = _ladrc(10.0, 30.0)
    wind = np.zeros(members)
    keep = np.exp(-2.0 * DT)
    held = np.zeros(members)
    commands, angles = np.empty((2, samples, 1, members))
    for k in range(samples):
        time = k * DT
        angle = state[0] + noise * rng.standard_normal(members)
        if counted:
            angle = COUNT * np.round(angle / COUNT)
        commands[k, 0], angles[k, 0] = held, angle
        z, feedback = _step(law, z, angle, reference(time), b0, held)
        tone = sum(v * np.sin(2 * np.pi * f * time) for v, f in tones)
        held = tone + feedback if closed else np.full(members, tone)
        wind = keep * wind + gust * np.sqrt(1 - keep**2) * rng.standard_normal(members)
        torque = wind + offset + sine * np.sin(2 * np.pi * time / 5.0)
        J = inertia(time)
        if J not in steps:
            steps[J] = _exact(J, stiffness, lag, torque_gain)
        A, B = steps[J]
        state = A @ state + B @ np.stack([held, torque])
    return RigRecord(commands, angles)


def _exact(J, stiffness, lag, torque_gain):
    """The plant's transition over 2 ms under held command and torque."""
    F = np.zeros((5, 5))
    F[0, 1] = 1.0
    F[1, 0], F[1, 2], F[1, 4] = -stiffness / J, torque_gain / J, 1 / J
    if lag:
        F[2, 2], F[2, 3] = -1 / lag, 1 / lag
    else:
        F[1, 2], F[1, 3] = 0.0, torque_gain / J
    E = expm(F * DT)
    return E[:3, :3], E[:3, 3:]


def _ladrc(wc, wo):
    zo, zc = np.exp(-wo * DT), np.exp(-wc * DT)
    gains = np.array([1 - zo**3, 1.5 * (1 - zo) ** 2 * (1 + zo) / DT, (1 - zo) ** 3 / DT**2])
    return gains, (1 - zc) ** 2 / DT**2, (1 - zc) * (3 + zc) / (2 * DT)


def _step(law, z, angle, reference, b0, held):
    gains, kp, kd = law
    A = np.array([[1, DT, DT**2 / 2], [0, 1, DT], [0, 0, 1]])
    z = A @ z + np.array([DT**2 / 2, DT, 0])[:, None] * b0 * held
    z = z + gains[:, None] * (angle - z[0])
    return z, (kp * (reference - z[0]) - kd * z[1] - z[2]) / b0
