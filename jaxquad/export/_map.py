"""A b0 map in C."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Array

from jaxquad.control import InertiaMap

from ._source import braced, number, Precision


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


def map_gains(rule: InertiaMap) -> dict[str, Array]:
    """What a map has per axis."""
    return {"nominal": rule.nominal} | {f"values[{k}]": row for k, row in enumerate(rule.values)}


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
