"""What the paper says of its steps, judged by those simulated here."""

import numpy as np

import jaxquad as jq

from .ledger import Claim, Reading
from .loops import INERTIA, ladrc, Response, rig, START, TORQUE_GAINS, VOLTAGE
from .steps import AFTER, BEFORE, LAG, Steps


def claims(linear: Steps, pid: Steps, rough: Steps, moving: dict[str, Response]) -> list[Claim]:
    return [
        _holds(), _pid(pid), superior(linear), _not_superior(linear, rough, moving),
        _by_size(rough),
    ]  # fmt: skip


def _holds() -> Claim:
    """Windows of b/b0 on b / s^2, and behind a motor lag."""
    windows = {
        lag: jq.loops.gain_window(jq.Loop(rig(1.0, lag=lag), ladrc(1.0)), member=0)
        for lag in (None, LAG)
    }
    readings = []
    for name, gain in TORQUE_GAINS.items():
        for lag, window in windows.items():
            ratio, low, high = (float(x) for x in (gain / INERTIA / START, *window))
            numbers = {"b/b0": ratio, "stable from": low, "to": high}
            late = f", motor lag {1000 * lag:.0f} ms" if lag else ""
            readings.append(Reading(name + late, numbers, low < ratio < high))
    text = "LADRC with wc = 10, wo = 30 and b0 = 3 controls the rig"
    return Claim("5.3", text, "stable", tuple(readings))


def _pid(pid: Steps) -> Claim:
    readings = (
        Reading(
            f"{name}, errors in {unit}",
            found.numbers,
            found.overshoot < 50 and bool(np.isfinite(found.settling)),
        )
        for (name, unit), found in pid.items()
    )
    rule = "it settles within 10 s and overshoots by less than 50 %"
    return Claim("5.3", "PID with 0.01, 0.05, 0.15 controls well", rule, tuple(readings))


def _compared(before: Response, after: Response) -> dict[str, float | tuple[float, float]]:
    after_by_name = after.numbers
    return {name: (value, after_by_name[name]) for name, value in before.numbers.items()}


def superior(linear: Steps) -> Claim:
    readings = []
    for name in TORQUE_GAINS:
        before, after = linear[name, BEFORE], linear[name, AFTER]
        holds = (
            np.isfinite(before.settling)
            and after.overshoot < min(10, before.overshoot / 2)
            and after.settling < before.settling / 2
        )
        readings.append(Reading(name, _compared(before, after), bool(holds)))
    text = "small steps: LADRC overshoots far and long, the adaptive little and is fast"
    rule = "LADRC settles; the adaptive has half its overshoot, below 10 %, in half the time"
    return Claim("5.3", text, rule, tuple(readings))


def _alike(before: Response, after: Response) -> bool:
    return after.overshoot > 0.9 * before.overshoot and after.itae > 0.5 * before.itae


def _not_superior(linear: Steps, rough: Steps, moving: dict[str, Response]) -> Claim:
    before = linear[VOLTAGE, BEFORE]
    pairs = {
        "adapted before the step": (before, linear[VOLTAGE, AFTER]),
        "adapted before, friction and encoder": tuple(
            rough["friction, large", b0] for b0 in (BEFORE, AFTER)
        ),
        "adapted before, u limited to 0.5 V": tuple(
            rough["limit, large", b0] for b0 in (BEFORE, AFTER)
        ),
    }
    pairs |= {name: (before, response) for name, response in moving.items()}
    readings = (Reading(name, _compared(*pair), _alike(*pair)) for name, pair in pairs.items())
    text = "from 1 to 4 deg the adaptive LADRC is not superior"
    rule = "it has neither a tenth less overshoot nor half the ITAE"
    return Claim("5.3", text, rule, tuple(readings))


def _by_size(rough: Steps) -> Claim:
    names = {"linear": "linear", "friction": "friction and encoder", "limit": "u limited to 0.5 V"}
    advantage = lambda case: rough[case, BEFORE].itae / rough[case, AFTER].itae
    pairs = {
        text: tuple(advantage(f"{name}, {size}") for size in ("large", "small"))
        for name, text in names.items()
    }
    readings = (
        Reading(
            f"{VOLTAGE}, {name}",
            {"ratio of ITAE at 3 and 1 deg": (large, small)},
            small > 1.5 * large,
        )
        for name, (large, small) in pairs.items()
    )
    text = "the advantage comes with small angles"
    rule = "b0 = 3 over 1.6 is 1.5 times worse in ITAE, per step, at 1 deg than at 3 deg"
    return Claim("5.3", text, rule, tuple(readings))
