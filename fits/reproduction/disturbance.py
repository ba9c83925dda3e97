"""Section 5.3, Figures 10 and 11: what LADRC makes of a pulsed and of a sinusoidal torque."""

from typing import NamedTuple

import numpy as np

import jaxquad as jq

from .ledger import Claim, Reading
from .loops import DT, END, FITTED, INERTIA, ladrc, rig, START, TORQUE_GAINS, VOLTAGE


PERIOD, DURATION, SETTLED = 5.0, 20.0, 10.0  # s
TORQUES = {
    "pulse, half of the period": jq.Pulse(0.2, period=PERIOD, share=0.5),
    "pulse of 0.5 s": jq.Pulse(0.2, period=PERIOD, width=0.5),
    "sine": jq.simulation.Sine(0.3, period=PERIOD),
}
PULSES = list(TORQUES)[:2]
PLANTS = {name: TORQUE_GAINS[name] for name in (VOLTAGE, FITTED)}  # b0 = 3 holds no other
RIGHT, WRONG = "(KT/b0) z3", "J z3"


class Estimates(NamedTuple):
    """One loop under one torque."""

    torque: np.ndarray  # N m, [samples]
    estimate: dict[str, np.ndarray]  # N m, by the factor on z3
    angle: np.ndarray  # rad

    def error(self, scaling: str) -> float:
        """Root mean square of the estimate's error in N m, once settled."""
        return _rms(self.estimate[scaling] - self.torque)

    def rise(self, scaling: str) -> float:
        """Time in s until the estimate first shows 63 % of the pulse that begins at 0."""
        return DT * int(np.argmax(self.estimate[scaling] > 0.63 * self.torque.max()))

    @property
    def deviation(self) -> float:
        """Root mean square of the angle in degrees, once settled."""
        return float(np.degrees(_rms(self.angle)))


Loaded = dict[tuple[str, str, str], Estimates]  # by plant, b0 and torque
BEFORE, AFTER, MATCHED = f"b0 = {START:g}", f"b0 = {END:g}", "b0 = b"


def loaded_loops() -> Loaded:
    """Every plant with b0 = 3, 1.6 and its own b under every torque, at the set-point 0."""
    names, values = [], []
    torques = {name: _sampled(signal) for name, signal in TORQUES.items()}
    for plant, gain in PLANTS.items():
        for name, b0 in {BEFORE: START, AFTER: END, MATCHED: gain / INERTIA}.items():
            for torque in TORQUES:
                names.append((plant, name, torque))
                values.append((gain, b0))
    gains, b0s = np.array(values).T
    signal = np.stack([torques[torque] for *_, torque in names], axis=1)
    happening = jq.scenario(duration=DURATION, dt=DT, axes=1, disturbance={0: signal})
    done = jq.simulate(jq.Loop(rig(gains), ladrc(b0s), dt=DT), happening)
    command = np.asarray(done.signals["disturbance"])[:, 0]  # z3 / b0
    scaled = {RIGHT: gains * command, WRONG: INERTIA * b0s * command}
    angle = np.asarray(done.angle)[:, 0]
    return {
        name: Estimates(signal[:, k], {s: x[:, k] for s, x in scaled.items()}, angle[:, k])
        for k, name in enumerate(names)
    }


def _sampled(signal) -> np.ndarray:
    happening = jq.scenario(duration=DURATION, dt=DT, axes=1, disturbance=signal)
    return np.asarray(happening.disturbance)[:, 0]


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values[round(SETTLED / DT) :] ** 2)))


def table(loops: Loaded) -> str:
    """Errors of both scalings and the angle for every case."""
    heads = f"{'plant':<10}{'torque':<26}{'':<9}{WRONG + ', N m':>12}{RIGHT:>13}{'angle, deg':>12}"
    rows = [
        f"{plant:<10}{torque:<26}{b0:<9}{one.error(WRONG):>12.4f}{one.error(RIGHT):>13.4f}"
        f"{one.deviation:>12.2f}"
        for (plant, b0, torque), one in loops.items()
    ]
    return "\n".join(["root mean squares after 10 s", heads, *rows])


def claims(loops: Loaded) -> list[Claim]:
    return [_closer(loops), _sooner(loops), _sine(loops), _steadier(loops)]


def _closer(loops: Loaded) -> Claim:
    readings = []
    for plant in PLANTS:
        for torque in PULSES:
            for scaling in (RIGHT, WRONG):
                before, after = (loops[plant, b0, torque].error(scaling) for b0 in (BEFORE, AFTER))
                numbers = {"rms error, N m": (before, after)}
                readings.append(Reading(f"{plant}, {torque}, {scaling}", numbers, after < before))
    text = "pulse of 0.2 N m, 5 s: the adaptive estimate is closer to the truth"
    return Claim("5.3", text, "its rms error is less", tuple(readings))


def _sooner(loops: Loaded) -> Claim:
    readings = []
    for plant in PLANTS:
        for scaling in (RIGHT, WRONG):
            before, after = (loops[plant, b0, PULSES[0]].rise(scaling) for b0 in (BEFORE, AFTER))
            numbers = {"63 % after, s": (before, after)}
            readings.append(Reading(f"{plant}, {scaling}", numbers, after < before))
    text = "pulse: the adaptive estimate reacts sooner"
    return Claim("5.3", text, "it shows 63 % of the pulse earlier", tuple(readings))


def _sine(loops: Loaded) -> Claim:
    size = 0.3 / np.sqrt(2)
    readings = []
    for plant in PLANTS:
        for scaling in (RIGHT, WRONG):
            before, after = (
                100 * loops[plant, b0, "sine"].error(scaling) / size for b0 in (BEFORE, AFTER)
            )
            numbers = {"rms error, % of the sine": (before, after)}
            readings.append(Reading(f"{plant}, {scaling}", numbers, before > 30 and after < 15))
    text = "sine of 0.3 N m, 5 s: LADRC's estimate deviates significantly, the adaptive hardly"
    rule = "LADRC's error is above 30 % of the sine, the other below 15 %"
    return Claim("5.3", text, rule, tuple(readings))


def _steadier(loops: Loaded) -> Claim:
    readings = []
    for plant in PLANTS:
        for torque in TORQUES:
            before, after = (loops[plant, b0, torque].deviation for b0 in (BEFORE, AFTER))
            numbers = {"rms angle, deg": (before, after)}
            readings.append(Reading(f"{plant}, {torque}", numbers, after < before))
    text = "the adaptive controller rejects disturbances better"
    return Claim("5.3", text, "its rms angle is less", tuple(readings))
