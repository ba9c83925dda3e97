import os
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Protocol, runtime_checkable

from jaxquad.control import AdaptiveLADRC, LADRC, PID, ScheduledLADRC, ScheduledPID

from ._ladrc import ladrc_source, scheduled_ladrc_source
from ._pid import pid_source, scheduled_pid_source
from ._source import Precision, Source, written


@runtime_checkable
class ExportableController(Protocol):
    """A controller of a user's own that brings its C: `c_header` writes what `c_source` returns."""

    def c_source(self, axes: int | None, precision: Precision) -> Source:
        """The C of this controller for so many `axes`; None where the gains say how many."""
        ...


_SOURCES = {
    LADRC: ladrc_source,
    ScheduledLADRC: scheduled_ladrc_source,
    PID: pid_source,
    ScheduledPID: scheduled_pid_source,
}


def c_header(
    controller: object,
    *,
    name: str = "attitude",
    precision: Precision = "float",
    axes: int | None = None,
) -> str:
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
        method `c_source`, an `ExportableController`.
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
    return written(_source_of(controller, axes, precision), name, precision, _version())


def _source_of(controller: object, axes: int | None, precision: Precision) -> Source:
    if isinstance(controller, ExportableController):
        return controller.c_source(axes, precision)
    if isinstance(controller, AdaptiveLADRC):
        raise ValueError(
            "The controller is an AdaptiveLADRC, whose estimator cannot be written in C: write a "
            "jq.control.ScheduledLADRC, and call its _schedule with your estimate of the inertia."
        )
    source = _SOURCES.get(type(controller))
    if source is None:
        classes = ", ".join(kind.__name__ for kind in _SOURCES)
        raise ValueError(
            f"The controller is a {type(controller).__name__}, but only {classes} can be written "
            "in C. Give a class of your own a method c_source(axes, precision) that returns a "
            "jq.export.Source."
        )
    return source(controller, axes, precision)


def write_c_header(
    path: str | Path,
    controller: object,
    *,
    name: str = "attitude",
    precision: Precision = "float",
    axes: int | None = None,
) -> Path:
    """Write `c_header` to a file; an interrupted call leaves no half-written file.

    **Arguments:**

    - `path`: of the file; missing folders are created. The others are those of `c_header`.

    **Returns:**

    The path.

    **Raises:**

    - `ValueError`: as `c_header`.
    """
    text = c_header(controller, name=name, precision=precision, axes=axes)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    draft.write_text(text)
    return draft.replace(path)


def _version() -> str:
    try:
        return version("jaxquad")
    except PackageNotFoundError:
        return "from a source tree"
