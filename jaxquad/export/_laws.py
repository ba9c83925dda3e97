"""The difference equations of a LADRC and of a PID in C, with b0 fixed or by an inertia."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxquad._core import on_host
from jaxquad.control import (
    AdaptiveLADRC,
    BackCalculation,
    Clamping,
    CurrentObserver,
    EulerObserver,
    FourierInertia,
    InertiaMap,
    LADRC,
    PID,
    PredictiveObserver,
    ScheduledLADRC,
    ScheduledPID,
)

from ._estimator import estimator_source
from ._header import braced, Gain, number, per_axis, Precision, require_precision, Source, type_of


_OBSERVERS = (CurrentObserver, PredictiveObserver, EulerObserver)


class _Law(NamedTuple):
    """What a LADRC and a PID do not have in common."""

    what: str
    values: Mapping[str, jax.Array | np.ndarray]  # of the gains
    notes: Mapping[str, str]  # of the gains, in their order
    settings: dict[str, str]
    state: dict[str, str]
    starts: str | None  # what begins at a measurement
    step: str
    schedule: str
    nominal: str  # note of b0 at the nominal inertia
    flags: Mapping[str, str] = {}
    applied: tuple[str, ...] = ()


def source_of(controller: object, axes: int | None, precision: Precision) -> Source:
    """The C of a controller or estimator of jaxquad; ValueError for what cannot be written."""
    if isinstance(controller, FourierInertia):
        return estimator_source(controller, axes, precision)
    if isinstance(controller, AdaptiveLADRC):
        raise ValueError(
            "The controller is an AdaptiveLADRC, which is two headers in C: write a "
            "jq.control.ScheduledLADRC and a jq.control.FourierInertia, and call the _schedule of "
            "the first with your estimate of the inertia, such as the second's."
        )
    if type(controller) not in (LADRC, ScheduledLADRC, PID, ScheduledPID):
        raise ValueError(
            f"The controller is a {type(controller).__name__}, but only LADRC, ScheduledLADRC, "
            "PID, ScheduledPID can be written in C. Give a class of your own a method "
            "c_source(axes, precision) that returns a jq.export.Source."
        )
    plain, rule = controller, None
    if isinstance(controller, ScheduledLADRC | ScheduledPID):
        plain = controller.ladrc if isinstance(controller, ScheduledLADRC) else controller.pid
        rule = controller.map
        if not isinstance(rule, InertiaMap):
            raise ValueError(
                f"The map is a {type(rule).__name__}, but only a jq.control.InertiaMap can be "
                "written in C: give values of your map at some knots to an InertiaMap."
            )
    assert isinstance(plain, LADRC | PID)
    arguments = (rule is not None, precision)
    law = _ladrc(plain, *arguments) if isinstance(plain, LADRC) else _pid(plain, *arguments)
    state, notes, settings = law.state, law.notes, law.settings
    values: dict[str, jax.Array | np.ndarray] = {**law.values}
    zeros = [f"state->{name}[k] = 0;" for name in (*state, *law.flags)]
    tables, scheduling = (), ()
    if rule is not None:
        points = {f"values[{k}]": row for k, row in enumerate(np.asarray(rule.values))}
        require_precision({"nominal": rule.nominal, **points}, precision)
        values |= {"nominal": rule.nominal, **points}
    count, gains = per_axis(values, axes)
    if rule is not None:
        knots = np.asarray(rule.knots)
        rows = np.stack([gains[f"values[{k}]"] for k in range(len(knots))])
        tables = _tables(gains["nominal"], knots, rows, precision)
        gains["b0"] = np.exp([np.interp(0.0, knots, row) for row in rows.T.astype(float)])
        zeros.append("state->b0[k] = ${name}_table[k].b0;")
        scheduling = (_B0, law.schedule)
        state = state | {"b0": f"in force, {_unit_of_b0(plain)}"}
        notes = {**notes, "b0": law.nominal}
        settings = {name: text for name, text in settings.items() if name != "b0"}
        settings["b0"] = "piecewise linear from ln inertia to ln b0, constant beyond the knots"
    starting = [_INIT.replace("@lines@", _indented(zeros))]
    starting += [_INIT_AT.replace("@angle@", law.starts)] if law.starts else []
    for_axes = f"for {count} ax{'i' if count == 1 else 'e'}s"
    return Source(
        what=law.what.format(for_axes) + ("." if rule is None else ", b0 by the inertia."),
        dt=plain.dt,
        settings=settings,
        gains={name: Gain(note, gains[name]) for name, note in notes.items() if name in gains},
        state=state,
        functions=(*starting, *scheduling, law.step, *law.applied),
        tables=tables,
        flags=law.flags,
        needs_libm=rule is not None,
    )


def _unit_of_b0(plain: LADRC | PID) -> str:
    order = plain.order if isinstance(plain, LADRC) else 2
    return ("rad/s" if order == 1 else "rad/s^2") + " per unit of command"


def _indented(lines: list[str]) -> str:
    return "\n".join(f"        {line}" for line in lines)


def _ladrc(ladrc: LADRC, scheduled: bool, precision: Precision) -> _Law:
    if type(ladrc.observer) not in _OBSERVERS:
        classes = ", ".join(f"{kind.__name__}()" for kind in _OBSERVERS)
        raise ValueError(f"observer is {ladrc.observer!r}, but only {classes} can be written in C.")
    second, unit = ladrc.order == 2, _unit_of_b0(ladrc)
    gains = on_host(_gains_of(ladrc))
    values = {"kp": gains.proportional}
    values |= {} if gains.derivative is None else {"kd": gains.derivative}
    values |= {f"l{k + 1}": row for k, row in enumerate(gains.correction)}
    values |= {"b0": ladrc.b0, "limit": ladrc.limit}
    require_precision(values, precision)
    names = ("angle", "rate", "disturbance") if second else ("angle", "disturbance")
    pushed = "${NAME}_DT * (state->disturbance[k] + b0 * state->command[k])"
    lines = [f"const $real b0 = {'state->b0[k]' if scheduled else 'g->b0'};"]
    if not second:
        lines += [f"$real angle = state->angle[k] + {pushed};"]
    elif isinstance(ladrc.observer, EulerObserver):
        lines += [
            "$real angle = state->angle[k] + ${NAME}_DT * state->rate[k];",
            f"$real rate = state->rate[k] + {pushed};",
        ]
    else:
        lines += [
            f"const $real push = {pushed};",
            "$real angle = state->angle[k] + ${NAME}_DT * (state->rate[k] + 0.5$f * push);",
            "$real rate = state->rate[k] + push;",
        ]
    lines += ["$real disturbance = state->disturbance[k];"]
    lines += ["const $real error = measurement[k] - angle;", "$real drive;"]
    correct = [f"{name} += g->l{k + 1} * error;" for k, name in enumerate(names)]
    feedback = ["drive = g->kp * (reference[k] - angle) - disturbance;"]
    if second:  # b0 u, in rad/s^2; order 1 in rad/s
        feedback += [
            "drive += g->kd * ((reference_rate ? reference_rate[k] : 0) - rate);",
            "if (reference_acceleration) drive += reference_acceleration[k];",
        ]
    else:
        feedback += ["if (reference_rate) drive += reference_rate[k];"]
    lines += correct + feedback if ladrc.observer.current else feedback + correct
    lines += ["const $real wanted = drive / b0;"]
    new = {name: name for name in names} | {"command": "${name}_limited(wanted, g->limit)"}
    f = "f of angle'' = b0 u + f, rad/s^2, estimate" if second else "f of y' = b0 u + f, estimate"
    state = {"angle": "rad, estimate" if second else "y, estimate", "rate": "rad/s, estimate"}
    state |= {"disturbance": f, "command": "in force since the last sample"}
    units = {"wc": " rad/s", "wo": " rad/s", "feedback_factor": "", "observer_factor": ""}
    units |= {"b0": f" {unit}", "limit": " of |command|"}
    settings = {n: f"{np.asarray(vars(ladrc)[n]).tolist()}{unit}" for n, unit in units.items()}
    settings |= {"observer": type(ladrc.observer).__name__, "placement": ladrc.placement}
    return _Law(
        what=f"LADRC of order {ladrc.order} {{}}",
        values=values,
        notes={"kp": "1/s^2" if second else "1/s", "kd": "1/s", "l1": "of the observer: 1",
               "l2": "1/s", "l3": "1/s^2", "b0": unit, "limit": "of |command|"},
        settings=settings,
        state={name: note for name, note in state.items() if second or name != "rate"},
        starts="angle",
        step=_step(", for none. A sample", lines, new, (*names, "wanted")),
        schedule=_MOVE_DISTURBANCE,
        nominal=f"{unit}, at the nominal inertia",
        applied=(_APPLIED,),
    )  # fmt: skip


@eqx.filter_jit  # many small operations, as one program
def _gains_of(ladrc: LADRC):
    return ladrc.gains


def _pid(pid: PID, scheduled: bool, precision: Precision) -> _Law:
    rule = pid.anti_windup
    if not isinstance(rule, Clamping | BackCalculation | None):
        raise ValueError(
            f"anti_windup is {rule!r}, but only Clamping(), BackCalculation(time) and None can be "
            "written in C."
        )
    names = ("kp", "ki", "kd", "feedforward", "proportional_weight", "derivative_weight", "limit")
    values = {name: vars(pid)[name] for name in names}
    require_precision(values | {"filter": pid.filter}, precision)
    # In the header's precision, as `PID.step` does: what is lost of 1 - keep is then the same.
    kind = type_of(precision)
    keep = jnp.exp(-pid.dt * pid.filter.astype(kind))
    values |= {"keep": keep, "sharp": (1 - keep) / pid.dt}
    limiting = []
    if isinstance(rule, Clamping):
        limiting = ["if ((wanted - given) * growth > 0) growth = 0;"]
    if isinstance(rule, BackCalculation):
        limiting = ["growth += g->follow * (given - wanted);"]
        values["follow"] = -jnp.expm1(-pid.dt / rule.time.astype(kind))
    transition = pid.prepared().transition
    smooth = transition is not None
    if smooth:
        entries = ("angle_angle", "angle_rate", "rate_angle", "rate_rate")
        values |= dict(zip(entries, (x for row in transition for x in row), strict=True))
    gain = lambda name: f"g->{name}{' / b0' if scheduled else ''}"
    lines = ["const $real b0 = state->b0[k];"] if scheduled else []
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
        *limiting,
        "const $real sum = state->integral[k] + growth;",
    ]
    new = {"integral": "sum", "rate": "filtered", "command": "given", "started": "1"}
    new |= {"angle": "seen", "slope": "turn"} if smooth else {}
    checked = ("wanted", "sum", "filtered", *("seen", "turn") * smooth)
    state = {"integral": "units of the command", "rate": "of the derivative's filter, rad/s"}
    state |= {"command": "in force since the last sample"}
    if smooth:
        state |= {"angle": "of the measurement's filter, rad", "slope": "of that angle, rad/s"}
    units = {"kp": "per rad", "ki": "per rad s", "kd": "per rad/s", "filter": "rad/s",
             "measurement_filter": "rad/s", "limit": "of |command|"}  # fmt: skip
    settings = [(n, vars(pid)[n], unit) for n, unit in units.items()]
    settings = {n: f"{np.asarray(x).tolist()} {unit}" for n, x, unit in settings if x is not None}
    time = f"({np.asarray(rule.time).tolist()} s)" if isinstance(rule, BackCalculation) else ""
    settings["anti-windup"] = "none" if rule is None else type(rule).__name__ + time
    return _Law(
        what="PID {}" + ", gains divided by b0" * scheduled,
        values=values,
        notes=_PID_NOTES,
        settings=settings,
        state=state,
        starts="angle" if smooth else None,
        step=_step(_DIFFERENCES, lines, new, checked),
        schedule=_KEEP_INTEGRAL,
        nominal="at the nominal inertia",
        flags={"started": "0 before the first sample"},
    )


_PID_NOTES = {
    "kp": "per rad", "ki": "per rad s", "kd": "per rad/s", "feedforward": "per rad/s^2",
    "proportional_weight": "of the set-point", "derivative_weight": "of the set-point",
    "keep": "of the derivative's filter, a sample later", "sharp": "(1 - keep) / dt, 1/s",
    "follow": "of the integral, in a sample, towards the bounded command",
    "angle_angle": "of the measurement's filter, a sample later", "angle_rate": "s",
    "rate_angle": "1/s", "rate_rate": "1", "limit": "of |command|",
}  # fmt: skip
_DIFFERENCES = (
    ": derivative_weight then acts on its differences, and there is no feed-forward. A\n * sample"
)
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


def _step(nulls: str, lines: list[str], new: Mapping[str, str], checked: tuple[str, ...]) -> str:
    """The function `step`: it ends by writing the `new` state, and `command`.

    A sample that is not finite, or that makes one of the `checked` variables overflow, keeps all.
    """
    finite = ["${name}_usable(reference, reference_rate, reference_acceleration, measurement, k)"]
    finite += [f"${{name}}_finite(&{name})" for name in checked]
    lines = [
        *lines,
        "if (" + "\n                && ".join(finite) + ") {",
        *(f"    state->{name}[k] = {value};" for name, value in new.items()),
        "}",
        "command[k] = state->command[k];",
    ]
    return _STEP.replace("@nulls@", nulls).replace("@lines@", _indented(lines))


_STEP = """\
/* One sample: the command to hold until the next one. The set-point's rate and acceleration may be
 * null pointers@nulls@ that is not finite changes nothing of its axis. */
