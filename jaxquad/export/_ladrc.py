"""LADRC, with its b0 fixed or scheduled by an inertia."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Array, PyTree

from jaxquad._core import on_host
from jaxquad.control import (
    CurrentObserver,
    EulerObserver,
    LADRC,
    PredictiveObserver,
    ScheduledLADRC,
)

from ._source import (
    axes_text,
    COMMAND,
    Gain,
    map_gains,
    map_source,
    per_axis,
    Precision,
    require_map,
    require_precision,
    Source,
    starting,
    update,
)


def ladrc_step(ladrc: LADRC, b0: str) -> str:
    """The function `step`, with `b0` where it stands."""
    names = ("angle", "rate", "disturbance") if ladrc.order == 2 else ("angle", "disturbance")
    correct = [f"{name} += g->l{k + 1} * error;" for k, name in enumerate(names)]
    lines = [f"const $real b0 = {b0};", *_predict(ladrc)]
    lines += ["const $real error = measurement[k] - angle;", "$real drive;"]
    if ladrc.observer.current:
        lines += [*correct, *_feedback(ladrc)]
    else:
        lines += [*_feedback(ladrc), *correct]
    lines.append("const $real wanted = drive / b0;")
    new = {name: name for name in names} | {"command": "${name}_limited(wanted, g->limit)"}
    lines += update(new, (*names, "wanted"))
    return _STEP.replace("$lines", "\n".join(f"        {line}" for line in lines))


def _predict(ladrc: LADRC) -> list[str]:
    pushed = "${NAME}_DT * (state->disturbance[k] + b0 * state->command[k])"
    if ladrc.order == 1:
        rows = [f"$real angle = state->angle[k] + {pushed};"]
    elif isinstance(ladrc.observer, EulerObserver):
        rows = [
            "$real angle = state->angle[k] + ${NAME}_DT * state->rate[k];",
            f"$real rate = state->rate[k] + {pushed};",
        ]
    else:
        rows = [
            f"const $real push = {pushed};",
            "$real angle = state->angle[k] + ${NAME}_DT * (state->rate[k] + 0.5$f * push);",
            "$real rate = state->rate[k] + push;",
        ]
    return [*rows, "$real disturbance = state->disturbance[k];"]


def _feedback(ladrc: LADRC) -> list[str]:
    """b0 u, in rad/s^2; order 1 in rad/s."""
    first = "drive = g->kp * (reference[k] - angle) - disturbance;"
    if ladrc.order == 1:
        return [first, "if (reference_rate) drive += reference_rate[k];"]
    return [
        first,
        "drive += g->kd * ((reference_rate ? reference_rate[k] : 0) - rate);",
        "if (reference_acceleration) drive += reference_acceleration[k];",
    ]


_STEP = """\
/* One sample: the command to hold until the next one. The set-point's rate and acceleration may be
 * null pointers, for none. A sample that is not finite changes nothing of its axis. */
static inline void ${name}_step(${name}_state *state, const $real reference[${NAME}_AXES],
    const $real *reference_rate, const $real *reference_acceleration,
    const $real measurement[${NAME}_AXES], $real command[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
        const ${name}_gains *g = &${name}_table[k];
$lines
    }
}"""

SCHEDULE = """\
/* Another inertia, kg m^2: b0 changes, an unsaturated command does not, because the estimate of f
 * changes instead. Values that are not above 0, or not finite, are ignored. Starts at the nominal
 * inertia. */
static inline void ${name}_schedule(${name}_state *state, const $real inertia[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
        if (!(${name}_finite(&inertia[k]) && inertia[k] > 0)) continue;
        const $real b0 = ${name}_b0(k, inertia[k]);
        state->disturbance[k] += (state->b0[k] - b0) * state->command[k];
        state->b0[k] = b0;
    }
}"""

APPLIED = """\
/* What the drive really gave since the last step: saturated further, or with a test signal. A value
 * that is not finite is ignored. */
