import dataclasses
import functools as ft
import warnings
from collections.abc import Mapping, Sequence
from importlib.metadata import version

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from jaxquad.control import (
    LADRC,
    LinearisableController,
    ObserverController,
    PID,
    Reference,
    schedule_for_analysis,
)
from jaxquad.ensembles import Ensemble, Members
from jaxquad.loops import Loop, loop_numbers, LoopNumbers
from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.simulation import (
    Authority,
    AuthorityWarning,
    beyond_authority,
    evaluate,
    find_authority,
    Metrics,
    Scenario,
)

from ._certificate import Certificate, find_ladrc, lag_remark, Provenance
from ._design_result import DesignResult, measure_distances
from ._objective import Limit
from ._problem import DeviceChoice, TimeSpan
from ._quantities import LINEAR, QUANTITIES


Plant = DecoupledAxes | Multirotor


def certify(
    loop: Loop,
    ensemble: Ensemble | Members,
    scenario: Scenario,
    *,
    limits: Sequence[Limit] = (),
    peers: Mapping[str, PyTree] | None = None,
    begun: PyTree | None = None,
    members: int = 256,
    key: Key[Array, ""] | None = None,
    events: Sequence[float] = (),
    start: float = 0.0,
    stop: float | None = None,
    load_start: float | None = None,
    name: str = "tuned",
    devices: DeviceChoice = None,
) -> Certificate:
    """Evaluate a design on members that its tuner never saw, beside its peers.

    A payload counts in the linear loops with the most and the least of it, the worse of all.

    !!! example

        ```python
        certificate = jq.certify(loop.with_controller(tuned.controller), ensemble, flight,
                                 limits=[jq.Limit("sensitivity_peak", at_most=3.6)])
        print(certificate)
        ```

    **Arguments:**

    - `loop`: the design is `loop.controller`; the rest is nominal.
    - `ensemble`: `members` are drawn from it at random, each by itself, by `ensemble.fresh`.
        `jq.ensembles.Members` are taken as they are, and nothing may have been tuned on them.
    - `scenario`: all designs fly it with the same noise.
    - `limits`: what the design has to meet.
    - `peers`: other controllers to stand beside the design, by name.
    - `begun`: the controller that a tuning started from, whose error stands beside the design's.
    - `members`: how many are drawn.
    - `key`: give the tuner's key, whose training members are other draws; `jax.random.key(0)` by
        default.
    - `events`: times in s at which ITAE's clock starts again and a new step begins.
    - `start`, `stop`, `load_start`, `devices`: see `jq.evaluate`; best as for the tuner.
    - `name`: of the design in the certificate.

    **Returns:**

    A `jq.tuning.Certificate`; `print` shows the verdicts first, then limits and a table.

    **Raises:**

    - `ValueError`: parts do not fit together, or a limit is on what is not computed.
    """
    key = jax.random.key(0) if key is None else key
    if not isinstance(ensemble, Ensemble | Members):
        raise ValueError(
            f"ensemble is a {type(ensemble).__name__}: give jq.Ensemble(inertia=...), or "
            "jq.ensembles.Members of it"
        )
    given = isinstance(ensemble, Members)
    # Independent draws, as the bound of a share needs.
    drawn = ensemble if given else ensemble.fresh(loop, members, key)
    require_same_rate(loop, drawn)
    flight = drawn.flight(scenario)
    designs = {name: loop.controller} | _named(peers or {}, name)
    span = TimeSpan(tuple(events), start, stop, load_start)
    run = ft.partial(evaluate_design, members=drawn, flight=flight, span=span, devices=devices)
    results = {n: run(x) for n, x in designs.items()}
    known = _provenance(ensemble, drawn, key)
    known["controller"] = _describe_controller(loop.controller)
    found = Certificate(
        designs=results,
        distances=measure_distances(results[name], limits, independent=not given),
        facts=_facts(drawn),
        nominal=_nominal_inertia(loop) if isinstance(ensemble, Ensemble) else None,
        provenance=known,
        remarks=(),
        idle=run(_Idle()),
        start=None if begun is None else run(begun),
        error="itae" if _moves(flight) else "rms",
    )
    limits_of = _authority(loop, drawn)
    remarks = _remarks(found, loop.controller, drawn) + beyond_authority(limits_of, flight)
    if isinstance(ensemble, Ensemble) and ensemble.plants is not None:
        remarks += _beyond_band(loop.controller, ensemble.plants.band)
        remarks += _beyond_record(limits_of, ensemble.plants.largest_command)
    return dataclasses.replace(found, remarks=tuple(remarks))


