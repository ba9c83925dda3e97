import os
import re
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from jaxquad.control import LADRC, PID, ScheduledLADRC, ScheduledPID

from ._ladrc import ladrc_source, scheduled_ladrc_source
from ._pid import pid_source, scheduled_pid_source
from ._source import Precision, written


_SOURCES = {
    LADRC: ladrc_source,
    ScheduledLADRC: scheduled_ladrc_source,
    PID: pid_source,
    ScheduledPID: scheduled_pid_source,
}


def c_header(
    controller: Any,
    *,
    name: str = "attitude",
    precision: Precision = "float",
    axes: int | None = None,
) -> str:
    """A LADRC or a PID, plain or scheduled, as one self-contained C99 header; C++ takes it, too.

    Its functions are `<name>_init(state)`, `<name>_step(state, reference, reference_rate,
    reference_acceleration, measurement, command)` once a sample and, of a LADRC,
    `<name>_applied(state, achieved)` and `<name>_init_at(state, measurement)`; a scheduled
    controller has `<name>_schedule(state, inertia)`. Signals are arrays of `<NAME>_AXES`, in rad
    and units of the command; the set-point's derivatives may be null pointers. The difference
    equations are those of `controller.step`, to rounding. Nothing is allocated, and only a map
    calls the C library (log and exp). `axes` is needed where all gains are scalars.
    Raises ValueError for an ensemble, for numbers that C's type does not hold, for a `name` that is
    no C identifier and for a controller that cannot be written.
    """
    source = _SOURCES.get(type(controller))
    if source is None:
        known = ", ".join(f"jq.{kind.__name__}" for kind in _SOURCES)
        raise ValueError(
            f"the controller is a {type(controller).__name__}, but {known} can be written in C; of "
            "an adaptive LADRC, write the jq.control.ScheduledLADRC and tell it your estimate."
        )
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", name) or "__" in name:
        raise ValueError(
            f"name is {name!r}, but it must begin C identifiers: letters, digits and single "
            "underscores, a letter first."
        )
    return written(source(controller, axes, precision), name, precision, controller.dt, _version())


def write_c_header(
    path: str | Path,
    controller: Any,
    *,
    name: str = "attitude",
    precision: Precision = "float",
    axes: int | None = None,
) -> Path:
    """Write `c_header` to `path`, whole or not at all; returns the path.

    Folders are made as needed. Raises ValueError as `c_header` does.
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