static inline void ${name}_applied(${name}_state *state, const $real achieved[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k)
        if (${name}_finite(&achieved[k])) state->command[k] = achieved[k];
}"""


_OBSERVERS = (CurrentObserver, PredictiveObserver, EulerObserver)
_UNITS = {1: "rad/s per unit of command", 2: "rad/s^2 per unit of command"}  # of b0, by order
_NOTES = {"kd": "1/s", "l1": "of the observer: 1", "l2": "1/s", "l3": "1/s^2"}
_STATES = {
    1: {"angle": "y, estimate", "disturbance": "f of y' = b0 u + f, estimate"},
    2: {
        "angle": "rad, estimate",
        "rate": "rad/s, estimate",
        "disturbance": "f of angle'' = b0 u + f, rad/s^2, estimate",
    },
}


def ladrc_source(ladrc: LADRC, axes: int | None, precision: Precision) -> Source:
    """The difference equations of a LADRC."""
    count, gains = _gains_of(ladrc, axes, precision, {})
    return Source(
        what=f"LADRC of order {ladrc.order} for {axes_text(count)}.",
        dt=ladrc.dt,
        settings=_settings(ladrc, True),
        gains=_noted(ladrc, gains),
        state=_STATES[ladrc.order] | COMMAND,
        functions=(*_starting(ladrc, ""), ladrc_step(ladrc, "g->b0"), APPLIED),
    )


def scheduled_ladrc_source(law: ScheduledLADRC, axes: int | None, precision: Precision) -> Source:
    """The same with b0 in the state, moved by `schedule` without a jump of the command."""
    ladrc, rule = law.ladrc, require_map(law.map)
    count, gains = _gains_of(ladrc, axes, precision, map_gains(rule))
    source = map_source(rule, gains, precision)
    noted = _noted(ladrc, gains | {"b0": source.start})
    noted["b0"] = noted["b0"]._replace(note=f"{_UNITS[ladrc.order]}, at the nominal inertia")
    start = _starting(ladrc, "state->b0[k] = ${name}_table[k].b0;")
    return Source(
        what=f"LADRC of order {ladrc.order} for {axes_text(count)}, b0 by the inertia.",
        dt=ladrc.dt,
        settings=_settings(ladrc, False)
        | {"b0": "piecewise linear from ln inertia to ln b0, constant beyond the knots"},
        gains=noted,
        state=_STATES[ladrc.order] | COMMAND | {"b0": f"in force, {_UNITS[ladrc.order]}"},
        functions=(*start, source.function, SCHEDULE, ladrc_step(ladrc, "state->b0[k]"), APPLIED),
        tables=source.tables,
        needs_libm=True,
    )


@eqx.filter_jit  # many small operations, as one program
def _computed_gains(ladrc: LADRC) -> PyTree:
    return ladrc.gains


def _gains_of(
    ladrc: LADRC, axes: int | None, precision: Precision, more: Mapping[str, Array | np.ndarray]
) -> tuple[int, dict[str, np.ndarray]]:
    if type(ladrc.observer) not in _OBSERVERS:
        classes = ", ".join(f"{kind.__name__}()" for kind in _OBSERVERS)
        raise ValueError(f"observer is {ladrc.observer!r}, but only {classes} can be written in C.")
    gains = on_host(_computed_gains(ladrc))
    values = {"kp": gains.proportional}
    values |= {} if gains.derivative is None else {"kd": gains.derivative}
    values |= {f"l{k + 1}": row for k, row in enumerate(gains.correction)}
    values |= {"b0": ladrc.b0, "limit": ladrc.limit, **more}
    require_precision(values, precision)
    return per_axis(values, axes)


def _noted(ladrc: LADRC, gains: dict[str, np.ndarray]) -> dict[str, Gain]:
    notes = {"kp": "1/s^2" if ladrc.order == 2 else "1/s", **_NOTES}
    notes |= {"b0": _UNITS[ladrc.order], "limit": "of |command|"}
    return {name: Gain(note, gains[name]) for name, note in notes.items() if name in gains}


def _settings(ladrc: LADRC, with_b0: bool) -> dict[str, str]:
    units = {"wc": " rad/s", "wo": " rad/s", "feedback_factor": "", "observer_factor": ""}
    units |= {"b0": f" {_UNITS[ladrc.order]}"} if with_b0 else {}
    units |= {"limit": " of |command|"}
    settings = {n: f"{np.asarray(vars(ladrc)[n]).tolist()}{unit}" for n, unit in units.items()}
    return settings | {"observer": type(ladrc.observer).__name__, "placement": ladrc.placement}


def _starting(ladrc: LADRC, more: str) -> tuple[str, ...]:
    return starting((*_STATES[ladrc.order], "command"), measured="angle", more=more)