class _Idle(eqx.Module):
    """The controller that does nothing."""

    def init(self, like: Float[Array, " axes *ensemble"]) -> None:
        """It remembers nothing."""
        return None

    def step(
        self, state: None, reference: Reference, measurement: Float[Array, " axes *ensemble"]
    ) -> tuple[None, Float[Array, " axes *ensemble"]]:
        """The command 0."""
        return None, jnp.zeros_like(measurement)


def _moves(flight: Scenario) -> bool:
    """Whether the reference leaves 0: then the time of the error counts, else its size alone."""
    return bool(np.any(np.asarray(flight.reference) != 0))


def _authority(loop: Loop, drawn: Members) -> Authority | None:
    members = drawn.loop(loop.controller)
    return find_authority(members.plant, members.drive, members.controller)


_ROUNDED = 1.01  # by which a number may exceed what the record knows without a word


def _beyond_record(found: Authority | None, largest: float | None) -> list[str]:
    """Whether the command may exceed all that the record has, where both are known."""
    limit = np.inf if found is None else float(np.max(np.asarray(found.command)))
    if largest is None or not np.isfinite(limit) or limit <= _ROUNDED * largest:
        return []
    return [
        f"the limit of the command, {limit:.4g}, is {limit / largest:.2g} times the largest "
        f"command of the record, {largest:.3g}: the model is not known there. Lower the limit to "
        f"{largest:.2g}, or record larger commands"
    ]


def _beyond_band(controller: PyTree, band: tuple[float, float] | None) -> list[str]:
    """Which bandwidths of a LADRC lie beyond the identified band, where it is known."""
    ladrc = find_ladrc(controller)
    if band is None or ladrc is None:
        return []
    rates = {name: float(np.max(np.asarray(vars(ladrc)[name]))) for name in ("wc", "wo")}
    return [
        f"{name} = {value:.4g} rad/s lies beyond the identified band of {band[0]:.3g} to "
        f"{band[1]:.3g} rad/s: the design relies on a model that no data support there. Hold "
        f"{name} at {band[1]:.2g} rad/s or below, or record to higher frequencies"
        for name, value in rates.items()
        if value > _ROUNDED * band[1]
    ]


def require_same_rate(loop: Loop, members: Members) -> None:
    """Raise ValueError for members that were drawn around a loop of another sample interval."""
    if not np.isclose(loop.dt, members.dt, rtol=1e-6):
        raise ValueError(
            f"the members were drawn around a loop with dt = {members.dt} s, but this one has "
            f"{loop.dt} s: draw them again, ensemble.draw(loop, n, key)"
        )


def _named(peers: Mapping[str, PyTree], name: str) -> dict[str, PyTree]:
    if name in peers:
        raise ValueError(f"a peer has the name {name!r} of the design itself: rename it")
    return dict(peers)


def _facts(drawn: Members) -> dict[str, Float[np.ndarray, "axes members"]]:
    plant = decouple(drawn.plant)
    given = {"inertia": plant.inertia, "torque_gain": plant.torque_gain, "lag": plant.lag}
    shape = (plant.shape[0], drawn.size)
    wide = lambda x: np.broadcast_to(np.asarray(x) if x.ndim > 1 else x[:, None], shape)
    facts = {n: np.array(wide(x)) for n, x in given.items() if x is not None}
    facts["delay"] = np.array(np.broadcast_to(np.asarray(drawn.delay), shape))
    return facts | {"assumed_inertia": np.asarray(drawn.assumed_inertia) / facts["inertia"]}


