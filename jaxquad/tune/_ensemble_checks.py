"""What cannot be is refused before anything is drawn."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from jaxquad.excitation._checks import check_positive
from jaxquad.models import DecoupledAxes, Multirotor

from ._law import Law
from ._law_values import number
from ._payload import Payload
from ._sampling import SAMPLINGS


_POSITIVE = {
    "inertia": "factors of the plant's inertia",
    "torque_gain": "factors of the plant's torque gain",
    "told": "factors of the true inertia",
    "lag": "s; for motors without lag leave it None",
    "payload width": "s; None lasts to the end",
}
_NOT_NEGATIVE = {
    "delay": "s",
    "coulomb": "N m; friction acts against the motion",
    "noise": "rad, a standard deviation",
    "gust": "N m, a standard deviation",
    "payload at": "s from the start",
}
_ONE_FOR_ALL = ("delay", "payload at", "payload width")  # axes
_OF_ROTORS = ("torque_gain", "lag")  # of a multirotor: they act on all axes alike


def check_ensemble(ensemble: Any) -> None:
    """Raise ValueError for an ensemble that cannot be drawn."""
    check_plant(ensemble.plant)
    check_positive(dt=ensemble.dt, gust_corner=ensemble.gust_corner)
    if not (ensemble.payload is None or isinstance(ensemble.payload, Payload)):
        raise ValueError(f"payload is {ensemble.payload!r}: give a jq.Payload(added, at=...)")
    laws = ensemble.laws
    _check_names(ensemble, laws)
    for name, law in laws.items():
        _check_axes(name, law, ensemble)
        _check_support(name, law)
    _check_carried(ensemble, laws)


def check_request(n: int, key: Key[Array, ""]) -> None:
    """Raise ValueError for a draw of no members, or without a key."""
    if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
        raise ValueError(f"n is {n}: draw a whole number of members, 1 or more")
    if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
        raise ValueError(f"key is {key!r}: give a jax.random.key(0)")


def check_plant(plant: Any) -> None:
    if not isinstance(plant, DecoupledAxes | Multirotor):
        raise ValueError(
            f"an Ensemble is of a jq.DecoupledAxes or jq.Multirotor, not of {type(plant).__name__}:"
            " for an identified model use jq.Ensemble.from_fit(fit, ...)"
        )
    shape = plant.shape[1:] if isinstance(plant, DecoupledAxes) else plant.ensemble
    if shape:
        raise ValueError(
            f"the plant already is an ensemble of {shape}: give one plant, and say as laws what "
            "varies"
        )


def _check_axes(name: str, law: Law, ensemble: Any) -> None:
    sizes = {x.size for x in law.support} - {1}
    rotors = isinstance(ensemble.plant, Multirotor) and name in _OF_ROTORS
    if (name in _ONE_FOR_ALL or rotors) and (sizes or name in ensemble.independent):
        raise ValueError(f"{name} is one for all axes: give it a law of single numbers")
    if sizes and sizes != {ensemble.axes}:
        raise ValueError(
            f"the law of {name} is for {max(sizes)} axes, but the plant has {ensemble.axes}: give "
            "one number for all axes, or one for each"
        )


def _check_support(name: str, law: Law) -> None:
    least = float(np.min(law.support[0]))
    if name in _POSITIVE and not least > 0:
        raise ValueError(
            f"{name} is {law.text}, which reaches {least:.4g}, but it must stay above 0 "
            f"({_POSITIVE[name]}): narrow the law, or take a jq.LogUniform or jq.LogNormal"
        )
    if name in _NOT_NEGATIVE and not least >= 0:
        raise ValueError(
            f"{name} is {law.text}, which reaches {least:.4g}, but it cannot be negative "
            f"({_NOT_NEGATIVE[name]}): narrow the law"
        )


def _check_carried(ensemble: Any, laws: dict[str, Law]) -> None:
    if ensemble.payload is None:
        return
    least = [laws[name].support[0] for name in ("inertia", "payload added")]
    if not sum(np.min(x) for x in least) > 0:
        raise ValueError(
            f"a payload of {number(least[1])} times the plant's inertia leaves none of the "
            f"{number(least[0])} that a member can have: set down less"
        )


def _check_names(ensemble: Any, laws: dict[str, Law]) -> None:
    if ensemble.sampling not in SAMPLINGS:
        raise ValueError(f"sampling is {ensemble.sampling!r}: use one of {', '.join(SAMPLINGS)}")
    if ensemble.sampling == "grid" and ensemble.fitted is not None:
        raise ValueError('a fit has no grid to draw on: use sampling="latin"')
    known = [name for name, law in laws.items() if law.varies]
    given = ensemble.independent
    if isinstance(given, str) or any(name not in known for name in given):
        raise ValueError(
            f"independent is {given!r}: name quantities that vary, in brackets; here "
            f"{', '.join(known) or 'none does'}"
        )
