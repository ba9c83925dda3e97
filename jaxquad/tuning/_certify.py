import dataclasses
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from jaxquad.ensembles import Ensemble, Members
from jaxquad.simulation import Scenario

from ._certificate import Certificate, lag_remark
from ._distance import distances
from ._judge import axes_of, judge, Span
from ._judged import LINEAR


def certify(
    controller: Any,
    ensemble: Ensemble | Members,
    scenario: Scenario,
    *,
    limits: Sequence[Any] = (),
    peers: Mapping[str, Any] | None = None,
    members: int = 256,
    key: Key[Array, ""] | None = None,
    events: Sequence[float] = (),
    start: float = 0.0,
    stop: float | None = None,
    load_start: float | None = None,
    name: str = "tuned",
    devices: int | Sequence[Any] | None = None,
) -> Certificate:
    """Show what a design does on members that its tuner never saw, beside its `peers`.

    Of an `ensemble`, `members` are drawn at random, each by itself, by `ensemble.fresh` with `key`
    (`jax.random.key(0)` if None): give the tuner's key, whose training members are other draws.
    `jq.ensembles.Members` are taken as they are, and it is on the caller that nothing was tuned on them.
    All designs fly the `scenario` with the same noise. `limits` are `jq.Limit`s. At the `events`,
    times in s, ITAE's clock starts anew and the overshoot of a step is judged; `start`, `stop`,
    `load_start` and `devices` are those of `jq.evaluate`, all best as the tuner's. A payload
    counts in the linear loops with the most and the least of it, the worse of all.
    Raises ValueError for parts that do not fit, and for limits on what is not judged.
    """
    key = jax.random.key(0) if key is None else key
    drawn = _drawn(ensemble, members, key)
    flight = drawn.flight(scenario)
    designs = {name: controller, **{_free(n, name): peer for n, peer in (peers or {}).items()}}
    span = Span(events, start, stop, load_start)
    judged = {n: judge(design, drawn, flight, span, devices) for n, design in designs.items()}
    facts, nominal = _facts(drawn), _nominal(ensemble)
    found = Certificate(
        judged, distances(judged[name], limits), facts, nominal,
        _provenance(ensemble, drawn, key) | {"controller": _numbers(controller)}, (),
    )  # fmt: skip
    return dataclasses.replace(found, remarks=tuple(_remarks(found, controller, drawn)))


def _drawn(ensemble: Ensemble | Members, count: int, key: Key[Array, ""]) -> Members:
    if isinstance(ensemble, Members):
        return ensemble
    return ensemble.fresh(count, key)  # independent draws, as the bound of a share needs


def _free(peer: str, name: str) -> str:
    if peer == name:
        raise ValueError(f"a peer has the name {peer!r} of the design itself: call it otherwise")
    return peer


def _facts(drawn: Members) -> dict[str, Float[np.ndarray, "axes members"]]:
    plant = axes_of(drawn.plant)
    given = {"inertia": plant.inertia, "torque_gain": plant.torque_gain, "lag": plant.lag}
    shape = (plant.shape[0], drawn.size)
    wide = lambda x: np.broadcast_to(np.asarray(x) if x.ndim > 1 else x[:, None], shape)
    facts = {n: np.array(wide(x)) for n, x in given.items() if x is not None}
    facts["delay"] = np.array(np.broadcast_to(np.asarray(drawn.delay), shape))
    return facts | {"told": np.asarray(drawn.inertia_told) / facts["inertia"]}


def _nominal(ensemble: Ensemble | Members) -> Float[np.ndarray, " axes"] | None:
    if isinstance(ensemble, Members):
        return None
    axes = axes_of(ensemble.plant)
    return np.array(jnp.broadcast_to(axes.inertia, axes.shape))


def _provenance(given: Any, drawn: Members, key: Key[Array, ""]) -> dict[str, Any]:
    fresh = isinstance(given, Ensemble)
    names = ("jaxquad", "jax", "jaxlib", "numpy")
    return {
        "members": drawn.size,
        "fresh": fresh,
        "sampling": "random" if fresh else "given",
        "key": np.asarray(jax.random.key_data(key)).tolist() if fresh else None,
        "precision": str(drawn.inertia_told.dtype),
        "ensemble": str(given).splitlines() if fresh else None,
        "device": jax.devices()[0].device_kind,
        "versions": {name: version(name) for name in names},
    }


def _numbers(controller: Any) -> dict[str, Any]:
    """The controller's class and numbers, by their places in it."""
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(controller, eqx.is_array))
    numbers = {jax.tree_util.keystr(path)[1:]: np.asarray(x).tolist() for path, x in leaves}
    return {"class": type(controller).__name__, "numbers": numbers}


def _remarks(found: Certificate, controller: Any, drawn: Members) -> list[str]:
    missed = [x for x in found.distances if x.quantity in LINEAR and not x.met]
    lag = lag_remark(controller, drawn.delay, axes_of(drawn.plant).lag)
    remarks = [lag] if lag and (missed or not found.stable) else []
    if not found.independent:
        remarks.append("the members were given: whether a tuner saw them is not known here")
    counts = {n: x.unstable_count for n, x in found.designs.items() if x.unstable_count}
    if counts:
        text = ", ".join(f"{count} of {n}" for n, count in counts.items())
        remarks.append(f"no Ms and no margins (n/a) over members that are unstable: {text}")
    runaways = [(n, x.runaway) for n, x in found.designs.items() if x.runaway and n != found.name]
    return remarks + [f"of {n}, {why}" for n, why in runaways]
