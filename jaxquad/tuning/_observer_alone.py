"""Whether a controller's observer is stable by itself, as it runs while the command saturates."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import times
from jaxquad.control import LADRC

from ._parameters import Coordinates


_FORGETS = 1 - 1e-9  # the radius below which an error of the observer dies out


def runaway(controller: Any) -> str:
    """Why an observer in `controller` is unstable by itself; empty if none is.

    The linear loop does not tell: the feedback can hold an observer that would run away as soon as
    the command stays at its limit. Only half-gain factors bring that about.
    """
    for ladrc in _observers(controller):
        if (radius := float(np.max(_radius(ladrc)))) >= _FORGETS:
            return (
                f"the observer alone is unstable at {_place(ladrc)} (spectral radius {radius:.4g} "
                "per sample): it would run away while the command saturates"
            )
    return ""


def sluggish(controller: Any) -> str:
    """Why an observer in `controller` is, by itself, slower than the feedback; empty if none is.

    Its slowest error then dies out more slowly than wc's poles: after every saturation the feedback
    acts on what is not so.
    """
    for ladrc in _observers(controller):
        ratio = np.asarray(times(1 / ladrc.wc, jnp.asarray(-np.log(_radius(ladrc)) / ladrc.dt)))
        if np.any(ratio < 1):
            return (
                f"the observer alone decays at {ratio.min():.3g} wc at {_place(ladrc)}, slower "
                "than the feedback: after saturation it would mislead"
            )
    return ""


def barrier(controller: Any) -> Float[Array, ""]:
    """What keeps a descent off the bound of `sluggish`: -ln of the room to it, 0 far inside.

    The room is by Jury's conditions on the polynomial of the observer's error, its roots scaled so
    that those of wc come to 1, over the room of full gains to where they are unstable. Beyond the
    bound it is NaN.
    """
    total = jnp.zeros(())
    for ladrc in modules(controller):
        if isinstance(ladrc, LADRC):
            whole = dataclasses.replace(ladrc, observer_factor=jnp.ones(()))
            pairs = zip(_room(ladrc, ladrc.wc), _room(whole, 0 * ladrc.wc), strict=True)
            share = [times(x, 1 / full) for x, full in pairs]
            total = total + sum(jnp.mean(0.5 * jnp.log1p(x**2) - jnp.log(x)) for x in share)
    return total


def _observers(controller: Any) -> Iterator[LADRC]:
    """With other poles than wo's."""
    for part in modules(controller):
        if isinstance(part, LADRC) and np.any(np.asarray(part.observer_factor) != 1):
            yield part


def modules(tree: Any) -> Iterator[eqx.Module]:
    """`tree` and the modules in it."""
    if isinstance(tree, eqx.Module):
        yield tree
        for field in dataclasses.fields(tree):
            yield from modules(getattr(tree, field.name))


def _room(ladrc: LADRC, decay: Float[Array, "..."]) -> list[Float[Array, "..."]]:
    """What is above 0 while every root of the error's polynomial is within exp(-decay dt)."""
    error, closer = _error(ladrc), jnp.exp(decay * ladrc.dt)
    trace = times(jnp.trace(error, axis1=-2, axis2=-1), closer)
    determinant = times(jnp.linalg.det(error), closer ** (ladrc.order + 1))
    if ladrc.order == 1:
        return [1 - trace + determinant, 1 - determinant]
    square = times(jnp.trace(error @ error, axis1=-2, axis2=-1), closer**2)
    minors = 0.5 * (trace**2 - square)
    real = 1 - trace + minors - determinant
    return [real, 1 - minors + determinant * (trace - determinant)]


def _radius(ladrc: LADRC) -> Float[np.ndarray, "..."]:
    """Of the observer's error from sample to sample."""
    error = np.asarray(_error(ladrc))
    return np.asarray(np.max(np.abs(np.linalg.eigvals(error)), axis=-1))


def _error(ladrc: LADRC) -> Float[Array, "... states states"]:
    """(I - l C) Ad: what an error of the estimate is a sample later."""
    correction = jnp.moveaxis(ladrc.gains.correction, 0, -1)
    unit = jnp.eye(ladrc.order + 1, dtype=correction.dtype)
    predict = jnp.stack(ladrc.observer.predict(list(unit), jnp.zeros_like(unit[0]), ladrc.dt))
    shape = (*correction.shape, len(unit))
    seen = correction[..., None] * jnp.broadcast_to(predict[0], shape)
    return jnp.broadcast_to(predict, shape) - seen


def _place(ladrc: LADRC) -> str:
    factor = _listed(ladrc.observer_factor)
    return f"wo = {_listed(ladrc.wo)} rad/s and an observer_factor of {factor}"


def _listed(values: Any) -> str:
    each = np.unique(np.asarray(values))
    return f"{each[0]:.4g}" if each.size == 1 else f"{each[0]:.4g} .. {each[-1]:.4g}"


def refusal(coordinates: Coordinates, z: np.ndarray) -> str:
    """Why the controller at `z` cannot be built or must not be flown; empty if it can."""
    controller = _built(coordinates, z)
    for part in modules(controller):
        try:
            dataclasses.replace(part)
        except ValueError as error:
            return str(error)
    return runaway(controller) or sluggish(controller)


@eqx.filter_jit
def _built(coordinates: Coordinates, z: Any) -> Any:
    return coordinates.controller_at(z)