def _nominal_inertia(loop: Loop) -> Float[np.ndarray, " axes"]:
    axes = decouple(loop.plant)
    return np.array(jnp.broadcast_to(axes.inertia, axes.shape))


def _provenance(given: Ensemble | Members, drawn: Members, key: Key[Array, ""]) -> Provenance:
    fresh = isinstance(given, Ensemble)
    names = ("jaxquad", "jax", "jaxlib", "numpy")
    return {
        "members": drawn.size,
        "fresh": fresh,
        "sampling": "random" if fresh else "given",
        "key": np.asarray(jax.random.key_data(key)).tolist() if fresh else None,
        "precision": str(drawn.assumed_inertia.dtype),
        "ensemble": str(given).splitlines() if fresh else None,
        "device": jax.devices()[0].device_kind,
        "versions": {name: version(name) for name in names},
    }


def _describe_controller(controller: PyTree) -> dict[str, object]:
    """The controller's class and numbers, by their places in it."""
    leaves = jax.tree_util.tree_leaves_with_path(eqx.filter(controller, eqx.is_array))
    numbers = {jax.tree_util.keystr(path)[1:]: np.asarray(x).tolist() for path, x in leaves}
    return {"class": type(controller).__name__, "numbers": numbers}


def _remarks(found: Certificate, controller: PyTree, drawn: Members) -> list[str]:
    missed = [x for x in found.distances if QUANTITIES[x.quantity].linear and not x.met]
    lag = lag_remark(controller, drawn.delay, decouple(drawn.plant).lag)
    remarks = [lag] if lag and (missed or not found.stable) else []
    if not found.independent:
        remarks.append("the members were given: whether the tuner saw them is not known")
    counts = {n: x.unstable_count for n, x in found.designs.items() if x.unstable_count}
    if counts:
        text = ", ".join(f"{count} of {n}" for n, count in counts.items())
        remarks.append(f"no Ms and no margins (n/a) over members that are unstable: {text}")
    others = [(n, x.observer_instability) for n, x in found.designs.items() if n != found.name]
    return remarks + [f"of {n}: {why}" for n, why in others if why]


def decouple(plant: object) -> DecoupledAxes:
    """The plant near level flight, one axis at a time."""
    axes = plant.decoupled() if isinstance(plant, Multirotor) else plant
    assert isinstance(axes, DecoupledAxes)
    return axes


def evaluate_design(
    controller: PyTree,
    members: Members,
    flight: Scenario,
    span: TimeSpan,
    devices: DeviceChoice = None,
) -> DesignResult:
    """`controller` on all `members`, in a `flight` that has their noise in it.

    The loop in time holds every limit, the encoder and dry friction. The linear one is exact, and
    is that of a controller with a method `linear`, a scheduled or adaptive one at the inertia that
    it is given.
    """
    axes = flight.reference.shape[1]
    loop = members.loop(controller)
    loop = loop.with_controller(_widen(loop.controller, axes, members.size))

    def run(start: float, stop: float | None, load_start: float | None = None) -> Metrics:
        return evaluate(
            loop, flight, start=start, stop=stop, load_start=load_start, devices=devices
        )

    with warnings.catch_warnings():  # the certificate says it
        warnings.simplefilter("ignore", AuthorityWarning)
        whole = run(span.start, span.stop, span.load_start)
        single = len(span.parts) == 1 and span.load_start is None
        parts = [whole] if single else [run(*part) for part in span.parts]
    numbers = _join(whole, parts)
    linear = _linear(controller, members, flight)
    if linear is not None:
        numbers |= {name: linear._asdict()[name] for name in LINEAR}
    unstable = None if linear is None else ~np.all(linear.stable, axis=0)
    observed = isinstance(controller, ObserverController)
    why = controller.observer_instability() if observed else ""
    diverged = np.asarray(whole.diverged)
    return DesignResult(numbers, unstable, diverged, diverged | _carried_off(parts, flight), why)


_TILTED = np.pi / 2  # rad: a vehicle that is turned further pushes downwards


