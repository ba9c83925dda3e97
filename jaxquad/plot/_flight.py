"""Closed loops in flight: angle, command and disturbance of the nominal and the worst members."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import PyTree

from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import Loop
from jaxquad.records import AXES
from jaxquad.simulation import Scenario, Simulation
from jaxquad.tuning import Certificate, Tuned, worst_flights

from ._histories import histories
from ._panels import Given, Panels


_TARGET = "set-point"


def flight(
    flown: PyTree,
    loop: Loop | None = None,
    ensemble: Ensemble | Members | None = None,
    scenario: Scenario | None = None,
    *,
    axis: str | int = 0,
    quantities: Sequence[str] = ("itae", "sensitivity_peak"),
    command_unit: str = "",
    ax: Given = None,
    title: str = "",
) -> Panels:
    """Draw how a tuned design flies: angle, command and disturbing torque over time.

    The nominal loop, and the members of the certificate that are worst in some quantity, are flown
    again with the noise that was theirs.

    !!! example

        ```python
        tuned = jq.tune(loop, ensemble, flight)
        jq.plot.flight(tuned, loop, ensemble, flight)
        jq.plot.flight({"LADRC": jq.simulate(one, flight), "PID": jq.simulate(other, flight)})
        ```

    **Arguments:**

    - `flown`: a tuned design with its certificate; or a certificate, whose design is
        `loop.controller`; or simulations that were flown already, by name or one.
    - `loop`, `ensemble`, `scenario`: those that the design was tuned on. Where `jq.tune` was given
        fresh members, give these as `ensemble`.
    - `axis`: of a plant with several, by name or number.
    - `quantities`: names of `jaxquad.tuning` whose worst member is drawn.
    - `command_unit`: such as "V".
    - `ax`: three axes to draw into.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`, of three.

    **Raises:** ValueError for a design without certificate, for parts that are missing or that the
    certificate was not made with, for an unknown axis, and for ensembles of simulations.
    """
    if isinstance(flown, Simulation):
        flown = {"flown": flown}
    if isinstance(flown, Tuned | Certificate):
        if loop is None or ensemble is None or scenario is None:
            raise ValueError(
                "flight flies the members again: give flight(tuned, loop, ensemble, scenario), as "
                "they were given to jq.tune"
            )
        flown = worst_flights(flown, loop, ensemble, scenario, quantities=quantities)
    if not isinstance(flown, Mapping) or not flown:
        raise ValueError(
            f"flight cannot draw a {type(flown).__name__}: give what jq.tune or jq.certify "
            "returned with its loop, ensemble and scenario, or what jq.simulate returned"
        )
    return _draw(flown, axis, command_unit, ax, title)


def _draw(
    flown: Mapping[str, Simulation], axis: str | int, command_unit: str, ax: Given, title: str
) -> Panels:
    many = [name for name, one in flown.items() if one.angle.ndim > 2]
    if many:
        raise ValueError(f"{many} are ensembles: simulate one member, or give a tuned design")
    first = next(iter(flown.values()))
    k = _place(axis, first.angle.shape[1])
    of = lambda x: np.asarray(x)[:, k]
    angles = {_TARGET: np.degrees(of(first.reference))}
    angles |= {name: np.degrees(of(one.angle)) for name, one in flown.items()}
    commands = {name: of(one.command) for name, one in flown.items()}
    torques = {name: of(one.disturbance) for name, one in flown.items()}
    shown = (
        list(torques)[:1]
        + [  # the others only where they differ
            name for name in list(torques)[1:] if np.any(torques[name] != of(first.disturbance))
        ]
    )
    name = AXES[k] if first.angle.shape[1] <= len(AXES) else f"axis {k}"
    panels = {
        f"{name}, deg": angles,
        f"command{f', {command_unit}' if command_unit else ''}": commands,
        "disturbance, N m": {name: torques[name] for name in shown},
    }
    return histories(first.time, panels, target=_TARGET, ax=ax, title=title)


def _place(axis: str | int, axes: int) -> int:
    names = AXES[:axes]
    if axis in names:
        return names.index(str(axis))
    if isinstance(axis, int) and 0 <= axis < axes:
        return axis
    raise ValueError(f"axis is {axis!r}: choose one of {', '.join(names)}, or 0 to {axes - 1}")
