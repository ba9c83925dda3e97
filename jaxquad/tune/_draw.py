"""From an ensemble's laws to its members."""

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Array, Float, Key

from jaxquad.models._parameters import as_float

from ._law import Law, Shares
from ._laws import scores
from ._members import Members
from ._payload import Carried
from ._sampling import grid_points, member_keys, unit_points
from ._variation import Drawn, plant_inertia, times, varied


Wide = Callable[[np.ndarray], Float[np.ndarray, "axes members"]]


def drawn_members(ensemble: Any, n: int, key: Key[Array, ""], sampling: str) -> Members:
    """`n` members of an `Ensemble`."""
    laws, axes = ensemble.laws, ensemble.axes
    rows = _rows(laws, ensemble.independent, axes)
    deviates = 0 if ensemble.fitted is None else ensemble.fitted.deviates
    points = _points(laws, rows, deviates, n, key, sampling)
    drawn = _values(laws, rows, points, axes)
    wide: Wide = lambda x: np.broadcast_to(x if x.ndim > 1 else x[:, None], (axes, n))
    plant, delay, longest = ensemble.plant, np.zeros(1), 0.0
    if ensemble.fitted is not None:
        plant, delay, longest = ensemble.fitted.plants(scores(points[sum(rows.values()) :]))
    if "delay" in laws:
        delay, longest = drawn["delay"], _latest(laws["delay"])
    believed = times(plant_inertia(ensemble.plant), drawn["inertia"])
    return Members(
        plant=varied(plant, drawn),
        delay=as_float(wide(delay)[0]),
        inertia_told=as_float(wide(times(believed, drawn["told"]))),
        keys=member_keys(key, n),
        noise=as_float(wide(drawn["noise"])) if "noise" in laws else None,
        gust=as_float(wide(drawn["gust"])) if "gust" in laws else None,
        payload=_carried(ensemble, laws, drawn, wide),
        drive=ensemble.drive,
        encoder=ensemble.encoder,
        longest_delay=longest,
        gust_corner=ensemble.gust_corner,
        dt=ensemble.dt,
    )


def _rows(laws: dict[str, Law], independent: tuple[str, ...], axes: int) -> dict[str, int]:
    """How many numbers each law draws for a member."""
    return {name: axes if name in independent else 1 for name, law in laws.items() if law.varies}


def _points(
    laws: dict[str, Law],
    rows: dict[str, int],
    deviates: int,
    n: int,
    key: Key[Array, ""],
    sampling: str,
) -> Shares:
    """Shares of the probability: of the laws first, then of the fit."""
    if sampling == "grid":
        return grid_points([laws[name] for name, count in rows.items() for _ in range(count)], n)
    return unit_points(sampling, key, sum(rows.values()) + deviates, n)


def _values(laws: dict[str, Law], rows: dict[str, int], points: Shares, axes: int) -> Drawn:
    """Of each quantity, [axes] where it is known and [axes, members] where it varies."""
    drawn, first = {}, 0
    for name, law in laws.items():
        if not law.varies:
            drawn[name] = np.broadcast_to(law.support[0], (axes,))
            continue
        value = law.quantile(points[first : first + rows[name]])
        drawn[name] = np.broadcast_to(value, (axes, points.shape[1]))
        first += rows[name]
    return drawn


def _carried(ensemble: Any, laws: dict[str, Law], drawn: Drawn, wide: Wide) -> Carried | None:
    if ensemble.payload is None:
        return None
    inertia = times(plant_inertia(ensemble.plant), drawn["payload added"])
    at = wide(drawn["payload at"])[0]
    until = np.full(at.shape, np.inf)
    if "payload width" in laws:
        until = at + wide(drawn["payload width"])[0]
    parts = (as_float(x) for x in (wide(inertia), at, until))
    return Carried(*parts, latest=_latest(laws["payload at"]))


def _latest(law: Law) -> float:
    return float(np.max(law.support[1]))
