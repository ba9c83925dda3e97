"""PID, with its gains fixed or divided by a b0 that follows an inertia."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxquad.control import BackCalculation, Clamping, PID, ScheduledPID

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
    type_of,
    update,
)


def pid_step(pid: PID, per_gain: str) -> str:
    """The function `step`; `per_gain` is what follows every gain, as " / b0"."""
    smooth = pid.measurement_filter is not None
    gain = lambda name: f"g->{name}{per_gain}"
    lines = ["const $real b0 = state->b0[k];"] if per_gain else []
    lines += _FILTERED if smooth else ["const $real seen = measurement[k];"]
    lines += [
        f"const $real ki = {gain('ki')};",
        "const $real half = 0.5$f * ${NAME}_DT * ki * (reference[k] - seen);",
        "const $real acceleration = reference_acceleration ? reference_acceleration[k] : 0;",
        *(_SUMMED if smooth else _STRAIGHT),
        "$real rate = state->started[k] ? state->rate[k] + g->sharp * change : 0;",
        "if (reference_rate && state->started[k])",
        "    rate += (1 - g->keep) * (reference_rate[k] - 0.5$f * ${NAME}_DT * acceleration);",
        "const $real filtered = g->keep * rate - g->sharp * change;",
        *(["rate -= turn;"] if smooth else []),
        f"$real wanted = {gain('kp')} * (g->proportional_weight * reference[k] - seen);",
        f"wanted = wanted + integral + {gain('kd')} * rate;",
        f"if (reference_rate) wanted += {gain('feedforward')} * acceleration;",
        "const $real given = ${name}_limited(wanted, g->limit);",
        f"$real growth = integral{'' if smooth else ' + half'} - state->integral[k];",
        *_anti_windup(pid),
        "const $real sum = state->integral[k] + growth;",
    ]
    new = {"integral": "sum", "rate": "filtered", "command": "given", "started": "1"}
    new |= {"angle": "seen", "slope": "turn"} if smooth else {}
    lines += update(new, ("wanted", "sum", "filtered", *(("seen", "turn") if smooth else ())))
    return _STEP.replace("$lines", "\n".join(f"        {line}" for line in lines))


def _anti_windup(pid: PID) -> list[str]:
    if isinstance(pid.anti_windup, Clamping):
        return ["if ((wanted - given) * growth > 0) growth = 0;"]
    if isinstance(pid.anti_windup, BackCalculation):
        return ["growth += g->follow * (given - wanted);"]
    return []


_FILTERED = [
    "const $real away = state->angle[k] - measurement[k], slope = state->slope[k];",
    "const $real seen = measurement[k] + g->angle_angle * away + g->angle_rate * slope;",
    "const $real turn = g->rate_angle * away + g->rate_rate * slope;",
]
_SUMMED = [
    "const $real integral = state->integral[k] + 2 * half;",
    "const $real change = reference_rate ? 0 : g->derivative_weight * reference[k];",
]
_STRAIGHT = [
    "const $real integral = state->integral[k] + (state->started[k] ? half : 0);",
    "const $real change = (reference_rate ? 0 : g->derivative_weight * reference[k]) - seen;",
]

_STEP = """\
/* One sample: the command to hold until the next one. The set-point's rate and acceleration may be
 * null pointers: derivative_weight then acts on its differences, and there is no feed-forward. A
 * sample that is not finite changes nothing of its axis. */
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
/* Another inertia, kg m^2: the gains change at once, the integral of the command does not. Values
 * that are not above 0, or not finite, are ignored. Starts at the nominal inertia. */
