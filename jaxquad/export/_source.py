"""What a controller brings to its header, and the text of the parts that all have in common."""

from collections.abc import Iterable, Mapping
from string import Template
from typing import Literal, NamedTuple

import jax
import numpy as np


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


def starting(
    members: Iterable[str], *, measured: str | None, more: str = "", flags: Iterable[str] = ()
) -> tuple[str, ...]:
    """`init`, with all of the state 0 but for what `more` sets; `init_at` starts the `measured`."""
    lines = [f"state->{name}[k] = 0;" for name in members] + [more] * bool(more)
    body = "\n".join(f"        {line}" for line in lines)
    whole = "".join(f"    state->{flag} = 0;\n" for flag in flags)
    init = _INIT.replace("$lines", body).replace("$whole", whole)
    return (init,) if measured is None else (init, _INIT_AT.replace("$measured", measured))


_INIT = """\
/* At rest at angle 0. */
static inline void ${name}_init(${name}_state *state)
{
    for (int k = 0; k < ${NAME}_AXES; ++k) {
$lines
    }
$whole}"""

_INIT_AT = """\
/* At rest at a measurement. */
static inline void ${name}_init_at(${name}_state *state, const $real measurement[${NAME}_AXES])
{
    ${name}_init(state);
    for (int k = 0; k < ${NAME}_AXES; ++k)
        state->$measured[k] = measurement[k];
}"""


class Gain(NamedTuple):
    """A constant of the controller."""

    note: str  # unit and meaning
    values: np.ndarray  # [axes]


class Source(NamedTuple):
    """The C of one controller; its functions are templates of `$name`, `$NAME`, `$real`, `$f`."""

    what: str
    dt: float  # s
    settings: Mapping[str, str]  # provenance, by name
    gains: Mapping[str, Gain]
    state: Mapping[str, str]  # notes of its members, arrays [axes]
    functions: tuple[str, ...]
    tables: tuple[str, ...] = ()  # further constants, as templates
    flags: Mapping[str, str] = {}  # of the state, one for all axes, with their notes
    needs_libm: bool = False


def axes_text(count: int) -> str:
    return f"{count} axis" if count == 1 else f"{count} axes"


def per_axis(values: Mapping[str, jax.Array], axes: int | None) -> tuple[int, dict]:
    """How many axes there are, and every gain as a NumPy array with one value for each.

    Raises ValueError for an ensemble, and where nothing says how many axes there are.
    """
    found = {name: np.asarray(value) for name, value in values.items()}
    wide = {name: x.shape for name, x in found.items() if x.ndim > 1}
    if wide:
        text = ", ".join(f"{name} {shape}" for name, shape in wide.items())
        raise ValueError(
            f"The gains are those of an ensemble, {text}, but a header holds one controller: pick "
            "a member, as jax.tree.map(lambda x: x[:, 0] if x.ndim > 1 else x, controller)."
        )
    count = {len(x) for x in found.values() if x.ndim} or ({axes} if axes else set())
    if not count:
        raise ValueError(
            "All gains are scalars, which fit any number of axes: give axes, as axes=3."
        )
    if len(count | ({axes} if axes else set())) > 1:
        raise ValueError(f"axes is {axes}, but the gains are for {sorted(count)}.")
    [axes] = count
    return axes, {name: np.broadcast_to(x, (axes,)) for name, x in found.items()}


def require_precision(values: Mapping[str, jax.Array], precision: Precision) -> None:
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
    }  # fmt: skip
    parts = [
        _comment(source, precision, version),
        _top(source),
        _gains(source, precision),
        *source.tables,
        _state(source),
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
    includes = ["#include <float.h>"] + ["#include <math.h>"] * source.needs_libm
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
    members += [f"    int {name}; /* {note} */" for name, note in source.flags.items()]
    return "\n".join(["typedef struct {", *members, "} ${name}_state;"])


_LIMITED = """\
static inline $real ${name}_limited($real x, $real limit)
{
    return x > limit ? limit : x < -limit ? -limit : x;
}"""
