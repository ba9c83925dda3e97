"""The members of an ensemble, and what of a plant varies between them."""

import functools as ft
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Int, Key, PyTree

from jaxquad._compile import brief_options, Jit
from jaxquad._core import (
    as_float,
    is_concrete,
    mark_members,
    member_rank,
    multiply_gains,
    per_member,
)
from jaxquad.control import schedule_for_flight
from jaxquad.loops import Drive, Loop, Plant, Sensor
from jaxquad.models import Attitude, DecoupledAxes, MotorLag, Multirotor
from jaxquad.simulation import gauss_markov, Scenario

from ._distributions import as_distribution, Distribution, distribution_or_none


# Factors of nominal values; the other quantities replace these.
FACTORS = ("inertia", "torque_gain", "assumed_inertia")
OF_PLANTS = ("inertia", "torque_gain", "lag", "damping", "stiffness", "coulomb")
UNCERTAIN = (*FACTORS, "lag", "delay", "damping", "stiffness", "coulomb", "noise", "gust")
Numbers = Float[np.ndarray, "..."]
Drawn = Mapping[str, Numbers]  # [axes] or [axes, members] of each quantity


def nominal_value(plant: Plant, name: str) -> Numbers | None:
    """The value of a quantity in a plant without members; None if the plant does not have it."""
    if name == "lag" and isinstance(plant, Multirotor):
        return None if plant.motor is None else np.asarray(plant.motor.time_constant)
    value = getattr(plant.attitude if isinstance(plant, Multirotor) else plant, name, None)
    return None if value is None else np.asarray(value)


def vary_plant(plant: Plant, drawn: Drawn) -> Plant:
    """The plant with drawn factors of inertia and torque gain, and the other quantities replaced.

    Quantities that were not drawn keep the plant's value.
    """
    if not isinstance(plant, DecoupledAxes | Multirotor):
        return _vary_fields(plant, drawn)
    names = ("damping", "stiffness", "coulomb")
    values = {name: drawn.get(name, nominal_value(plant, name)) for name in names}
    changed = {name: value for name, value in values.items() if value is not None}
    inertia = multiply_gains(plant_inertia(plant), drawn["inertia"])
    if isinstance(plant, DecoupledAxes):
        gain = multiply_gains(np.asarray(plant.torque_gain), drawn["torque_gain"])
        return DecoupledAxes(gain, inertia, lag=drawn.get("lag", plant.lag), **changed)
    attitude = Attitude(inertia, rotor_inertia=plant.attitude.rotor_inertia, **changed)
    motor = MotorLag(drawn["lag"][0]) if "lag" in drawn else plant.motor
    # All three torques times a factor; the arm is as wide, since it tells the ensemble's shape.
    factor = drawn["torque_gain"][0]
    where = lambda r: (r.arm, r.thrust_coefficient, r.torque_coefficient)
    pairs = zip(where(plant.allocation), (np.ones_like(factor), factor, factor), strict=True)
    scaled = [as_float(np.asarray(x) * y) for x, y in pairs]
    return Multirotor(attitude, eqx.tree_at(where, plant.allocation, scaled), motor)


def _vary_fields(plant: Plant, drawn: Drawn) -> Plant:
    """Of a class of the user's own: the fields with the names of what was drawn."""
    names = [name for name in OF_PLANTS if name in drawn and member_rank(plant, name) == 1]

    def varied(name: str) -> Array:
        if name not in FACTORS:
            return as_float(drawn[name])
        return as_float(multiply_gains(np.asarray(getattr(plant, name)), drawn[name]))

    where = lambda p: [getattr(p, name) for name in names]
    return eqx.tree_at(where, plant, [varied(name) for name in names], is_leaf=lambda x: x is None)


def require_variable(plant: Plant, name: str) -> None:
    """Raise ValueError for a class of the user's own without the field that is to vary."""
    if isinstance(plant, DecoupledAxes | Multirotor) or member_rank(plant, name) == 1:
        return
    raise ValueError(
        f"{name} varies, but {type(plant).__name__} has no field of this name that is declared by "
        f"jq.loops.per_member(rank=1), [axes, *ensemble]: add it. To vary a field of another name, "
        "draw the members without it and give them its values, "
        "eqx.tree_at(lambda members: members.plant.FIELD, members, values)"
    )


