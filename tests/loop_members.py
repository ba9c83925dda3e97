"""Many loops analysed at once, in one shape, so that all tests share their compiles."""

import numpy as np

from jaxquad.control import LADRC
from jaxquad.loops import analyse, gain_window, Loop
from jaxquad.models import DecoupledAxes


DT, LONGEST, ROOM = 0.002, 0.04, 20
DEFAULTS = {"wc": 10.0, "wo": 30.0, "b0": 1.0, "gain": 1.0, "lag": None, "delay": 0.0}
DEFAULTS |= {"damping": 0.0, "stiffness": 0.0, "feedback_factor": 1.0, "observer_factor": 1.0}
DAMPING, STIFFNESS = 0.3, 2.0
GAIN = [0.4, 0.8, 1.2, 3.9, 1.0, 0.4]
LAG = [0.02, 0.01, 0.03, 0.005, 0.06, 0.002]
DELAY = [0.0033, 0.004, 0.0, 0.0001, 0.003, 0.0015]
WO = [30.0, 50.0, 40.0, 30.0, 30.0, 90.0]
FRICTION = {"damping": DAMPING, "stiffness": STIFFNESS}
MEMBERS = [
    {"gain": gain, "lag": lag, "delay": delay, "wo": wo} | FRICTION
    for gain, lag, delay, wo in zip(GAIN, LAG, DELAY, WO, strict=True)
]


def columns(members):
    """Each parameter of the `members`, and of as many default ones as fill the room."""
    full = [DEFAULTS | member for member in members]
    full += [full[-1]] * (ROOM - len(full))
    return {name: np.array([member[name] for member in full]) for name in DEFAULTS}


def parts(c):
    row = lambda name: c[name][None]
    lag = None if c["lag"][0] is None else row("lag").astype(float)
    plant = DecoupledAxes(
        row("gain"), [1.0], lag=lag, damping=row("damping"), stiffness=row("stiffness")
    )
    factors = {name: row(name) for name in ("feedback_factor", "observer_factor")}
    return plant, LADRC(row("wc"), row("wo"), row("b0"), **factors, dt=DT)


def analysed(*members):
    """The loops of up to 20 members that differ from the defaults as given, an inertia of 1 in all.

    Those with a lag may have a delay of up to 40 ms.
    """
    c = columns(members)
    plant, controller = parts(c)
    if c["lag"][0] is None:
        return analyse(Loop(plant, controller))
    return analyse(Loop(plant, controller, delay=c["delay"], longest_delay=LONGEST))


def windows(*members):
    """The edges of the gain windows of the members, two rows."""
    plant, controller = parts(columns(members))
    return np.stack(gain_window(Loop(plant, controller)))[:, : len(members)]