def _carried_off(parts: Sequence[Metrics], flight: Scenario) -> Bool[np.ndarray, " members"]:
    """Members whose error exceeds all that the reference moves by more than a quarter turn."""
    reference = np.asarray(flight.reference)
    moved = max(float(np.max(reference)), 0.0) - min(float(np.min(reference)), 0.0)
    greatest = np.max([np.asarray(part.peak) for part in parts], axis=(0, 1))
    return ~(greatest <= _TILTED + moved)


_PER_MEMBER = ("b0", "kp", "ki", "kd", "feedforward")  # what scheduling may change


def _widen(controller: PyTree, axes: int, members: int) -> PyTree:
    """The gains of a LADRC or PID in one shape, so that all of a kind share a compile."""
    if not isinstance(controller, LADRC | PID):
        return controller
    gains = {name: x for name, x in vars(controller).items() if isinstance(x, Array)}
    full = {name: _full(x, name, axes, members) for name, x in gains.items()}
    return dataclasses.replace(controller, **full)


def _full(gain: Array, name: str, axes: int, members: int) -> Array:
    shape = (axes, members) if name in _PER_MEMBER or gain.ndim > 1 else (axes,)
    given = np.asarray(gain)
    aligned = given.reshape(given.shape + (1,) * (len(shape) - given.ndim)) if given.ndim else given
    return jnp.asarray(np.broadcast_to(aligned, shape))


_INTEGRALS = ("itae", "iae", "ise")
_WHOLE = ("activity", "energy", "saturation_share", "peak", "rms", "disturbance_rmse")


def _join(whole: Metrics, parts: Sequence[Metrics]) -> dict[str, np.ndarray]:
    stack = lambda name: np.stack([np.asarray(vars(one)[name], float) for one in parts])
    numbers = {name: np.asarray(vars(whole)[name], float) for name in _WHOLE}
    numbers["activity_rate"] = numbers["activity"] / (whole.stop - whole.start)
    numbers["overshoot"] = _greatest(stack("overshoot"))
    return numbers | {name: stack(name).sum(axis=0) for name in _INTEGRALS}


def _greatest(values: Float[np.ndarray, "parts axes members"]) -> np.ndarray:
    """NaN where no part has a step."""
    known = ~np.isnan(values)
    greatest = np.max(np.where(known, values, -np.inf), axis=0)
    return np.where(known.any(axis=0), greatest, np.nan)


def _linear(controller: PyTree, members: Members, flight: Scenario) -> LoopNumbers | None:
    scheduled = schedule_for_analysis(controller, members.assumed_inertia)
    if not isinstance(scheduled, LinearisableController):
        return None
    axes = flight.reference.shape[1]
    loop = members.loop(controller).with_controller(_widen(scheduled, axes, members.size))
    plants = _with_payloads(members.plant, flight)
    return _worst([loop_numbers(loop.with_plant(x), range(axes)) for x in plants], members.size)


def _worst(loops: Sequence[LoopNumbers], members: int) -> LoopNumbers:
    """Of the same members as different plants: stable where all are, else NaN as one of them."""
    each = lambda x: np.broadcast_to(x.reshape(len(x), -1), (len(x), members))
    loops = [LoopNumbers(*map(each, loop)) for loop in loops]
    stable = np.all([loop.stable for loop in loops], axis=0)
    worst = {"abscissa": np.max([loop.abscissa for loop in loops], axis=0)}
    for name in LoopNumbers._fields[2:]:
        find = np.min if name.endswith("margin") else np.max
        found = find([loop._asdict()[name] for loop in loops], axis=0)
        worst[name] = np.where(stable, found, np.nan)
    return LoopNumbers(stable, **worst)


def _with_payloads(plant: Plant, flight: Scenario) -> list[Plant]:
    """The plant, and with the most and the least that the flight makes it carry."""
    if flight.payload is None:
        return [plant]
    extremes = [np.max(flight.payload, axis=0), np.min(flight.payload, axis=0)]
    return [plant, *(plant.with_added_inertia(x) for x in extremes if np.any(x != 0))]
