import math
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from jaxquad._core import as_float, check_positive, whole_samples
from jaxquad.records import AXES

from ._memory import require_memory
from ._scenario import Scenario
from ._signal import as_signal, Clock, fit, Motion, Signal


Given = Mapping[Any, Any] | Signal | None
_PARTS = ("reference", "injection", "disturbance", "noise", "payload")


def scenario(
    *,
    duration: float,
    dt: float = 0.002,
    axes: int | Sequence[str] = 3,
    reference: Given = None,
    injection: Given = None,
    disturbance: Given = None,
    noise: Given = None,
    payload: Given = None,
    feed_forward: bool = False,
    ensemble: int | tuple[int, ...] = (),
    key: Key[Array, ""] | None = None,
) -> Scenario:
    """A `Scenario` from signals of single axes, with zeros where nothing is said.

    Each part maps an axis, by name or number, to a signal: `jq.Step`, `jq.simulation.Ramp`, `jq.simulation.SmoothStep`,
    `jq.simulation.Sine`, `jq.Pulse`, `jq.simulation.ReferenceModel`, `jq.simulation.Gust`, `jq.simulation.WhiteNoise`, sums of them, a
    `jq.excitation.Excitation`, or an array [samples, *ensemble]. One signal instead of a map goes to every
    axis. The units are rad (`reference`, `noise`), N m (`disturbance`), those of the command
    (`injection`) and kg m^2 (`payload`, added to the plant's inertia).

        jq.scenario(
            duration=10.0,
            reference={"roll": jq.Step(np.radians(4))},
            disturbance={"roll": jq.Pulse(0.05, period=5.0, share=0.5, at=2.0)},
            noise=jq.simulation.WhiteNoise(np.radians(0.02)),
            key=jax.random.key(0),
        )

    `duration`, `dt` and all times are in s and whole numbers of samples. `axes` is how many the
    plant has, or their names (roll, pitch, yaw for up to three). With `feed_forward` the controller
    also gets the reference's rate and acceleration, zero for signals that jump. `ensemble` is the
    number of members, each of which draws its own noise from `key`; what an axis draws depends on
    nothing but the key, the part and the axis (and on the precision: float32 draws other numbers).
    Raises ValueError for unknown axes, for times outside, and for arrays that do not fit.
    """
    check_positive(duration=duration, dt=dt)
    names = _names(axes)
    members = (ensemble,) if isinstance(ensemble, int) else tuple(ensemble)
    clock = Clock(whole_samples("duration", duration, 1 / dt, fewest=2), dt, members)
    given = (reference, injection, disturbance, noise, payload)
    _require_room(given, clock, len(names))
    parts = {
        name: _sampled(name, part, names, clock, _fold(key, k))
        for k, (name, part) in enumerate(zip(_PARTS, given, strict=True))
    }
    arrays = {name: _stack(name, "value", part, clock) for name, part in parts.items()}
    if payload is None:
        del arrays["payload"]
    if feed_forward:
        for name in ("rate", "acceleration"):
            arrays[name] = _stack("reference", name, parts["reference"], clock)
    return Scenario(**arrays)


def _require_room(given: tuple[Given, ...], clock: Clock, axes: int) -> None:
    """For what each member draws for itself: as columns, and then side by side."""
    signals = [list(x.values()) if isinstance(x, Mapping) else [x] for x in given]
    drawn = sum(any(getattr(x, "random", False) for x in part) for part in signals)
    numbers = drawn * clock.samples * axes * math.prod(clock.ensemble)
    what = f"a scenario of {clock.samples} samples for {math.prod(clock.ensemble)} members"
    remedy = "draw the noise of fewer members at a time, in jq.simulation.in_slices"
    require_memory(what, 2 * numbers * as_float(0.0).dtype.itemsize, remedy)


def _names(axes: int | Sequence[str]) -> tuple[str, ...]:
    if isinstance(axes, int):
        if axes < 1:
            raise ValueError(f"axes is {axes}: a plant has at least one")
        return AXES[:axes] if axes <= len(AXES) else tuple(str(k) for k in range(axes))
    if isinstance(axes, str) or not axes or len(set(axes)) != len(axes):
        raise ValueError(f"axes is {axes!r}: give their number, or their names, each once")
    return tuple(axes)


def _sampled(
    name: str, given: Given, names: tuple[str, ...], clock: Clock, key: Key[Array, ""] | None
) -> list[Motion | None]:
    if given is not None and not isinstance(given, Mapping):
        given = dict.fromkeys(names, given)
    signals = {_place(name, axis, names): x for axis, x in (given or {}).items()}
    if len(signals) < len(given or {}):
        raise ValueError(f"{name}: an axis is given twice, by name and by number")
    return [
        _motion(f"{name} of {axis}", signals[k], clock, _fold(key, k)) if k in signals else None
        for k, axis in enumerate(names)
    ]


def _place(name: str, axis: Any, names: tuple[str, ...]) -> int:
    if axis in names:
        return names.index(axis)
    if isinstance(axis, int) and 0 <= axis < len(names):
        return axis
    raise ValueError(f"{name} of the axis {axis!r}: choose one of {', '.join(names)}")


def _fold(key: Key[Array, ""] | None, k: int) -> Key[Array, ""] | None:
    return None if key is None else jax.random.fold_in(key, k)


def _motion(what: str, given: Any, clock: Clock, key: Key[Array, ""] | None) -> Motion:
    try:
        return as_signal(given).sample(clock, key)
    except ValueError as error:
        raise ValueError(f"{what}: {error}") from error


def _stack(
    name: str, field: str, motions: list[Motion | None], clock: Clock
) -> Float[Array, "samples axes ..."]:
    """One column for each axis, zeros for None; as wide as the widest needs."""
    signals = [getattr(motion, field, None) for motion in motions]
    shapes = [x.shape[1:] for x in signals if x is not None]
    try:
        members = np.broadcast_shapes(*shapes)
    except ValueError:
        text = ", ".join(str(shape) for shape in shapes)
        raise ValueError(f"{name}: the axes are for different ensembles, {text}") from None
    zero = jnp.zeros((clock.samples, *members), as_float(0.0).dtype)
    return jnp.stack([zero if x is None else fit(x, members) for x in signals], axis=1)
