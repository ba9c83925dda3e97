"""What a controller brings to its header, and the text of the parts that all have in common."""

from collections.abc import Iterable, Mapping
from string import Template
from typing import Literal, NamedTuple

import jax
import numpy as np

from jaxquad.control import InertiaMap


Precision = Literal["float", "double"]
_TYPES = {"float": np.float32, "double": np.float64}


def type_of(precision: Precision) -> type[np.floating]:
    """NumPy's name of a C type. Raises ValueError for another."""
    if precision not in _TYPES:
        raise ValueError(f'precision is {precision!r}: choose "float" or "double".')
    return _TYPES[precision]


def number(value: float | np.floating, name: str, precision: Precision) -> str:
    """A C constant that reads back as the same number; FLT_MAX or DBL_MAX for infinity.

    Raises ValueError for nan and for what a float cannot hold.
    """
    kind = type_of(precision)
    with np.errstate(over="ignore", under="ignore"):
        rounded = kind(value)
    if (
        np.isnan(value)
        or (np.isinf(rounded) and not np.isinf(value))
        or (rounded == 0 and value != 0)
    ):
        raise ValueError(f"{name} is {value}, which a C {precision} cannot hold: check the gains.")
    if np.isinf(rounded):
        most = "FLT_MAX" if precision == "float" else "DBL_MAX"
        return most if rounded > 0 else f"-{most}"
    text = str(rounded)  # the shortest that reads back
    text = text if any(mark in text for mark in ".e") else f"{text}.0"
    return text + "f" * (precision == "float")


def braced(values: Iterable[str]) -> str:
    return "{" + ", ".join(values) + "}"


def starting(members: Iterable[str], *, measured: str | None, more: str = "") -> tuple[str, ...]:
    """`init`, with all of the state 0 but for what `more` sets; `init_at` starts the `measured`."""
    lines = [f"state->{name}[k] = 0;" for name in members] + [more] * bool(more)
    init = _INIT.replace("$lines", "\n".join(f"        {line}" for line in lines))
    return (init,) if measured is None else (init, _INIT_AT.replace("$measured", measured))


_INIT = """\
/* At rest at angle 0. */
static inline void ${name}_init(${name}_state *state)
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
$lines
    }
}"""

_INIT_AT = """\
/* At rest at a measurement, or at angle 0 where it is not finite. */
static inline void ${name}_init_at(${name}_state *state, const $real measurement[${NAME}_AXES])
{
    ${name}_init(state);
    for (int k = 0; k < ${NAME}_AXES; ++k)
        if (${name}_finite(&measurement[k])) state->$measured[k] = measurement[k];
}"""


class Gain(NamedTuple):
    """A constant of a controller, as `Source` holds it.

    **Arguments:**

    - `note`: unit and meaning, for the comment.
    - `values`: one for each axis.
    """

    note: str
    values: np.ndarray


class Source(NamedTuple):
    """The C of one controller.

    Functions and tables are templates: `$name` and `$NAME` stand for the header's name, `$real` for
    the type, `$f` for the suffix of its constants, `${NAME}_AXES` and `${NAME}_DT` for numbers,
    `${name}_table[k]` for the gains of an axis. `${name}_finite(&x)` and `${name}_limited(x,
    limit)` exist.

    **Arguments:**

    - `what`: the first line of the header.
    - `dt`: sample interval in s.
    - `settings`: provenance by name, for the comment.
    - `gains`: the `Gain`s by name.
    - `state`: the members of the state, arrays with a number for each axis, and their notes.
    - `functions`: `init`, `step` and further ones.
    - `tables`: further constants.
    - `flags`: further members of the state, arrays of int.
    - `needs_libm`: whether math.h is included.
    """

    what: str
    dt: float
    settings: Mapping[str, str]
    gains: Mapping[str, Gain]
    state: Mapping[str, str]
    functions: tuple[str, ...]
    tables: tuple[str, ...] = ()
    flags: Mapping[str, str] = {}
    needs_libm: bool = False


def axes_text(count: int) -> str:
    return f"{count} axis" if count == 1 else f"{count} axes"


