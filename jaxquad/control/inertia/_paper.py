"""Section 4.1 of the paper, Eq. (15)-(24), in its symbols and corrected as docs/equations.md says.

`WindowedInertia` is what flies; the tests hold it against these lines. Arrays have samples on their
first axis where a function takes integrals, and any one shape where it does not.

J_x and J_n are the true and the nominal inertia in kg m^2, phi the roll angle in rad, u = tau_x the
torque in N m, lam the observer's pole in rad/s, M_c the estimate of the disturbance in N m.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float


Signal = Float[Array, "..."]
Number = float | Float[Array, ""]


def disturbed_axis(
    J_x: Number,
) -> tuple[Float[Array, "2 2"], Float[Array, " 2"], Float[Array, " 2"]]:
    """Eq. (15), (16): A, B and C of J_x phi'' = u + tau_M, with x = [phi', tau_M] and y = phi'."""
    A = jnp.array([[0.0, 1.0], [0.0, 0.0]]) / J_x
    B = jnp.array([1.0, 0.0]) / J_x
    C = jnp.array([1.0, 0.0])
    return A, B, C


def observe_disturbance(
    z: Signal, phi_dot: Signal, u: Signal, *, J_n: Number, lam: Number
) -> tuple[Signal, Signal]:
    """Eq. (17): z' and M_c of the observer of least order."""
    z_dot = -lam * z + lam * J_n * phi_dot + u
    M_c = -lam * z + lam * J_n * phi_dot
    return z_dot, M_c


def estimate_disturbance(q0_dot: Signal, q1: Signal, *, J_n: Number) -> Signal:
    """Eq. (18) with (19) in it: M_c = J_n q0' - q1; the printed (18) lacks a filter."""
    return J_n * q0_dot - q1


def filter_signals(
    q0: Signal, q1: Signal, phi_dot: Signal, u: Signal, *, lam: Number
) -> tuple[Signal, Signal]:
    """Eq. (19): q0' and q1' of the filters of rate and torque."""
    return -lam * q0 + lam * phi_dot, -lam * q1 + lam * u


def disturbance_slope(
    M_c: Signal, phi_dot: Signal, phi_ddot: Signal, *,
    dJ: Number, K_afx: Number, M_g: Number, lam: Number,
) -> Signal:  # fmt: skip
    """Eq. (20): M_c' under dJ = J_x - J_n, drag and a constant load; printed with phi' and J_x."""
    return -lam * M_c - lam * (dJ * phi_ddot + K_afx * phi_dot + M_g)


def expected_disturbance(
    q0: Signal, q0_dot: Signal, t: Signal, *,
    dJ: Number, K_afx: Number, M_g: Number, lam: Number,
) -> Signal:  # fmt: skip
    """Eq. (21): M_c from rest at t = 0; printed with q0 for its derivative and q1 for the rise."""
    return -dJ * q0_dot - K_afx * q0 - M_g * (1 - jnp.exp(-lam * t))


def paper_inertia(
    q0: Float[Array, " samples"], q1: Float[Array, " samples"], *, J_n: Number, dt: float
) -> Float[Array, ""]:
    """Eq. (22)-(24): the inertia in kg m^2 over one window of samples.

    J_n cancels: what is left is the regression of q1 on q0'. It is the inertia itself where the
    integrals of q0 q0' and of q0' vanish, over whole periods of a steady motion.

    **Arguments:**

    - `q0`, `q1`: Eq. (19) at the same samples: `q0` of the mean rate over the sample interval, in
        rad/s, `q1` of the mean torque over it and the one before, in N m. For torques that are held
        over each interval the estimate is then exact.
    - `J_n`: the nominal inertia in kg m^2.
    - `dt`: the sample interval in s.

    **Returns:**

    The estimate of J_x.
    """
    q0_dot = jnp.diff(q0) / dt
    M_c = estimate_disturbance(q0_dot, q1[1:], J_n=J_n)
    dJ = -jnp.sum(M_c * q0_dot) / jnp.sum(q0_dot**2)  # (22) summed, (23)
    return J_n + dJ  # (24)