def plant_inertia(plant: Plant) -> Numbers:
    """[axes] or [axes, members], kg m^2."""
    inertia = nominal_value(plant, "inertia")
    if inertia is None:
        raise ValueError(
            f"{type(plant).__name__} has no inertia [axes] in kg m^2, which an ensemble tells to "
            "scheduled controllers: add a field inertia"
        )
    return inertia


def count_axes(plant: Plant) -> int:
    """How many angles a plant turns by."""
    if isinstance(plant, DecoupledAxes | Multirotor):
        return 3 if isinstance(plant, Multirotor) else plant.shape[0]
    return len(eqx.filter_eval_shape(lambda p: p.measure(p.init()), plant))


class Payload(eqx.Module):
    """Inertia that members pick up in flight; the controller does not know.

    Each argument is a number or a distribution, from which every member has its own draw. Times
    are rounded to samples.

    **Arguments:**

    - `added`: in units of the plant's nominal inertia: 1.0 doubles it, a negative number removes
        what was carried from the start.
    - `at`: when it is picked up, in s.
    - `width`: how long it is carried, in s; None is to the end.

    **Raises:**

    - `ValueError`: in an `Ensemble`, for times before the start and for inertias of 0 or less.
    """

    added: Distribution = eqx.field(converter=as_distribution)
    at: Distribution = eqx.field(converter=as_distribution, kw_only=True)  # s
    width: Distribution | None = eqx.field(
        converter=distribution_or_none, default=None, kw_only=True
    )  # s


class MemberPayload(eqx.Module):
    inertia: Float[Array, "axes members"] = per_member(rank=1)  # kg m^2
    at: Float[Array, " members"] = per_member(rank=0)  # s
    until: Float[Array, " members"] = per_member(rank=0)  # s
    latest: float = eqx.field(static=True)  # s, that `at` can be

    def signal(self, samples: int, dt: float) -> Float[Array, "samples axes members"]:
        """The added inertia in kg m^2, sample by sample.

        Raise ValueError for a payload that can come after the last sample.
        """
        if self.latest >= samples * dt:
            raise ValueError(
                f"a payload is picked up as late as {self.latest:.6g} s, but the scenario ends at "
                f"{samples * dt:.6g} s: lengthen it, or let Payload(at=...) be earlier"
            )
        index = jnp.arange(samples)[:, None]
        first, last = (jnp.round(t / dt)[None] for t in (self.at, self.until))
        index = index.astype(first.dtype)
        return jnp.where((index >= first) & (index < last), 1.0, 0.0)[:, None] * self.inertia[None]