def per_axis(values: Mapping[str, jax.Array | np.ndarray], axes: int | None) -> tuple[int, dict]:
    """How many axes there are, and every gain as a NumPy array with one value for each.

    Raises ValueError for an ensemble, and where nothing says how many axes there are.
    """
    arrays = {name: np.asarray(value) for name, value in values.items()}
    wide = {name: x.shape for name, x in arrays.items() if x.ndim > 1}
    if wide:
        text = ", ".join(f"{name} {shape}" for name, shape in wide.items())
        raise ValueError(
            f"The gains are those of an ensemble, {text}, but a header holds one controller: pick "
            "a member, as jax.tree.map(lambda x: x[:, 0] if x.ndim > 1 else x, controller)."
        )
    count = {len(x) for x in arrays.values() if x.ndim} or ({axes} if axes else set())
    if not count:
        raise ValueError(
            "All gains are scalars, which fit any number of axes: give axes, as axes=3."
        )
    if len(count | ({axes} if axes else set())) > 1:
        raise ValueError(f"axes is {axes}, but the gains are for {sorted(count)}.")
    [axes] = count
    return axes, {name: np.broadcast_to(x, (axes,)) for name, x in arrays.items()}


def require_precision(values: Mapping[str, jax.Array | np.ndarray], precision: Precision) -> None:
    """Raises ValueError for gains that are known to less than the header's precision."""
    type_of(precision)
    coarse = [name for name, x in values.items() if np.asarray(x).dtype == np.float32]
    if precision == "double" and coarse:
        raise ValueError(
            f"{coarse[0]} is a float32, which has fewer digits than a header in double shows: "
            'take precision="float", or make the controller after jq.enable_x64().'
        )


def written(source: Source, name: str, precision: Precision, version: str) -> str:
    """The text of the header."""
    axes = len(next(gain.values for gain in source.gains.values()))
    names = {
        "name": name, "NAME": name.upper(), "real": precision,
        "f": "f" if precision == "float" else "", "axes": axes,
        "dt": number(source.dt, "dt", precision),
        "bits": "uint32_t" if precision == "float" else "uint64_t",
        "exponent": "0x7F800000u" if precision == "float" else "0x7FF0000000000000u",
    }  # fmt: skip
    parts = [
        _comment(source, precision, version),
        _top(source),
        _gains(source, precision),
        *source.tables,
        _state(source),
        _FINITE,
        _LIMITED,
        *source.functions,
        "#endif",
    ]
    return Template("\n\n".join(parts) + "\n").substitute(names)


def _comment(source: Source, precision: Precision, version: str) -> str:
    lines = [source.what, "", f"Written by jaxquad {version}; do not edit it, export it again."]
    lines.append(f"Sample interval {source.dt!r} s, numbers in {precision}. SI units and radians.")
    lines += [f"{name}: {text}" for name, text in source.settings.items()]
    text = "\n".join(f" * {line}".rstrip() for line in lines)
    return f"/* {text[3:]}\n */".replace("$", "")


def _top(source: Source) -> str:
    headers = ["float.h", *["math.h"] * source.needs_libm, "stdint.h", "string.h"]
    includes = [f"#include <{header}>" for header in headers]
    lines = ["#ifndef ${NAME}_H", "#define ${NAME}_H", "", *includes, ""]
    lines += ["#define ${NAME}_AXES $axes", "#define ${NAME}_DT $dt /* s */"]
    return "\n".join(lines)


def _gains(source: Source, precision: Precision) -> str:
    struct = [f"    $real {name}; /* {gain.note} */" for name, gain in source.gains.items()]
    columns = [
        [number(x, name, precision) for x in member.values] for name, member in source.gains.items()
    ]
    rows = [f"    {braced(row)}," for row in zip(*columns, strict=True)]
    return "\n".join(
        ["typedef struct {", *struct, "} ${name}_gains;", ""]
        + ["static const ${name}_gains ${name}_table[${NAME}_AXES] = {", *rows, "};"]
    )


