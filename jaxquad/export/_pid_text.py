"""The difference equations of a PID, as text."""

from jaxquad.control import BackCalculation, Clamping, PID


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
        "$real rate = state->started ? state->rate[k] + g->sharp * change : 0;",
        "if (reference_rate && state->started)",
        "    rate += (1 - g->keep) * (reference_rate[k] - 0.5$f * ${NAME}_DT * acceleration);",
        "state->rate[k] = g->keep * rate - g->sharp * change;",
        *(["rate -= state->slope[k];"] if smooth else []),
        f"$real wanted = {gain('kp')} * (g->proportional_weight * reference[k] - seen);",
        f"wanted = wanted + integral + {gain('kd')} * rate;",
        f"if (reference_rate) wanted += {gain('feedforward')} * acceleration;",
        "command[k] = ${name}_limited(wanted, g->limit);",
        f"$real growth = integral{'' if smooth else ' + half'} - state->integral[k];",
        *_anti_windup(pid),
        "state->integral[k] += growth;",
    ]
    return _STEP.replace("$lines", "\n".join(f"        {line}" for line in lines))


def _anti_windup(pid: PID) -> list[str]:
    if isinstance(pid.anti_windup, Clamping):
        return ["if ((wanted - command[k]) * growth > 0) growth = 0;"]
    if isinstance(pid.anti_windup, BackCalculation):
        return ["growth += g->follow * (command[k] - wanted);"]
    return []


_FILTERED = [
    "const $real away = state->angle[k] - measurement[k], slope = state->slope[k];",
    "const $real seen = measurement[k] + g->angle_angle * away + g->angle_rate * slope;",
    "state->angle[k] = seen;",
    "state->slope[k] = g->rate_angle * away + g->rate_rate * slope;",
]
_SUMMED = [
    "const $real integral = state->integral[k] + 2 * half;",
    "const $real change = reference_rate ? 0 : g->derivative_weight * reference[k];",
]
_STRAIGHT = [
    "const $real integral = state->integral[k] + (state->started ? half : 0);",
    "const $real change = (reference_rate ? 0 : g->derivative_weight * reference[k]) - seen;",
]

_STEP = """\
/* One sample: the command to hold until the next one. The set-point's rate and acceleration may be
 * null pointers: derivative_weight then acts on its differences, and there is no feed-forward. */
static inline void ${name}_step(${name}_state *state, const $real reference[${NAME}_AXES],
    const $real *reference_rate, const $real *reference_acceleration,
    const $real measurement[${NAME}_AXES], $real command[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
        const ${name}_gains *g = &${name}_table[k];
$lines
    }
    state->started = 1;
}"""

SCHEDULE = """\
/* Told another inertia, kg m^2: the gains change at once, the integral of the command stays. What
 * is not above 0 is ignored. Starts at the nominal inertia. */
static inline void ${name}_schedule(${name}_state *state, const $real inertia[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k)
        if (inertia[k] > 0) state->b0[k] = ${name}_b0(k, inertia[k]);
}"""
