"""Metrics of a loop or of an ensemble's members as labelled arrays of xarray."""

from typing import TYPE_CHECKING

import numpy as np


if TYPE_CHECKING:
    import xarray

    from ._metrics import Metrics


_UNITS = {
    "itae": "rad s^2", "iae": "rad s", "ise": "rad^2 s", "overshoot": "%", "rise_time": "s",
    "settling_time": "s", "settling_time_5": "s", "peak": "rad", "rms": "rad",
    "disturbance_rmse": "N m", "activity": "", "energy": "", "saturation_share": "1",
    "step": "rad", "stepped": "", "diverged": "", "beyond_authority": "1", "reversing": "1",
}  # fmt: skip
_OF_A_UNIT_STEP = {"itae": "s^2", "iae": "s", "ise": "s"}


def to_xarray(metrics: "Metrics", axes: tuple[str, ...]) -> "xarray.Dataset":
    """`Metrics.to_xarray`, with names for the axes."""
    import xarray

    depth = metrics.diverged.ndim
    members = ("member",) if depth == 1 else tuple(f"member_{k}" for k in range(depth))
    units = _UNITS | (_OF_A_UNIT_STEP if metrics.per_step else {})
    variables = {}
    for name, unit in units.items():
        values = np.asarray(vars(metrics)[name])
        dims = members if name == "diverged" else ("axis", *members)
        variables[name] = (dims, values, {"units": unit} if unit else {})
    counts = {name: np.arange(n) for name, n in zip(members, metrics.diverged.shape, strict=True)}
    window = {name: vars(metrics)[name] for name in ("start", "stop", "load_start")}  # s
    return xarray.Dataset(variables, coords={"axis": list(axes), **counts}, attrs=window)