def _state(source: Source) -> str:
    members = [f"    $real {n}[${{NAME}}_AXES]; /* {note} */" for n, note in source.state.items()]
    members += [f"    int {n}[${{NAME}}_AXES]; /* {note} */" for n, note in source.flags.items()]
    return "\n".join(["typedef struct {", *members, "} ${name}_state;"])


_LIMITED = """\
/* A NaN comes out as 0. */
static inline $real ${name}_limited($real x, $real limit)
{
    return x < -limit ? -limit : x <= limit ? x : x > limit ? limit : 0;
}"""

# By the bits, which no compiler's option changes: -ffast-math takes x == x for true.
_FINITE = """\
/* Whether a number is neither a NaN nor infinite. */
static inline int ${name}_finite(const $real *x)
{
    $bits all, exponent = $exponent;
    memcpy(&all, x, sizeof all);
    return (all & exponent) != exponent;
}

/* Whether all numbers of a sample are finite. */
static inline int ${name}_usable(const $real *reference, const $real *reference_rate,
    const $real *reference_acceleration, const $real *measurement, int k)
{
    return ${name}_finite(&reference[k]) && ${name}_finite(&measurement[k])
        && (!reference_rate || ${name}_finite(&reference_rate[k]))
        && (!reference_acceleration || ${name}_finite(&reference_acceleration[k]));
}"""

COMMAND = {"command": "in force since the last sample"}


def update(members: Mapping[str, str], checked: Iterable[str]) -> list[str]:
    """The end of a step: it writes the `members` of the state, by their new values, and `command`.

    A sample that is not finite, or that makes one of the `checked` variables overflow, keeps all.
    """
    finite = ["${name}_usable(reference, reference_rate, reference_acceleration, measurement, k)"]
    finite += [f"${{name}}_finite(&{name})" for name in checked]
    return [
        "if (" + "\n                && ".join(finite) + ") {",
        *(f"    state->{name}[k] = {value};" for name, value in members.items()),
        "}",
        "command[k] = state->command[k];",
    ]


class MapSource(NamedTuple):
    """The tables of a map, its function `b0`, and b0 at the nominal inertia, per axis."""

    tables: tuple[str, ...]
    function: str
    start: np.ndarray


def require_map(rule: object) -> InertiaMap:
    """Raises ValueError for a map that cannot be written."""
    if not isinstance(rule, InertiaMap):
        raise ValueError(
            f"The map is a {type(rule).__name__}, but only a jq.control.InertiaMap can be written "
            "in C: give values of your map at some knots to an InertiaMap."
        )
    return rule


def map_gains(rule: InertiaMap) -> dict[str, jax.Array | np.ndarray]:
    """What a map has per axis."""
    values = np.asarray(rule.values)
    return {"nominal": rule.nominal} | {f"values[{k}]": row for k, row in enumerate(values)}


def map_source(
    rule: InertiaMap, gains: Mapping[str, np.ndarray], precision: Precision
) -> MapSource:
    """Of the map whose `map_gains` are among the `gains` [axes]."""
    knots = np.asarray(rule.knots)
    rows = [gains[f"values[{k}]"] for k in range(len(knots))]
    line = lambda values, name: braced(number(x, name, precision) for x in values)
    tables = (
        f"#define ${{NAME}}_KNOTS {len(knots)}",
        _table("nominal", "[${NAME}_AXES]", "kg m^2", line(gains["nominal"], "nominal")),
        _table("knots", "[${NAME}_KNOTS]", "ln(inertia / nominal)", line(knots, "knots")),
        _table(
            "values", "[${NAME}_KNOTS][${NAME}_AXES]", "ln b0",
            "{\n    " + ",\n    ".join(line(row, "values") for row in rows) + "}",
        ),
    )  # fmt: skip
    columns = np.stack(rows, axis=1).astype(float)
    start = np.exp([np.interp(0.0, knots, column) for column in columns])
    return MapSource(tables, _B0, start)


def _table(name: str, shape: str, note: str, values: str) -> str:
    return f"/* {note} */\nstatic const $real ${{name}}_{name}{shape} = {values};"


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
