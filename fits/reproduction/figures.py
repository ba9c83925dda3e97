"""Figures 5 to 11 of the paper, as they come out here."""

from typing import Any

import numpy as np

import jaxquad as jq
from jaxquad.plot import bode, histories

from .adaptation import Flight
from .disturbance import Loaded, RIGHT, SETTLED, WRONG
from .loops import DT, END, INERTIA, LEVER, Response, SHEET, VOLTAGE
from .roll import PAPER_GAIN, PAPER_INERTIA, PAPER_THRUST, Roll
from .steps import AFTER, BEFORE, MATCHED, Steps


def responses(roll: Roll) -> Any:
    """Figure 5."""
    lag = roll.joint.model.lag
    paper = jq.models.AttitudeAxis(SHEET.arm, PAPER_THRUST, PAPER_INERTIA, lag=lag)
    gain = roll.joint_gain.value
    models = {f"identified here, b = {gain:.3f}": roll.joint.model, "the paper's, b = 0.468": paper}
    apart = 20 * np.log10(PAPER_GAIN / gain)
    title = f"Figure 5: the sweep ends at 12 rad/s; the models are {apart:.1f} dB apart"
    return bode(roll.wide, models, title=title)


def inertias(flight: Flight) -> Any:
    """Figure 6."""
    curves = {"reference": np.full(flight.time.shape, INERTIA)}
    curves |= {name: draws[:, 0] for name, draws in flight.inertia.items()}
    return histories(
        flight.time[::10],
        {"inertia, kg m$^2$": {name: values[::10] for name, values in curves.items()}},
        target="reference",
        limits={"inertia, kg m$^2$": (-0.003, 0.09)},
        title="Figure 6: encoder of 8192 counts, gusts of 5 mN m, test tone of 0.3 V",
    )


def gains(flight: Flight) -> Any:
    """Figure 7."""
    level = lambda value: np.full(flight.time[::10].shape, value)
    right = 2 * LEVER / INERTIA
    curves = {
        "the paper's last value, 1.6": level(END),
        "adapted": flight.b0[::10, 0],
        "stable below": level(right / 0.2159),
        "right: b0 = b": level(right),
    }
    return histories(
        flight.time[::10], {"b0, rad/s$^2$/V": curves}, target="the paper's last value, 1.6",
        limits={"b0, rad/s$^2$/V": (0.0, 4.3)},
        title=f"Figure 7: b0 J^ constant, {VOLTAGE}: the last b0 is {END / right:.2g} b",
    )  # fmt: skip


def large_steps(linear: Steps, pid: Steps, moving: dict[str, Response]) -> Any:
    """Figure 8."""
    first = next(iter(moving))  # the earliest
    curves = {
        "LADRC, b0 = 3": linear[VOLTAGE, BEFORE],
        f"adaptive, {first}": moving[first],
        "PID, errors in degrees": pid[VOLTAGE, "degrees"],
    }
    return _step_figure(curves, 1.0, 3.0, (0.0, 8.0), f"Figure 8: from 1 to 4 deg, {VOLTAGE}")


def small_steps(linear: Steps) -> Any:
    """Figure 9."""
    curves = {
        "LADRC, b0 = 3": linear[VOLTAGE, BEFORE],
        "adapted, b0 = 1.6": linear[VOLTAGE, AFTER],
        "b0 = b = 0.848": linear[VOLTAGE, MATCHED],
    }
    return _step_figure(curves, 0.0, 1.0, (-0.05, 1.5), f"Figure 9: 1 deg, {VOLTAGE}")


def _step_figure(
    curves: dict[str, Response], start: float, size: float, limits: tuple, title: str
) -> Any:
    time = DT * np.arange(len(next(iter(curves.values())).angle))
    shown = {"set-point": np.full(time.shape, start + size)}
    shown |= {name: start + size * response.angle for name, response in curves.items()}
    text = "roll, deg"
    return histories(time, {text: shown}, target="set-point", limits={text: limits}, title=title)


def estimates(loops: Loaded, torque: str, number: int) -> Any:
    """Figures 10 and 11, with either factor on z3."""
    begin = round(SETTLED / DT)
    panels = {}
    for scaling in (RIGHT, WRONG):
        before, after = (loops[VOLTAGE, b0, torque] for b0 in (BEFORE, AFTER))
        panels[f"{scaling}, N m"] = {
            "true torque": before.torque[begin:],
            f"LADRC, {BEFORE}": before.estimate[scaling][begin:],
            f"adapted, {AFTER}": after.estimate[scaling][begin:],
        }
    time = SETTLED + DT * np.arange(len(before.torque) - begin)
    title = f"Figure {number}: {torque}, {VOLTAGE}"
    return histories(time, panels, target="true torque", title=title)
