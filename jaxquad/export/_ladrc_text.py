"""The difference equations of a LADRC, as text."""

from jaxquad.control import EulerObserver, LADRC


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
    lines += [f"state->{name}[k] = {name};" for name in names]
    lines.append("command[k] = state->command[k] = ${name}_limited(drive / b0, g->limit);")
    unused = "" if ladrc.order == 2 else "    (void)reference_acceleration;\n"
    body = "\n".join(f"        {line}" for line in lines)
    return _STEP.replace("$unused", unused).replace("$lines", body)


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
 * null pointers, for none. */
static inline void ${name}_step(${name}_state *state, const $real reference[${NAME}_AXES],
    const $real *reference_rate, const $real *reference_acceleration,
    const $real measurement[${NAME}_AXES], $real command[${NAME}_AXES])
{
$unused    for (int k = 0; k < ${NAME}_AXES; ++k) {
        const ${name}_gains *g = &${name}_table[k];
$lines
    }
}"""

SCHEDULE = """\
/* Told another inertia, kg m^2: b0 moves, an unsaturated command does not, because the estimate
 * of f moves instead. What is not above 0 is ignored. Starts at the nominal inertia. */
static inline void ${name}_schedule(${name}_state *state, const $real inertia[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
        if (!(inertia[k] > 0)) continue;
        const $real b0 = ${name}_b0(k, inertia[k]);
        state->disturbance[k] += (state->b0[k] - b0) * state->command[k];
        state->b0[k] = b0;
    }
}"""

APPLIED = """\
/* What the drive really gave since the last step: saturated further, or with a test signal. */
static inline void ${name}_applied(${name}_state *state, const $real achieved[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k)
        state->command[k] = achieved[k];
}"""
