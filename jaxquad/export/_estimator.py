"""The recursive Fourier estimator of an inertia in C."""

import numpy as np

from jaxquad._core import on_host
from jaxquad.control import FourierInertia, NoProbe

from ._header import braced, Gain, number, per_axis, Precision, require_precision, Source


def estimator_source(estimator: FourierInertia, axes: int | None, precision: Precision) -> Source:
    """Its C; ValueError for an ensemble and for an estimator with test tones."""
    if not isinstance(estimator.tones, NoProbe):
        raise ValueError(
            "The estimator has test tones, which cannot be written in C: leave tones out, and add "
            "the test signal to the command in your own code."
        )
    gains = {name: vars(estimator)[name] for name in _GAINS}
    settings = {name: vars(estimator)[name] for name in _UNITS}
    require_precision(gains | settings, precision)
    count, gains = per_axis(gains, axes)
    constant = lambda x, name: number(x, name, precision)
    rows = zip(*(np.asarray(x) for x in on_host(estimator.filters())), strict=True)
    tones = ",\n    ".join(braced(constant(x, "frequencies") for x in row) for row in rows)
    sizes = {"TONES": estimator.frequencies.size, "COEFFICIENTS": len(estimator.coefficients)}
    numbers = {
        "FORGETTING": float(estimator.forgetting), "DRIFT": estimator.drift**2 * estimator.dt,
        "TRUST": estimator.trust, "FREEDOM": estimator.noise_freedom,
        "FEWEST": estimator.fewest_freedom, "ENTER": float(estimator.enter),
    }  # fmt: skip
    lines = [*(_TERMS[name] for name in estimator.nuisance), *_TERMS["gain"]]
    update = _UPDATE.replace("@terms@", _SAMPLED[estimator.measured])
    plant = ""
    if "damping" in estimator.nuisance:
        plant = _PLANT.replace("@n@", f"{estimator.nuisance.index('damping')}")
    update = update.replace("@plant@", plant)
    update = update.replace("@rows@", "\n".join(" " * 12 + line for line in lines))
    names = ", ".join(estimator.coefficients).replace("lag", "lag times gain")
    eps = "FLT_EPSILON" if precision == "float" else "DBL_EPSILON"
    unit = {"angle": "rad", "rate": "rad/s"}[estimator.measured]
    update = update.replace("@eps@", eps).replace("@measured@", f"{estimator.measured}, {unit},")
    return Source(
        what=f"Inertia by recursive Fourier transforms, axes: {count}.",
        dt=estimator.dt,
        settings={n: f"{np.asarray(x).tolist()} {_UNITS[n]}" for n, x in settings.items()},
        gains={name: Gain(note, gains[name]) for name, note in _GAINS.items()},
        state={
            "stage[3][2][4][${NAME}_TONES]": "of the transforms",
            "power[${NAME}_TONES]": "of the residuals",
            "freedom[${NAME}_TONES]": "of that power",
            "elapsed": "s since the transform began",
            "angle": f"the last {estimator.measured}",
            "change": "of it, over the last sample",
            "command": "of the last sample",
            "values[${NAME}_COEFFICIENTS]": f"{names}, SI units",
            "variances[${NAME}_COEFFICIENTS]": "of the values; -1 where they are not determined",
            "inertia": "kg m^2",
            "variance": "of the inertia, when it was estimated",
            "age": "relative variance that has come since",
        },
        functions=(_INIT, _NOISE, update, _ESTIMATE),
        tables=(
            *(f"#define ${{NAME}}_{n} {x}" for n, x in sizes.items()),
            *(f"#define ${{NAME}}_{n} {constant(x, n.lower())}" for n, x in numbers.items()),
            "/* cosine and sine of the filters, rad/s, gain of the command's lag and delay */\n"
            "static const $real ${name}_tones[${NAME}_TONES][5] = {\n    " + tones + "};",
        ),
        flags={"samples": "since the start, to 2", "informed": "1 once there was excitation"},
        needs_libm=True,
    )


_GAINS = {"torque_gain": "N m per unit of command", "nominal": "kg m^2"}
_UNITS = {"frequencies": "Hz", "forgetting": "s", "lag": "s", "delay": "s"}
# One sample of the equation of motion in units of the command: 1, rate, torque, acceleration.
_SAMPLED = {
    "angle": """\
        const $real change = measurement[k] - state->angle[k];
        const $real term[4] = {1, (change + state->change[k]) / (2 * ${NAME}_DT),
            (command[k] + state->command[k]) / 2,
            (change - state->change[k]) / (${NAME}_DT * ${NAME}_DT)};
        const int valid = state->samples[k] >= 2;""",
    "rate": """\
        const $real change = measurement[k] - state->angle[k];
        const $real term[4] = {1, (measurement[k] + state->angle[k]) / 2, command[k],
            change / ${NAME}_DT};
        const int valid = state->samples[k] >= 1;""",
}
_TERMS = {
    "offset": "row[n][0][f] = now[0][0]; row[n++][1][f] = now[1][0];",
    "damping": "row[n][0][f] = -now[0][1]; row[n++][1][f] = -now[1][1];",
    "lag": "row[n][0][f] = tone[2] * v; row[n++][1][f] = -tone[2] * u;",
    "gain": (
        "row[n][0][f] = u; row[n++][1][f] = v;",
        "row[n][0][f] = now[0][3]; row[n][1][f] = now[1][3];",
    ),
}

