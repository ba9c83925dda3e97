"""`Metrics` for print: angles in degrees, what does not exist as a dash."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import ArrayLike

from jaxquad.records import AXES


if TYPE_CHECKING:
    from ._metrics import Metrics


_NOTHING = 1e-9  # in every unit of the table
_DEGREE = float(np.degrees(1.0))
# Field, title, unit and factor of the absolute number, unit and factor of that of a unit step.
_ROWS = (
    ("itae", "ITAE", ("deg s^2", _DEGREE), ("s^2", 1.0)),
    ("iae", "IAE", ("deg s", _DEGREE), ("s", 1.0)),
    ("ise", "ISE", ("deg^2 s", _DEGREE**2), ("s", 1.0)),
    ("overshoot", "overshoot", ("%", 1.0), None),
    ("rise_time", "rise time", ("s", 1.0), None),
    ("settling_time", "settling time 2 %", ("s", 1.0), None),
    ("settling_time_5", "settling time 5 %", ("s", 1.0), None),
    ("peak", "peak error", ("deg", _DEGREE), None),
    ("rms", "rms error", ("deg", _DEGREE), None),
    ("disturbance_rmse", "disturbance error", ("N m", 1.0), None),
    ("activity", "activity", ("", 1.0), None),
    ("energy", "energy", ("", 1.0), None),
    ("saturation_share", "saturated", ("%", 100.0), None),
)
_STATISTICS = (("mean", "mean"), ("p95", "p95"), ("worst", "worst"), ("cvar20", "CVaR20"))


def described(metrics: "Metrics") -> str:
    """A table of one loop, or one for each axis of an ensemble, and the remarks."""
    names = axis_names(metrics.itae.shape[0])
    members = metrics.diverged.size
    head = f"metrics, {metrics.start:.6g} .. {metrics.stop:.6g} s"
    if metrics.load_start != metrics.start:
        head += f", under load from {metrics.load_start:.6g} s"
    if metrics.per_step:
        head += ", integrals of a unit step"
    if metrics.diverged.ndim:
        head += f", {members} member{'s' * (members > 1)}"
        table = _ensemble_tables(metrics, names)
    else:
        values = [np.asarray(vars(metrics)[row[0]]) for row in _ROWS]
        table = _table("", list(names), values, metrics.per_step)
    return "\n".join([head, *table, *(f"  ! {remark}" for remark in remarks(metrics))])


def axis_names(count: int) -> tuple[str, ...]:
    return AXES[:count] if count <= len(AXES) else tuple(f"axis {k}" for k in range(count))


def _ensemble_tables(metrics: "Metrics", names: tuple[str, ...]) -> list[str]:
    summary, lines, still = metrics.summary(), [], at_rest(metrics)
    for k, name in enumerate(names):
        if still[k]:
            lines.append(f"  {name}: at rest")
            continue
        values = []
        for row in _ROWS:
            spread = vars(summary)[row[0]]._asdict()
            values.append(np.array([spread[field][k] for field, _ in _STATISTICS]))
        lines += _table(name, [title for _, title in _STATISTICS], values, metrics.per_step)
    return lines


def at_rest(metrics: "Metrics") -> np.ndarray:
    """Axes in which nothing happens."""
    names = ("itae", "activity", "energy")
    moved = [np.nan_to_num(_flat(vars(metrics)[name])).any(axis=1) for name in names]
    return ~np.any(moved, axis=0)


def _table(name: str, columns: list[str], values: list[np.ndarray], per_step: bool) -> list[str]:
    lines = [f"  {name:<28}" + "".join(f"{column:>11}" for column in columns)]
    for (_, title, absolute, relative), numbers in zip(_ROWS, values, strict=True):
        unit, scale = relative if per_step and relative is not None else absolute
        texts = "".join(f"{_text(x * scale):>11}" for x in numbers)
        lines.append(f"  {title:<19}{unit:<9}{texts}")
    return lines


def _text(x: float) -> str:
    if np.isnan(x):
        return "-"
    return "never" if np.isinf(x) else f"{x if abs(x) > _NOTHING else 0:.4g}"


def remarks(metrics: "Metrics") -> list[str]:
    """Why a number is missing, who diverged, and what the drive cannot do."""
    names = axis_names(metrics.itae.shape[0])
    found = _divergence(metrics) + _steps(metrics, names)
    return found + _estimate(metrics) + _torque(metrics, names)


def _divergence(metrics: "Metrics") -> list[str]:
    count, members = int(np.sum(metrics.diverged)), metrics.diverged.size
    if not count:
        return []
    who = f"{count} of {members} members ({count / members:.1%})" if members > 1 else "the loop"
    return [f"{who} diverged: the numbers count its angle as held where it left the bound"]


def _steps(metrics: "Metrics", names: tuple[str, ...]) -> list[str]:
    stepped = _flat(metrics.stepped)
    missing = ~stepped.any(axis=1) & ~at_rest(metrics)
    without = [name for name, there in zip(names, missing, strict=True) if there]
    found = []
    if without:
        found.append(
            f"{', '.join(without)}: the reference makes no step that it holds, hence no "
            "overshoot, rise or settling"
        )
    for field, what in (
        ("rise_time", "does not reach 90 % of the step"),
        ("settling_time", "is outside 2 % of the step at the end"),
    ):
        never = np.isnan(_flat(vars(metrics)[field])) & stepped
        found += _shares(names, never.mean(axis=1), what, never.shape[1])
    return found


def _shares(names: tuple[str, ...], shares: np.ndarray, what: str, members: int) -> list[str]:
    where = [(name, share) for name, share in zip(names, shares, strict=True) if share]
    if members == 1:
        return [f"{name} {what}" for name, _ in where]
    return [f"{name}: {share:.1%} of the members: the angle {what}" for name, share in where]


def _estimate(metrics: "Metrics") -> list[str]:
    if not np.isnan(np.asarray(metrics.disturbance_rmse)).all():
        return []
    return [
        "no error of the disturbance estimate: the controller makes none, or the plant's torque "
        "per unit of command is not known (give torque_gain)"
    ]


def _torque(metrics: "Metrics", names: tuple[str, ...]) -> list[str]:
    found = []
    for field, what in (
        ("beyond_authority", "exceed the torque of the drive"),
        ("reversing", "need motors that turn backwards"),
    ):
        shares = np.nan_to_num(_flat(vars(metrics)[field])).mean(axis=1)
        where = [f"{x:.1%} on {name}" for name, x in zip(names, shares, strict=True) if x]
        if where:
            found.append(f"disturbances {what}: samples {', '.join(where)}")
    return found


def _flat(values: ArrayLike) -> np.ndarray:
    array = np.asarray(values)
    return array.reshape(array.shape[0], -1)
