"""Whether a controller's observer is stable by itself, as it runs while the command saturates."""

import dataclasses
from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad.control import LADRC
from jaxquad.control._per_axis import times


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


def _radius(ladrc: LADRC) -> Float[np.ndarray, "..."]:
    """Of the observer's error from sample to sample, (I - l C) Ad."""
    size = ladrc.order + 1
    correction = np.asarray(ladrc.gains.correction)
    undriven = ladrc.observer.predict(list(jnp.eye(size)), jnp.zeros(size), ladrc.dt)
    predict = np.stack([np.asarray(row) for row in undriven])
    left = np.eye(size) - np.moveaxis(correction, 0, -1)[..., None] * np.eye(size)[0]
    return np.asarray(np.max(np.abs(np.linalg.eigvals(left @ predict)), axis=-1))


def _place(ladrc: LADRC) -> str:
    factor = _listed(ladrc.observer_factor)
    return f"wo = {_listed(ladrc.wo)} rad/s and an observer_factor of {factor}"


def _listed(values: Any) -> str:
    each = np.unique(np.asarray(values))
    return f"{each[0]:.4g}" if each.size == 1 else f"{each[0]:.4g} .. {each[-1]:.4g}"
