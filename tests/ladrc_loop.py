"""LADRC with the current observer on gain / s^2 by NumPy alone, as one linear recursion."""

import numpy as np


DT = 0.002  # s


def loop(gain, b0, wc=10.0, wo=30.0, T=DT):
    """A, B, E of x+ = A x + B r + E torque / inertia, x = angle, rate and the three estimates.

    The estimates hold the measurement of the same sample.
    """
    zo, zc = np.exp(-wo * T), np.exp(-wc * T)
    kp, kd = (1 - zc) ** 2 / T**2, (1 - zc) * (3 + zc) / (2 * T)
    correct = np.array([1 - zo**3, 1.5 * (1 - zo) ** 2 * (1 + zo) / T, (1 - zo) ** 3 / T**2])
    ahead = np.array([[1, T, T**2 / 2], [0, 1, T], [0, 0, 1]])
    push = np.array([T**2 / 2, T, 0])

    def after(states, command, torque):
        """Columns of states a sample later."""
        angle_rate = ahead[:2, :2] @ states[:2] + np.outer(push[:2], gain * command + torque)
        predicted = ahead @ states[2:] + np.outer(push, b0 * command)
        return np.vstack([angle_rate, predicted + np.outer(correct, angle_rate[0] - predicted[0])])

    law = np.array([0, 0, -kp, -kd, -1.0]) / b0
    still, none, one = np.zeros((5, 1)), np.zeros(1), np.ones(1)
    A = after(np.eye(5), law, np.zeros(5))
    return A, after(still, kp / b0 * one, none)[:, 0], after(still, none, one)[:, 0]


def fly(gain, b0, samples, reference=0.0, torque=0.0, inertia=1.0):
    """States [samples, 5] from rest under a constant reference and a torque, one per sample."""
    A, B, E = loop(gain, b0)
    pushed = np.broadcast_to(np.asarray(torque) / inertia, samples)
    states = np.zeros((samples, 5))
    for k in range(1, samples):
        states[k] = A @ states[k - 1] + B * reference + E * pushed[k - 1]
    return states