class Members(eqx.Module):
    """Drawn members of an ensemble, on the last axis of all arrays that differ between them.

    `jq.evaluate(members.loop(controller), members.flight(scenario))` flies all of them.

    **Arguments:**

    - `plant`: the nominal one with what was drawn.
    - `delay`: s, of the command; `longest_delay`: s, that any draw can have.
    - `assumed_inertia`: kg m^2, for scheduled controllers.
    - `keys`: of the noise and gusts.
    - `noise`: rad, standard deviation; `gust`: N m, standard deviation; None for none.
    - `payload`: inertia that is picked up in flight, or None.
    - `drive`, `encoder`, `dt` (s), `substeps`, `bound` (rad): of the loop, as in `jq.Loop`.
    - `gust_corner`: rad/s.
    """

    plant: Plant
    delay: Float[Array, " members"] = per_member(rank=0)
    assumed_inertia: Float[Array, "axes members"] = per_member(rank=1)
    keys: Key[Array, " members"] = per_member(rank=0)
    noise: Float[Array, "axes members"] | None = per_member(rank=1, default=None)
    gust: Float[Array, "axes members"] | None = per_member(rank=1, default=None)
    payload: MemberPayload | None = None
    drive: Drive | None = None
    encoder: Sensor | None = None
    longest_delay: float = eqx.field(static=True, default=0.0)
    gust_corner: float = eqx.field(static=True, default=2.0)
    dt: float = eqx.field(static=True, default=0.002)
    substeps: int = eqx.field(static=True, default=1)
    bound: float = eqx.field(static=True, default=100.0)

    @property
    def size(self) -> int:
        """How many members there are."""
        return self.assumed_inertia.shape[-1]

    @property
    def axes(self) -> int:
        """How many angles the plant turns by."""
        return self.assumed_inertia.shape[0]

    def take(self, indices: ArrayLike | Sequence[int]) -> "Members":
        """Some of the members, with the noise that is theirs.

        **Arguments:**

        - `indices`: a row of one or more places, 0 to `size` - 1.

        **Raises:**

        - `ValueError`: for other indices.
        """
        places = jnp.asarray(indices)
        if places.ndim != 1 or not jnp.issubdtype(places.dtype, jnp.integer) or not places.size:
            raise ValueError(f"indices are {indices}: give a row of whole numbers, one or more")
        at = np.asarray(places) if is_concrete(places) else np.zeros(1)
        if not np.all((at >= 0) & (at < self.size)):
            raise ValueError(
                f"indices are {indices}, but the {self.size} members are 0 to {self.size - 1}"
            )
        return _take(self, places)

    def loop(self, controller: PyTree) -> Loop:
        """The loops of all members around one controller.

        **Arguments:**

        - `controller`: one controller for all members. A scheduled one gets, for each member, the
            gains at the inertia that it is given.

        **Returns:**

        A `jq.Loop` with the plants and delays of the members.

        **Raises:**

        - `ValueError`: the controller was made for another sample interval.
        """
        delayed = self.longest_delay > 0
        return Loop(
            self.plant,
            schedule_for_flight(controller, self.assumed_inertia),
            drive=self.drive,
            encoder=self.encoder,
            delay=self.delay if delayed else 0.0,
            longest_delay=self.longest_delay if delayed else None,
            dt=self.dt,
            substeps=self.substeps,
            bound=self.bound,
        )

    def flight(self, scenario: Scenario) -> Scenario:
        """The scenario with each member's own noise, gusts and payload added to it.

        The same member draws the same numbers in every flight of the same length, whatever others
        fly with it.

        **Arguments:**

        - `scenario`: for one loop, or for as many as there are members.

        **Raises:**

        - `ValueError`: the scenario is for other axes or for another number of members.
        """
        samples, axes = scenario.reference.shape[:2]
        if axes != self.axes:
            raise ValueError(
                f"the scenario is for {axes} axes, but the members have {self.axes}: give a "
                f"scenario with axes={self.axes}"
            )
        if scenario.ensemble not in ((), (1,), (self.size,)):
            raise ValueError(
                f"the scenario is for an ensemble of {scenario.ensemble}, but there are "
                f"{self.size} members: give a scenario for one loop, or for as many"
            )
        shape = (samples, axes)
        parts = _add_drawn(
            scenario, self.keys, self.noise, self.gust, self.payload, shape, self.dt,
            self.gust_corner,
        )  # fmt: skip
        where = lambda s: [vars(s)[name] for name in parts]
        return eqx.tree_at(where, scenario, list(parts.values()), is_leaf=lambda x: x is None)


@eqx.filter_jit
def _take(members: Members, places: Int[Array, " some"]) -> Members:
    varies = mark_members(members, (members.size,))
    return jax.tree.map(lambda x, mine: x[..., places] if mine else x, members, varies)


@ft.partial(Jit, options=brief_options)  # eager, it would be a dozen programs for each shape
def _add_drawn(
    scenario: Scenario, keys: Key[Array, " members"], noise: Float[Array, "axes members"] | None,
    gust: Float[Array, "axes members"] | None, payload: MemberPayload | None,
    shape: tuple[int, int], dt: float, corner: float,
) -> dict[str, Float[Array, "samples axes members"]]:  # fmt: skip
    """The parts of the scenario that members add to, with what they add."""

    def white(key: Key[Array, ""]) -> Array:
        # In single precision, so that float32 and float64 fly through the same noise.
        return jax.random.normal(jax.random.fold_in(key, 0), shape, jnp.float32)

    def gusts(key: Key[Array, ""]) -> Array:
        return gauss_markov(jax.random.fold_in(key, 1), shape, deviation=1.0, corner=corner, dt=dt)

    of_members = lambda draw: jax.vmap(draw, out_axes=-1)(keys)
    drawn = {}
    if noise is not None:
        drawn["noise"] = of_members(white).astype(noise.dtype) * noise[None]
    if gust is not None:
        drawn["disturbance"] = of_members(gusts).astype(gust.dtype) * gust[None]
    if payload is not None:
        drawn["payload"] = payload.signal(shape[0], dt)
    wide = lambda x: x.reshape(x.shape[:2] + (x.shape[2:] or (1,)))
    parts = {name: vars(scenario)[name] for name in drawn}
    return {
        name: x if parts[name] is None else wide(parts[name]) + x.astype(parts[name].dtype)
        for name, x in drawn.items()
    }