static inline void ${name}_step(${name}_state *state, const $real reference[${NAME}_AXES],
    const $real *reference_rate, const $real *reference_acceleration,
    const $real measurement[${NAME}_AXES], $real command[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
        const ${name}_gains *g = &${name}_table[k];
@lines@
    }
}"""

_INIT = """\
/* At rest at angle 0. */
static inline void ${name}_init(${name}_state *state)
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
@lines@
    }
}"""

_INIT_AT = """\
/* At rest at a measurement, or at angle 0 where it is not finite. */
static inline void ${name}_init_at(${name}_state *state, const $real measurement[${NAME}_AXES])
{
    ${name}_init(state);
    for (int k = 0; k < ${NAME}_AXES; ++k)
        if (${name}_finite(&measurement[k])) state->@angle@[k] = measurement[k];
}"""

_MOVE_DISTURBANCE = """\
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

_KEEP_INTEGRAL = """\
/* Another inertia, kg m^2: the gains change at once, the integral of the command does not. Values
 * that are not above 0, or not finite, are ignored. Starts at the nominal inertia. */
static inline void ${name}_schedule(${name}_state *state, const $real inertia[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k)
        if (${name}_finite(&inertia[k]) && inertia[k] > 0)
            state->b0[k] = ${name}_b0(k, inertia[k]);
}"""