_PLANT = """
            && (state->values[@n@][k] > 0 || state->variances[@n@][k] < 0
                || state->values[@n@][k] * state->values[@n@][k] < state->variances[@n@][k])"""

_INIT = """\
/* Begin the transforms of an axis anew; its inertia stays. */
static inline void ${name}_begin(${name}_state *state, int k)
{
    for (int f = 0; f < ${NAME}_TONES; ++f) {
        for (int n = 0; n < 24; ++n) state->stage[n / 8][n / 4 % 2][n % 4][f][k] = 0;
        state->power[f][k] = state->freedom[f][k] = 0;
    }
    state->elapsed[k] = state->angle[k] = state->change[k] = state->command[k] = 0;
    state->samples[k] = 0;
}

/* Before the first sample: the nominal inertia, not trusted. */
static inline void ${name}_init(${name}_state *state)
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
        ${name}_begin(state, k);
        for (int n = 0; n < ${NAME}_COEFFICIENTS; ++n) {
            state->values[n][k] = 0;
            state->variances[n][k] = -1;
        }
        state->inertia[k] = ${name}_table[k].nominal;
        state->variance[k] = state->age[k] = 0;
        state->informed[k] = 0;
    }
}"""

_NOISE = """\
static inline $real ${name}_smooth_step($real x)
{
    return x < 0 ? 0 : x < 1 ? x * x * (3 - 2 * x) : 1;
}

/* Power of the noise at each frequency, from it and its neighbours along a power law. */
static inline void ${name}_noise(const ${name}_state *state, int k, $real noise[${NAME}_TONES])
{
    for (int f = 1; f < ${NAME}_TONES - 1; ++f) {
        const $real p = state->power[f - 1][k], q = state->power[f][k], r = state->power[f + 1][k];
        const $real low = state->freedom[f - 1][k], high = state->freedom[f + 1][k];
        const $real total = p + q + r, freedom = low + state->freedom[f][k] + high;
        const $real first = freedom > 0 ? (p + 0.1$f * total) / (low + 0.1$f * freedom) : 0;
        const $real last = freedom > 0 ? (r + 0.1$f * total) / (high + 0.1$f * freedom) : 0;
        const $real rise = first > 0 && last > 0 ? sqrt$f(last / first) : 1;
        const $real inverse = freedom > 0 ? 1 / freedom : 0;
        noise[f] = (p * rise + q + r / rise) * inverse * (1 + 2 / ${NAME}_FREEDOM * inverse);
        if (f == 1) noise[0] = noise[f] / rise;
        if (f == ${NAME}_TONES - 2) noise[f + 1] = noise[f] * rise;
    }
}"""

