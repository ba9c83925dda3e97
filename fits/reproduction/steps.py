"""Section 5.3, Figures 8 and 9: steps under PID, LADRC and adaptive LADRC."""

import numpy as np

import jaxquad as jq

from .loops import (
    DT,
    END,
    INERTIA,
    ladrc,
    LEVER,
    Response,
    responses,
    rig,
    run_step,
    SHEET,
    START,
    step,
    TORQUE_GAINS,
    VOLTAGE,
    WC,
    WO,
)


LARGE, SMALL = np.radians(3.0), np.radians(1.0)  # from 1 to 4 deg, and 1 deg
FRICTION = 0.005  # N m
LIMIT = 0.5  # V, below what any part of the rig imposes
LAG = 0.02  # s
PID_GAINS = (0.01, 0.05, 0.15)
BEFORE, AFTER, MATCHED = f"b0 = {START:g}", f"b0 = {END:g}", "b0 = b"
PRINTED = {"b0 = 4": 4.0, "b0 = 27": 27.0}  # what Eq. (25) makes of 3

Steps = dict[tuple[str, str], Response]  # by reading of u and controller


def linear_steps() -> Steps:
    """LADRC on b / s^2 with the paper's two b0, the right one, and those of the printed map."""
    cases = {}
    for reading, gain in TORQUE_GAINS.items():
        for name, b0 in {BEFORE: START, AFTER: END, MATCHED: gain / INERTIA}.items():
            cases[reading, name] = (gain, b0)
    cases |= {(VOLTAGE, name): (TORQUE_GAINS[VOLTAGE], b0) for name, b0 in PRINTED.items()}
    gains, b0s = np.array(list(cases.values())).T
    return dict(zip(cases, step(rig(gains), ladrc(b0s), LARGE), strict=True))


def pid_steps() -> Steps:
    """The paper's PID on errors in radians and in degrees."""
    units = {"radians": 1.0, "degrees": float(np.degrees(1.0))}
    cases = {(reading, unit): k for reading in TORQUE_GAINS for unit, k in units.items()}
    kp, ki, kd = (gain * np.array(list(cases.values()))[None] for gain in PID_GAINS)
    pid = jq.PID(kp, ki, kd, filter=500.0, derivative_weight=1.0, dt=DT)
    plant = rig([TORQUE_GAINS[reading] for reading, _ in cases])
    return dict(zip(cases, step(plant, pid, LARGE), strict=True))


def rough_steps() -> Steps:
    """b0 = 3 and 1.6 on large and small steps: linear, rough, or with a tight limit."""
    plant, controller = rig([2 * LEVER] * 4), ladrc([START, END] * 2)
    sizes = [LARGE, LARGE, SMALL, SMALL]
    names = [(size, b0) for size in ("large", "small") for b0 in (BEFORE, AFTER)]
    rubbing = rig([2 * LEVER] * 4, coulomb=np.full((1, 4), FRICTION))
    encoder = jq.simulation.Encoder(SHEET.encoder_counts)
    limited = ladrc([START, END] * 2, limit=LIMIT)
    found = {
        "linear": step(plant, controller, sizes),
        "friction": step(rubbing, controller, sizes, encoder=encoder),
        "limit": step(plant, limited, sizes),
    }
    return {
        (f"{name}, {size}", b0): response
        for name, responses in found.items()
        for (size, b0), response in zip(names, responses, strict=True)
    }


def moving_steps() -> dict[str, Response]:
    """The large step as the first manoeuvre, by when b0 = 3 begins to move."""
    gain, nominal = np.array([2 * LEVER]), np.array([INERTIA])
    rule = jq.control.certainty_equivalence(END * INERTIA, INERTIA)
    found = {}
    for window in (0.25, 2.5):  # s; the first estimate takes two, one of them for the filters
        law = jq.LADRC(WC, WO, np.array([START]), dt=DT)
        estimator = jq.control.WindowedInertia(gain, nominal, window=window, dt=DT)
        controller = jq.AdaptiveLADRC(law, estimator, rule, settling=DT)
        done = run_step(rig(2 * LEVER), controller, LARGE)
        b0 = np.asarray(done.signals["b0"])[:, 0, 0]
        moves = DT * int(np.argmax(b0 < START))
        [found[f"b0 moves from {moves:.2g} s on"]] = responses(done)
    return found


def table(found: Steps) -> str:
    """Overshoot, settling time and ITAE of every linear step."""
    heads = f"{'u':<13}{'controller':<12}{'overshoot, %':>13}{'settling, s':>13}{'ITAE':>10}"
    rows = [
        f"{u:<13}{name:<12}{one.overshoot:>13.1f}{one.settling:>13.2f}{one.itae:>10.3f}"
        for (u, name), one in found.items()
    ]
    return "\n".join(["a step of 3 deg, in units of the step", heads, *rows])
