"""Gains given once, per axis `[axes]`, or per axis and member `[axes, *ensemble]`."""

from collections.abc import Mapping

import jax
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from ._arrays import align
from ._checks import is_concrete
from ._members import ensemble_shape


Member = int | Int[Array, ""]  # an index, which may be traced


def broadcast_gain(gain: Float[Array, "..."], signal: Float[Array, "..."]) -> Float[Array, "..."]:
    """A gain that broadcasts over `signal`, in its precision."""
    return align(gain, signal).astype(signal.dtype)


def match_reference(
    reference: PyTree, measurement: Float[Array, " axes *ensemble"], state: Float[Array, "..."]
) -> PyTree:
    """A set-point that broadcasts over the `measurement`, in its precision.

    Raises ValueError for a measurement of another shape than the state.
    """
    if measurement.shape != state.shape:
        raise ValueError(
            f"The measurement has shape {measurement.shape}, but the controller was started for "
            f"{state.shape}: give init() an array of the measurements' shape."
        )
    return jax.tree.map(lambda x: broadcast_gain(x, measurement), reference)


def multiply_gains(a: Float[Array, "..."], b: Float[Array, "..."]) -> Float[Array, "..."]:
    """The product of two gains; the one with fewer trailing axes holds for all members."""
    rank = max(a.ndim, b.ndim)
    a, b = (x.reshape(x.shape + (1,) * (rank - x.ndim)) for x in (a, b))
    return a * b


def signal_shape(like: Float[Array, " axes ..."], ensemble: tuple[int, ...]) -> tuple[int, ...]:
    """Of a signal as wide as `like` and as the `ensemble` of the gains."""
    gains = jax.ShapeDtypeStruct((1, *ensemble), like.dtype)
    return like.shape[:1] + ensemble_shape(like, gains, rank=1)


def pick_gain(
    gain: Float[Array, "..."], axis: int, member: Member | tuple[Member, ...] | None
) -> Float[Array, ""]:
    """The value for one axis of one member. Raises ValueError for one that does not exist."""
    if gain.ndim == 0:
        return gain
    if isinstance(axis, int) and not 0 <= axis < gain.shape[0]:
        raise ValueError(f"axis is {axis}, but the gains are for axes 0 to {gain.shape[0] - 1}.")
    ensemble = gain.shape[1:]
    if ensemble and member is None:
        raise ValueError(f"The gains are for an ensemble of {ensemble}: pick one, as member=0.")
    if member is None or not ensemble:
        return gain[axis]
    members = member if isinstance(member, tuple) else (member,)
    if len(members) != len(ensemble):
        raise ValueError(
            f"member is {member}, but the ensemble has the shape {ensemble}: give one index each."
        )
    return gain[axis][tuple(map(_index, members, ensemble))]


def _index(member: Member, size: int) -> Member:
    if isinstance(member, int) and not 0 <= member < size and size > 1:
        raise ValueError(f"member is {member}, but the ensemble's are 0 to {size - 1}.")
    return 0 if size == 1 else member


def require_common_shape(gains: Mapping[str, Array]) -> None:
    """Raises ValueError unless the gains fit together."""
    shapes = {name: gain.shape for name, gain in gains.items() if gain.ndim}
    text = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
    remedy = "give each as a scalar, one value per axis, or (axes, members) for an ensemble"
    if len({shape[0] for shape in shapes.values()}) > 1:
        raise ValueError(f"The gains are for different numbers of axes, {text}: {remedy}.")
    try:
        ensemble_shape(gains, rank=1)
    except ValueError:
        raise ValueError(f"The gains are for different ensembles, {text}: {remedy}.") from None


def require_limit(limit: Float[Array, "..."]) -> None:
    if is_concrete(limit) and not np.all(np.asarray(limit) > 0):
        raise ValueError(
            f"limit is {limit}, but it must be above 0: it bounds the command on both sides; "
            "inf bounds nothing."
        )


def require_sample_interval(dt: float) -> None:
    if not (dt > 0 and np.isfinite(dt)):
        raise ValueError(f"dt is {dt} s, but it must be above 0 and finite: give seconds.")


def require_below_sampling(name: str, value: Array, bound: float, dt: float) -> None:
    """Raises ValueError unless `value` times `dt` is below `bound`."""
    if is_concrete(value) and not np.all(np.asarray(value) * dt < bound):
        raise ValueError(
            f"{name} is {np.max(np.asarray(value)):.6g} rad/s, but at dt = {dt} s it must be below "
            f"{bound / dt:.4g} rad/s: lower it or sample faster."
        )