static inline void ${name}_schedule(${name}_state *state, const $real inertia[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k)
        if (${name}_finite(&inertia[k]) && inertia[k] > 0)
            state->b0[k] = ${name}_b0(k, inertia[k]);
}"""


_NOTES = {
    "kp": "per rad",
    "ki": "per rad s",
    "kd": "per rad/s",
    "feedforward": "per rad/s^2",
    "proportional_weight": "of the set-point",
    "derivative_weight": "of the set-point",
    "keep": "of the derivative's filter, a sample later",
    "sharp": "(1 - keep) / dt, 1/s",
    "follow": "of the integral, in a sample, towards the bounded command",
    "angle_angle": "of the measurement's filter, a sample later",
    "angle_rate": "s",
    "rate_angle": "1/s",
    "rate_rate": "1",
    "limit": "of |command|",
}


def pid_source(pid: PID, axes: int | None, precision: Precision) -> Source:
    """The difference equations of a PID."""
    count, gains = _gains_of(pid, axes, precision, {})
    return Source(
        what=f"PID for {axes_text(count)}.",
        dt=pid.dt,
        settings=_settings(pid),
        gains=_members(gains),
        state=_states(pid),
        functions=(*_starting(pid, ""), pid_step(pid, "")),
        flags={"started": "0 before the first sample"},
    )


def scheduled_pid_source(law: ScheduledPID, axes: int | None, precision: Precision) -> Source:
    """The same with gains per b0, and b0 in the state."""
    rule = require_map(law.map)
    count, gains = _gains_of(law.pid, axes, precision, map_gains(rule))
    written = map_source(rule, gains, precision)
    gains["b0"] = written.start
    b0 = {"b0": "in force, rad/s^2 per unit of command"}
    start = "state->b0[k] = ${name}_table[k].b0;"
    return Source(
        what=f"PID for {axes_text(count)}, gains divided by b0, b0 by the inertia.",
        dt=law.pid.dt,
        settings=_settings(law.pid)
        | {"b0": "piecewise linear from ln inertia to ln b0, constant beyond the knots"},
        gains=_members(gains) | {"b0": Gain("at the nominal inertia", gains["b0"])},
        state=_states(law.pid) | b0,
        functions=(*_starting(law.pid, start), written.function, SCHEDULE,
                   pid_step(law.pid, " / b0")),
        tables=written.tables,
        flags={"started": "0 before the first sample"},
        needs_libm=True,
    )  # fmt: skip


def _gains_of(pid: PID, axes: int | None, precision: Precision, more: dict) -> tuple[int, dict]:
    if not (pid.anti_windup is None or isinstance(pid.anti_windup, Clamping | BackCalculation)):
        raise ValueError(
            f"anti_windup is {pid.anti_windup!r}, but only Clamping(), BackCalculation(time) and "
            "None can be written in C."
        )
    names = ("kp", "ki", "kd", "feedforward", "proportional_weight", "derivative_weight", "limit")
    values: dict[str, Array] = {name: vars(pid)[name] for name in names} | more
    require_precision(values | {"filter": pid.filter}, precision)
    return per_axis(values | _samples_of(pid, precision), axes)


def _samples_of(pid: PID, precision: Precision) -> dict[str, Array]:
    # In the header's precision, as `PID.step` does: what is lost of 1 - keep is then the same.
    kind = type_of(precision)
    keep = jnp.exp(-pid.dt * pid.filter.astype(kind))
    samples = {"keep": keep, "sharp": (1 - keep) / pid.dt}
    if isinstance(pid.anti_windup, BackCalculation):
        samples["follow"] = -jnp.expm1(-pid.dt / pid.anti_windup.time.astype(kind))
    transition = pid.prepared().transition
    if transition is None:
        return samples
    names = ("angle_angle", "angle_rate", "rate_angle", "rate_rate")
    return samples | dict(zip(names, (x for row in transition for x in row), strict=True))


def _members(gains: dict[str, np.ndarray]) -> dict[str, Gain]:
    return {name: Gain(note, gains[name]) for name, note in _NOTES.items() if name in gains}


def _states(pid: PID) -> dict[str, str]:
    states = {
        "integral": "units of the command",
        "rate": "of the derivative's filter, rad/s",
    } | COMMAND
    if pid.measurement_filter is None:
        return states
    return states | {
        "angle": "of the measurement's filter, rad",
        "slope": "of that angle, rad/s",
    }


def _starting(pid: PID, more: str) -> tuple[str, ...]:
    measured = None if pid.measurement_filter is None else "angle"
    return starting((*_states(pid), "started"), measured=measured, more=more)


def _settings(pid: PID) -> dict[str, str]:
    units = {"kp": "per rad", "ki": "per rad s", "kd": "per rad/s", "filter": "rad/s",
             "measurement_filter": "rad/s", "limit": "of |command|"}  # fmt: skip
    values = {name: vars(pid)[name] for name in units}
    text = {n: f"{np.asarray(x).tolist()} {units[n]}" for n, x in values.items() if x is not None}
    rule = pid.anti_windup
    time = f"({np.asarray(rule.time).tolist()} s)" if isinstance(rule, BackCalculation) else ""
    return text | {"anti-windup": "none" if rule is None else type(rule).__name__ + time}
