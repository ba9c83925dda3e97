import warnings
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import align, as_float, ensemble_shape, is_concrete, per_member
from jaxquad.loops import Drive, Plant

from ._metrics import axis_names
from ._scenario import Scenario


_ALL = 1e12  # units of command, more than any drive gives


class AuthorityWarning(UserWarning):
    """A scenario asks for more torque than the drive has."""


class Authority(eqx.Module):
    """The torque that a drive can hold against a disturbance, one axis at a time.

    **Arguments:**

    - `torque_gain`: N m per unit of command.
    - `command`: greatest command, of the drive and the controller; or inf.
    - `torque`: N m, at the limit of the command; inf without one.
    - `forward`: N m, until a motor turns backwards; inf if none can.
    """

    torque_gain: Float[Array, " axes *ensemble"] = per_member(rank=1)
    command: Float[Array, "axes ..."] = per_member(rank=1)
    torque: Float[Array, "axes ..."] = per_member(rank=1)
    forward: Float[Array, "axes ..."] = per_member(rank=1)

    def __str__(self) -> str:
        rows = []
        for k, name in enumerate(axis_names(self.torque.shape[0])):
            row = f"  {name}: {_span(self.torque[k])} N m"
            if np.isfinite(self.forward[k]).all():
                row += f", {_span(self.forward[k])} N m without a motor turning backwards"
            rows.append(row)
        return "\n".join(["torque authority", *rows])


@runtime_checkable
class HasTorqueGain(Protocol):
    """A plant that knows its torque in N m per unit of command, [axes, *ensemble]."""

    @property
    def torque_gain(self) -> Float[Array, " axes *ensemble"]: ...


@runtime_checkable
class HasLimit(Protocol):
    """A drive or controller that bounds the command, [axes, *ensemble]."""

    @property
    def limit(self) -> Float[ArrayLike, "..."]: ...


@runtime_checkable
class HasForwardLimit(Protocol):
    """A drive whose motors have a direction."""

    def forward_limit(self, axes: int) -> Float[Array, " axes *ensemble"]: ...


def authority(
    plant: Plant, drive: Drive | None = None, controller: object | None = None
) -> Authority:
    """The torque in N m that `drive` gives on each axis of `plant` alone.

    **Arguments:**

    - `plant`: with a `torque_gain` in N m per unit of command, as `jq.DecoupledAxes` has.
    - `drive`: its saturation limits the command. With motors about a bias, such as
        `jq.simulation.MotorDrive`, `forward` is the torque at which the first of them would have to
        turn backwards: 0.0936 N m in roll on the Quanser Hover at its bias of 2 V.
    - `controller`: its `limit` counts, if it has one.

    **Raises:** ValueError for a plant whose torque per unit of command is not known.
    """
    result = eqx.filter_jit(find_authority)(plant, drive, controller)
    if result is None:
        raise ValueError(
            f"a {type(plant).__name__} has no torque_gain [axes] in N m per unit of command: add "
            "one, as jq.DecoupledAxes has"
        )
    return result


def find_authority(
    plant: Plant, drive: Drive | None, controller: object | None
) -> Authority | None:
    """`authority`, or None for a plant whose torque per unit of command is not known."""
    if not isinstance(plant, HasTorqueGain):
        return None
    gain = jnp.atleast_1d(as_float(plant.torque_gain))
    limit_of = lambda part: part.limit if isinstance(part, HasLimit) else jnp.inf
    limits = [jnp.atleast_1d(as_float(limit_of(part))) for part in (controller, drive)]
    axes = max(len(x) for x in (gain, *limits))
    gain = jnp.broadcast_to(gain, (axes, *gain.shape[1:]))
    command = jnp.minimum(*_same(_drive_limit(drive, gain), limits[0]))
    forward = jnp.full_like(gain, jnp.inf)  # the command at which the first motor stops
    if isinstance(drive, HasForwardLimit):
        forward = drive.forward_limit(axes).astype(gain.dtype)
    limits = (command, forward)
    return Authority(gain, command, *(jnp.multiply(*_same(gain, x)) for x in limits))


def warn_beyond_authority(drive_authority: Authority | None, scenario: Scenario) -> None:
    """Warn of disturbances that no controller can hold. Silent for traced values."""
    for message in beyond_authority(drive_authority, scenario):
        warnings.warn(message, AuthorityWarning, stacklevel=3)


def beyond_authority(drive_authority: Authority | None, scenario: Scenario) -> list[str]:
    """What to say of disturbances that no controller can hold; nothing for traced values."""
    if drive_authority is None or not (
        is_concrete(scenario.disturbance) and is_concrete(drive_authority.torque)
    ):
        return []
    torque = np.abs(np.asarray(scenario.disturbance))
    limits = (
        (
            np.asarray(drive_authority.torque),
            "that the drive has: no controller holds the angle there",
        ),
        (np.asarray(drive_authority.forward), "that the motors give without turning backwards"),
    )
    if all(torque.max(initial=0.0) <= limit.min(initial=np.inf) for limit, _ in limits):
        return []
    messages = []
    for k, name in enumerate(axis_names(torque.shape[1])):
        for limit, what in limits:
            least, demanded = limit[min(k, len(limit) - 1)], torque[:, k]
            demanded = demanded.reshape(demanded.shape + (1,) * (least.ndim + 1 - demanded.ndim))
            share = np.mean(demanded > (1 + 1e-6) * least)
            if share:
                messages.append(
                    f"the disturbance of {name} reaches {torque[:, k].max():.4g} N m: "
                    f"{share:.1%} of the samples exceed the {_span(least)} N m {what}. Lower it, "
                    "or raise the limit or the bias"
                )
                break
    return messages


def _drive_limit(
    drive: Drive | None, like: Float[Array, " axes *ensemble"]
) -> Float[Array, "axes ..."]:
    """The most that the drive gives of the command of each axis alone, by asking it for all."""
    if drive is None:
        return jnp.full_like(like, jnp.inf)
    members = jnp.broadcast_shapes(like.shape[1:], ensemble_shape(drive))
    wide = jnp.zeros((like.shape[0], *members), like.dtype)
    limits = []
    for k, unit in enumerate(jnp.eye(like.shape[0], dtype=like.dtype)):
        command = _ALL * jnp.broadcast_to(align(unit, wide), wide.shape)
        both = [drive.achieved(drive.inputs(sign * command))[k] for sign in (1.0, -1.0)]
        limits.append(jnp.minimum(*(jnp.abs(x) for x in both)))
    most = jnp.stack(limits)
    return jnp.where(most < 0.99 * _ALL, most, jnp.inf)


def _same(a: Array, b: Array) -> tuple[Array, Array]:
    members = max(a.ndim, b.ndim)
    a, b = (x.reshape(x.shape + (1,) * (members - x.ndim)) for x in (a, b))
    shape = jnp.broadcast_shapes(a.shape, b.shape)
    return jnp.broadcast_to(a, shape), jnp.broadcast_to(b, shape)


def _span(values: ArrayLike) -> str:
    low, high = np.min(values), np.max(values)
    return f"{low:.4g}" if low == high else f"{low:.4g} .. {high:.4g}"