_UPDATE = """\
/* One sample: the command that was held since the last one, and the @measured@ at its end. A number
 * that is not finite begins the transforms of its axis anew; its inertia stays. */
static inline void ${name}_update(${name}_state *state, const $real command[${NAME}_AXES],
    const $real measurement[${NAME}_AXES])
{
    enum { COUNT = ${NAME}_COEFFICIENTS };
    for (int k = 0; k < ${NAME}_AXES; ++k) {
        if (!(${name}_finite(&command[k]) && ${name}_finite(&measurement[k]))) {
            ${name}_begin(state, k);
            continue;
        }
@terms@
        state->angle[k] = measurement[k];
        state->change[k] = change;
        state->command[k] = command[k];
        state->samples[k] += state->samples[k] < 2;
        const $real time = state->elapsed[k] / ${NAME}_FORGETTING;
        const $real fade = valid ? ${name}_smooth_step(time) : 0;
        $real row[COUNT + 1][2][${NAME}_TONES], weight[${NAME}_TONES];
        for (int f = 0; f < ${NAME}_TONES; ++f) {
            const $real *tone = ${name}_tones[f];
            $real now[2][4];
            for (int s = 0; s < 4; ++s) {
                now[0][s] = fade * term[s];
                now[1][s] = 0;
                for (int n = 0; n < 3; ++n) {
                    const $real x = state->stage[n][0][s][f][k], y = state->stage[n][1][s][f][k];
                    now[0][s] = tone[0] * x - tone[1] * y + ${NAME}_ENTER * now[0][s];
                    now[1][s] = tone[1] * x + tone[0] * y + ${NAME}_ENTER * now[1][s];
                    state->stage[n][0][s][f][k] = now[0][s];
                    state->stage[n][1][s][f][k] = now[1][s];
                }
            }
            const $real u = tone[3] * now[0][2] - tone[4] * now[1][2];
            const $real v = tone[4] * now[0][2] + tone[3] * now[1][2];
            int n = 0;
@rows@
        }
        ${name}_noise(state, k, weight);
        for (int f = 0; f < ${NAME}_TONES; ++f) {
            const $real x = row[COUNT][0][f], y = row[COUNT][1][f];
            const $real noise = weight[f] + @eps@ * (x * x + y * y);
            weight[f] = noise > 0 ? 2 / noise : 0;
        }
        /* Weighted least squares, by sweeps of the normal matrix. */
        $real left[COUNT + 1][COUNT + 1], square[COUNT + 1];
        for (int i = 0; i <= COUNT; ++i)
            for (int j = 0; j <= COUNT; ++j) {
                left[i][j] = 0;
                for (int p = 0; p < 2; ++p)
                    for (int f = 0; f < ${NAME}_TONES; ++f)
                        left[i][j] += weight[f] * row[i][p][f] * row[j][p][f];
            }
        for (int i = 0; i <= COUNT; ++i) square[i] = left[i][i];
        int determined[COUNT];
        for (int n = 0; n < COUNT; ++n) {
            $real column[COUNT + 1];
            determined[n] = left[n][n] > 64 * @eps@ * square[n];
            const $real inverse = determined[n] ? 1 / left[n][n] : 0;
            for (int i = 0; i <= COUNT; ++i) column[i] = left[i][n];
            for (int i = 0; i <= COUNT; ++i)
                for (int j = 0; j <= COUNT; ++j) left[i][j] -= column[i] * column[j] * inverse;
            for (int i = 0; i <= COUNT; ++i) left[i][n] = left[n][i] = column[i] * inverse;
            left[n][n] = -inverse;
        }
        /* Residuals, and what the fit has taken from them. */
        const $real filled = ${name}_smooth_step((time - 0.5$f) / 1.5$f);
        const $real follow = ${NAME}_DT / (2 * ${NAME}_FORGETTING);
        for (int f = 0; f < ${NAME}_TONES; ++f) {
            $real power = 0, hat = 0;
            for (int p = 0; p < 2; ++p) {
                $real residual = row[COUNT][p][f];
                for (int i = 0; i < COUNT; ++i) {
                    residual -= left[i][COUNT] * row[i][p][f];
                    for (int j = 0; j < COUNT; ++j) hat -= left[i][j] * row[i][p][f] * row[j][p][f];
                }
                power += residual * residual;
            }
            const $real rest = 1 - weight[f] * hat / 2;
            const $real free = rest < 0 ? 0 : rest < 1 ? rest : 1;
            state->power[f][k] += follow * (power - state->power[f][k]);
            state->freedom[f][k] += follow * (filled * free - state->freedom[f][k]);
        }
        if (valid) state->elapsed[k] += ${NAME}_DT;
        $real freedom = 0;
        for (int f = 1; f < ${NAME}_TONES - 1; ++f)
            for (int n = -1; n <= 1; ++n) freedom += state->freedom[f + n][k];
        freedom *= ${NAME}_FREEDOM / (${NAME}_TONES - 2);
        for (int n = 0; n < COUNT; ++n) {
            const int some = determined[n] && freedom > ${NAME}_FEWEST;
            state->values[n][k] = left[n][COUNT];
            state->variances[n][k] = some ? -left[n][n] * (1 + 4 / freedom) : -1;
        }
        const $real gain = state->values[COUNT - 1][k], variance = state->variances[COUNT - 1][k];
        if (variance >= 0 && gain > 0 && 9 * variance < gain * gain@plant@) {
            const $real inertia = ${name}_table[k].torque_gain / gain;
            state->inertia[k] = inertia;
            state->variance[k] = variance / (gain * gain) * (inertia * inertia);
            state->age[k] = 0;
            state->informed[k] = 1;
        } else {
            state->age[k] += ${NAME}_DRIFT;
        }
    }
}"""

_ESTIMATE = """\
/* Inertia and its standard deviation, kg m^2, and whether it is excited and precise enough. */
static inline void ${name}_estimate(const ${name}_state *state, $real inertia[${NAME}_AXES],
    $real deviation[${NAME}_AXES], int trusted[${NAME}_AXES])
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
        const $real now = state->inertia[k], ratio = now / ${name}_table[k].nominal;
        inertia[k] = now;
        deviation[k] = state->informed[k] ? sqrt$f(state->variance[k] + state->age[k] * now * now)
            : now;
        trusted[k] = state->informed[k] && ratio > 0.1$f && ratio < 10
            && deviation[k] <= ${NAME}_TRUST * now;
    }
}"""
