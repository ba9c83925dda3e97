"""What a controller brings to its header, and the text of the parts that all have in common."""

from collections.abc import Mapping
from string import Template
from typing import NamedTuple

import jax
import numpy as np

from ._number import braced, number, Precision, type_of


class Gain(NamedTuple):
    """A constant of the controller."""

    note: str  # unit and meaning
    values: np.ndarray  # [axes]


class Source(NamedTuple):
    """The C of one controller; its functions are templates of `$name`, `$NAME`, `$real`, `$f`."""

    what: str
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
            f"The gains are those of an ensemble, {text}: a header holds one controller, so pick a "
            "member, as jax.tree.map(lambda x: x[:, 0] if x.ndim > 1 else x, controller)."
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
            f"{coarse[0]} is a float32, so that a header in double would show digits that it has "
            'not: take precision="float", or make the controller after '
            'jax.config.update("jax_enable_x64", True).'
        )


def written(source: Source, name: str, precision: Precision, dt: float, version: str) -> str:
    """The header."""
    axes = len(next(gain.values for gain in source.gains.values()))
    names = {
        "name": name, "NAME": name.upper(), "real": precision,
        "f": "f" if precision == "float" else "", "axes": axes,
        "dt": number(dt, "dt", precision),
    }  # fmt: skip
    parts = [
        _comment(source, precision, dt, version),
        _top(source),
        _gains(source, precision),
        *source.tables,
        _state(source),
        _LIMITED,
        *source.functions,
        "#endif",
    ]
    return Template("\n\n".join(parts) + "\n").substitute(names)


def _comment(source: Source, precision: Precision, dt: float, version: str) -> str:
    lines = [source.what, "", f"Written by jaxquad {version}; do not edit, export it anew."]
    lines.append(f"Sample interval {dt!r} s, numbers in {precision}. SI units and radians.")
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
