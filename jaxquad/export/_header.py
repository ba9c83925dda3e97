"""Controllers as C headers: what a controller brings to its header, and the text of all others."""

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from string import Template
from typing import Literal, NamedTuple, Protocol, runtime_checkable

import jax
import numpy as np

from jaxquad._core import __version__, write_file


Precision = Literal["float", "double"]
_TYPES = {"float": np.float32, "double": np.float64}


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


@runtime_checkable
class ExportableController(Protocol):
    """A controller of a user's own that brings its C: `c_header` writes what `c_source` returns."""

    def c_source(self, axes: int | None, precision: Precision) -> Source:
        """The C of this controller for so many `axes`; None where the gains say how many."""
        ...


def c_header(
    controller: object, *, name: str = "attitude", precision: Precision = "float",
    axes: int | None = None,
) -> str:  # fmt: skip
    """Write a LADRC or a PID, plain or scheduled, as one C99 header, which C++ compiles too.

    Its functions are `<name>_init(state)`, `<name>_step(state, reference, reference_rate,
    reference_acceleration, measurement, command)` once a sample and, of a LADRC,
    `<name>_applied(state, achieved)` and `<name>_init_at(state, measurement)`; a scheduled
    controller has `<name>_schedule(state, inertia)`. Signals are arrays of `<NAME>_AXES`, in rad
    and units of the command; the derivatives of the set-point may be null pointers. The difference
    equations are those of `controller.step`, to rounding. Nothing is allocated; memcpy is called,
    and by a map log and exp.

    A sample with a NaN or an infinity, in the set-point or in the measurement, keeps the state and
    the command of its axis, also under -ffast-math, as if it had not been taken. Such an inertia,
    start or achieved command is ignored. In JAX `step` has no such rule.

    **Arguments:**

    - `controller`: a `LADRC`, `PID`, `ScheduledLADRC` or `ScheduledPID`, or one of your own with a
        method `c_source`, an `ExportableController`; or a `jq.control.FourierInertia`, whose
        functions are `_init`, `_update(state, command, measurement)` and `_estimate(state, inertia,
        deviation, trusted)`.
    - `name`: begins all identifiers.
    - `precision`: "float" or "double".
    - `axes`: how many; needed where all gains are scalars.

    **Returns:**

    The text of the header.

    **Raises:**

    - `ValueError`: the controller is of another class or an ensemble, the C type does not hold a
        number, or `name` is no C identifier.
    """
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or "__" in name:
        raise ValueError(
            f"name is {name!r}, which is no C identifier: use letters, digits and single "
            "underscores, with a letter first."
        )
    from ._laws import source_of

    if isinstance(controller, ExportableController):
        source = controller.c_source(axes, precision)
    else:
        source = source_of(controller, axes, precision)
    comment = [
        source.what, "", f"Written by jaxquad {__version__}; do not edit it, export it again.",
        f"Sample interval {source.dt!r} s, numbers in {precision}. SI units and radians.",
        *(f"{name}: {text}" for name, text in source.settings.items()),
    ]  # fmt: skip
    about = "\n".join(f" * {line}".rstrip() for line in comment)[3:].replace("$", "")
    libraries = ["float.h", *["math.h"] * source.needs_libm, "stdint.h", "string.h"]
    columns = [[number(x, n, precision) for x in gain.values] for n, gain in source.gains.items()]
    names = {
        "name": name, "NAME": name.upper(), "real": precision,
        "f": "f" if precision == "float" else "", "axes": len(columns[0]),
        "dt": number(source.dt, "dt", precision),
        "bits": "uint32_t" if precision == "float" else "uint64_t",
        "exponent": "0x7F800000u" if precision == "float" else "0x7FF0000000000000u",
    }  # fmt: skip
    parts = {
        "about": about,
        "includes": "\n".join(f"#include <{library}>" for library in libraries),
        "gains": "".join(f"    $real {n}; /* {gain.note} */\n" for n, gain in source.gains.items()),
        "rows": "".join(f"    {braced(row)},\n" for row in zip(*columns, strict=True)),
        "tables": "".join(f"{table}\n\n" for table in source.tables),
        "state": "".join(
            f"    {kind} {n}[${{NAME}}_AXES]; /* {note} */\n"
            for kind, members in (("$real", source.state), ("int", source.flags))
            for n, note in members.items()
        ),
        "functions": "\n\n".join(source.functions),
    }
    return Template(Template(_HEADER).safe_substitute(parts)).substitute(names)


def write_c_header(
    path: str | Path, controller: object, *, name: str = "attitude",
    precision: Precision = "float", axes: int | None = None,
) -> Path:  # fmt: skip
    """Write `c_header` to a file; an interrupted call leaves no half-written file.

    **Arguments:**

    - `path`: of the file; missing folders are created. The others are those of `c_header`.

    **Returns:** the path.

    **Raises:**

    - `ValueError`: as `c_header`.
    """
    return write_file(path, c_header(controller, name=name, precision=precision, axes=axes))


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
    lost = np.isinf(rounded) and not np.isinf(value) or rounded == 0 and value != 0
    if np.isnan(value) or lost:
        raise ValueError(f"{name} is {value}, which a C {precision} cannot hold: check the gains.")
    if np.isinf(rounded):
        most = "FLT_MAX" if precision == "float" else "DBL_MAX"
        return most if rounded > 0 else f"-{most}"
    text = str(rounded)  # the shortest that reads back
    is_digits = not any(mark in text for mark in ".e")
    return text + ".0" * is_digits + "f" * (precision == "float")


def braced(values: Iterable[str]) -> str:
    return "{" + ", ".join(values) + "}"


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


# A number is tested by its bits, which no compiler's option changes: -ffast-math takes x == x for
# true.
_HEADER = """\
/* ${about}
 */

#ifndef ${NAME}_H
#define ${NAME}_H

${includes}

#define ${NAME}_AXES $axes
#define ${NAME}_DT $dt /* s */

typedef struct {
${gains}} ${name}_gains;

static const ${name}_gains ${name}_table[${NAME}_AXES] = {
${rows}};

${tables}typedef struct {
${state}} ${name}_state;

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
}

/* A NaN comes out as 0. */
static inline $real ${name}_limited($real x, $real limit)
{
    return x < -limit ? -limit : x <= limit ? x : x > limit ? limit : 0;
}

${functions}

#endif
"""