_APPLIED = """\
/* What the drive really gave since the last step: saturated further, or with a test signal. A value
 * that is not finite is ignored. */
static inline void ${name}_applied(${name}_state *state, const $real achieved[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k)
        if (${name}_finite(&achieved[k])) state->command[k] = achieved[k];
}"""

_B0 = """\
/* b0 of an axis at an inertia above 0, in kg m^2. */
static inline $real ${name}_b0(int axis, $real inertia)
{
    const $real ratio = inertia / ${name}_nominal[axis];
    const $real x = log$f(ratio > 1e-6$f ? ratio : 1e-6$f);
    $real y = ${name}_values[0][axis];
    for (int n = 1; n < ${NAME}_KNOTS; ++n) {
        const $real low = ${name}_knots[n - 1], high = ${name}_knots[n];
        const $real share = x <= low ? 0 : x >= high ? 1 : (x - low) / (high - low);
        y += (${name}_values[n][axis] - ${name}_values[n - 1][axis]) * share;
    }
    return exp$f(y);
}"""


def _tables(
    nominal: np.ndarray, knots: np.ndarray, rows: np.ndarray, precision: Precision
) -> tuple[str, ...]:
    """Of a map: b0 at its knots, `rows`, as logarithms [knots, axes]."""
    line = lambda values, name: braced(number(x, name, precision) for x in values)
    values = "{\n    " + ",\n    ".join(line(row, "values") for row in rows) + "}"
    tables = (
        ("kg m^2", "nominal[${NAME}_AXES]", line(nominal, "nominal")),
        ("ln(inertia / nominal)", "knots[${NAME}_KNOTS]", line(knots, "knots")),
        ("ln b0", "values[${NAME}_KNOTS][${NAME}_AXES]", values),
    )
    return f"#define ${{NAME}}_KNOTS {len(knots)}", *(
        f"/* {note} */\nstatic const $real ${{name}}_{name} = {text};"
        for note, name, text in tables
    )
