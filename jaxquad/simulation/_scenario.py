"""What happens to a loop: scenarios from signals of single axes, and experiments."""

import functools as ft
import math
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key, PyTree

from jaxquad._compile import brief_options, Jit
from jaxquad._core import (
    as_float,
    default_device,
    ensemble_shape,
    free_memory,
    per_member,
    require_all_nonnegative,
    require_all_positive,
    whole_samples,
)
from jaxquad.excitation import Excitation
from jaxquad.records import AXES

from ._signal import as_signal, Clock, fit, gauss_markov_of, Motion, Signal


class Scenario(eqx.Module):
    """What happens to a loop, sample by sample; a trailing axis makes an ensemble.

    A part that is the same for all members need not have that axis. With `rate` or `acceleration`
    of the reference the controller gets a `jq.control.Setpoint` and can feed them forward; one that
    is None counts as zero. `payload` is inertia that the plant carries in addition to its own.
    `jq.scenario(...)` builds a scenario from signals of single axes.

    **Arguments:**, all arrays [samples, axes, *ensemble]:

    - `reference`: set-point of the angles, rad.
    - `injection`: signal added to the command, in the command's unit.
    - `disturbance`: torque on the plant, N m.
    - `noise`: error of the measured angles, rad.
    - `rate`, `acceleration`: of the reference, rad/s and rad/s^2.
    - `payload`: added inertia, kg m^2.
    - `dt`: the sample interval of the arrays in s, which a loop has to have, too; None for any.

    **Raises:** ValueError for arrays of different numbers of samples, axes or members.
    """

    reference: Float[Array, "samples axes ..."] = per_member(rank=2)
    injection: Float[Array, "samples axes ..."] = per_member(rank=2)
    disturbance: Float[Array, "samples axes ..."] = per_member(rank=2)
    noise: Float[Array, "samples axes ..."] = per_member(rank=2)
    rate: Float[Array, "samples axes ..."] | None = per_member(rank=2, default=None)
    acceleration: Float[Array, "samples axes ..."] | None = per_member(rank=2, default=None)
    payload: Float[Array, "samples axes ..."] | None = per_member(rank=2, default=None)
    dt: float | None = eqx.field(static=True, default=None, kw_only=True)  # s

    def __check_init__(self):
        parts = self.parts
        if not all(isinstance(part, jax.Array | np.ndarray) for part in parts.values()):
            return
        try:
            fits = len({part.shape[:2] for part in parts.values()}) == 1
            ensemble_shape(self)
        except ValueError:
            fits = False
        if not fits:
            shapes = ", ".join(f"{name} {part.shape}" for name, part in parts.items())
            raise ValueError(
                f"a scenario's arrays have different shapes: {shapes}; give all of them the same "
                "samples and axes, and one ensemble or none"
            )

    @property
    def parts(self) -> dict[str, PyTree]:
        """The arrays that are given, by name."""
        named = {name: part for name, part in vars(self).items() if name != "dt"}
        return {name: part for name, part in named.items() if part is not None}

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all parts together, () for one loop."""
        return ensemble_shape(self)


One = Signal | Excitation | ArrayLike  # of one axis
Given = Mapping[str | int, One] | One | None
_PARTS = ("reference", "injection", "disturbance", "noise", "payload")


def scenario(
    *, duration: float, dt: float = 0.002, axes: int | Sequence[str] = 3, reference: Given = None,
    injection: Given = None, disturbance: Given = None, noise: Given = None, payload: Given = None,
    feed_forward: bool = False, ensemble: int | tuple[int, ...] = (),
    key: Key[Array, ""] | None = None,
) -> Scenario:  # fmt: skip
    """A `Scenario` from signals of single axes, with zeros where nothing is given.

        jq.scenario(
            duration=10.0,
            reference={"roll": jq.Step(np.radians(4))},
            disturbance={"roll": jq.Pulse(0.05, period=5.0, share=0.5, at=2.0)},
            noise=jq.simulation.WhiteNoise(np.radians(0.02)),
            key=jax.random.key(0),
        )

    **Arguments:**

    - `duration`, `dt`: s. All times are whole numbers of samples.
    - `axes`: how many the plant has, or their names (roll, pitch, yaw for up to three).
    - `reference` (rad), `noise` (rad), `disturbance` (N m), `injection` (units of the command) and
        `payload` (kg m^2, added to the plant's inertia): a map from an axis, by name or number, to
        a signal, or one signal for every axis. A signal is a `jq.Step`, `jq.Pulse`,
        `jq.simulation.Ramp`, `.SmoothStep`, `.Sine`, `.Gust`, `.WhiteNoise`, a sum of them, a
        `jq.excitation.Excitation`, or an array [samples, *ensemble].
    - `feed_forward`: the controller also gets the reference's rate and acceleration, which are zero
        for signals that jump.
    - `ensemble`: the number of members, each of which draws its own noise from `key`.
    - `key`: what an axis draws depends on nothing but the key, the part and the axis (and on the
        precision: float32 draws other numbers).

    **Returns:** the `Scenario`.

    **Raises:** ValueError for unknown axes, for times outside, and for arrays that do not fit.
    """
    require_all_positive(duration=duration, dt=dt)
    if isinstance(axes, int) and axes < 1:
        raise ValueError(f"axes is {axes}: give 1 or more")
    if isinstance(axes, str) or not axes or isinstance(axes, Sequence) and len({*axes}) < len(axes):
        raise ValueError(f"axes is {axes!r}: give their number, or their names, each once")
    names = axis_names(axes, "") if isinstance(axes, int) else tuple(axes)
    members = (ensemble,) if isinstance(ensemble, int) else tuple(ensemble)
    clock = Clock(whole_samples("duration", duration, 1 / dt, fewest=2), dt, members)
    signals = (reference, injection, disturbance, noise, payload)
    # Room for what each member draws for itself: as columns, and then side by side.
    some = [list(x.values()) if isinstance(x, Mapping) else [x] for x in signals]
    drawn = sum(any(isinstance(x, Signal) and x.random for x in part) for part in some)
    count = math.prod(members)
    needed = 2 * drawn * clock.samples * len(names) * count * as_float(0.0).dtype.itemsize
    remedy = "draw the noise of fewer members at a time, in jq.simulation.in_slices"
    require_memory(f"a scenario of {clock.samples} samples for {count} members", needed, remedy)
    parts = {
        name: _sampled(name, part, names, clock, _fold(key, k))
        for k, (name, part) in enumerate(zip(_PARTS, signals, strict=True))
    }
    arrays = {name: _stack(name, "value", part, clock) for name, part in parts.items()}
    if payload is None:
        del arrays["payload"]
    if feed_forward:
        for name in ("rate", "acceleration"):
            arrays[name] = _stack("reference", name, parts["reference"], clock)
    return Scenario(**arrays, dt=float(dt))


def axis_names(count: int, prefix: str = "axis ") -> tuple[str, ...]:
    """Roll, pitch and yaw, or a number for each of more axes."""
    return AXES[:count] if count <= len(AXES) else tuple(f"{prefix}{k}" for k in range(count))


def _sampled(
    name: str, part: Given, names: tuple[str, ...], clock: Clock, key: Key[Array, ""] | None
) -> list[Motion | None]:
    if part is not None and not isinstance(part, Mapping):
        part = dict.fromkeys(names, part)
    signals: dict[int, One] = {}
    for axis, one in (part or {}).items():
        if axis not in names and not (isinstance(axis, int) and 0 <= axis < len(names)):
            raise ValueError(
                f"{name} of the axis {axis!r}: choose one of {', '.join(names)}, or give other "
                "axes="
            )
        signals[names.index(axis) if axis in names else int(axis)] = one
    if len(signals) < len(part or {}):
        raise ValueError(f"{name}: an axis is given twice, by name and by number")
    motions: list[Motion | None] = [None] * len(names)
    for k, one in sorted(signals.items(), key=lambda item: item[0]):
        try:
            motions[k] = as_signal(one).sample(clock, _fold(key, k))
        except ValueError as error:
            raise ValueError(f"{name} of {names[k]}: {error}") from error
    return motions


def _fold(key: Key[Array, ""] | None, k: int) -> Key[Array, ""] | None:
    return None if key is None else jax.random.fold_in(key, k)


def _stack(
    name: str, field: str, motions: list[Motion | None], clock: Clock
) -> Float[Array, "samples axes ..."]:
    """One column for each axis, zeros for None; as wide as the widest needs."""
    signals = [None if motion is None else motion._asdict()[field] for motion in motions]
    shapes = [x.shape[1:] for x in signals if x is not None]
    try:
        members = np.broadcast_shapes(*shapes)
    except ValueError:
        text = ", ".join(str(shape) for shape in shapes)
        raise ValueError(f"{name}: the axes are for different ensembles, {text}") from None
    zero = np.zeros((clock.samples, *members), as_float(0.0).dtype)
    rows = [zero if x is None else fit(x, members) for x in signals]
    if any(isinstance(x, jax.Array) for x in rows):
        return jnp.stack(rows, axis=1)
    return as_float(np.stack(rows, axis=1))


def excite(
    signal: Float[ArrayLike, " samples *ensemble"], *, key: Key[Array, ""], dt: float,
    axis: str = "roll", torque_noise: float = 0.0, torque_corner: float = 2.0,
    sensor_noise: float = 0.0,
) -> Scenario:  # fmt: skip
    """An identification experiment: level flight with a `signal` injected into one axis.

    **Arguments:**

    - `signal`: V; a trailing axis makes an ensemble, every member with noise of its own.
    - `key`: of the noise.
    - `dt`: s, the sample interval of the signal.
    - `axis`: roll, pitch or yaw.
    - `torque_noise`, `torque_corner`: standard deviation in N m and bandwidth in rad/s of a
        Gauss-Markov torque on the axis.
    - `sensor_noise`: rad, standard deviation of white noise on the measured angle.

    **Raises:** ValueError for another axis, for a signal that is not finite, and for noise below 0.
    """
    if axis not in AXES:
        raise ValueError(f"axis {axis!r}: choose one of {', '.join(AXES)}")
    shape = np.shape(signal)
    if not shape or shape[0] < 2 or not np.all(np.isfinite(np.asarray(signal))):
        raise ValueError(
            f"a signal of shape {shape} in V: give at least 2 finite samples, for instance the "
            ".signal of jq.sweep(...)"
        )
    require_all_positive(dt=dt, torque_corner=torque_corner)
    require_all_nonnegative(torque_noise=torque_noise, sensor_noise=sensor_noise)
    levels = as_float([torque_noise, torque_corner, sensor_noise])
    return _excited(as_float(signal), key, levels, float(dt), AXES.index(axis))


@ft.partial(Jit, options=brief_options)
def _excited(signal, key, levels, dt, axis) -> Scenario:
    draw = lambda key: jax.random.normal(key, signal.shape, signal.dtype)
    gusts, white = jax.vmap(draw)(jax.random.split(key))  # together: they are compiled once
    torque = gauss_markov_of(gusts, deviation=levels[0], corner=levels[1], dt=dt)
    jitter = levels[2] * white
    still = jnp.zeros((signal.shape[0], len(AXES), *signal.shape[1:]), signal.dtype)
    injection, disturbance, noise = (still.at[:, axis].set(x) for x in (signal, torque, jitter))
    return Scenario(still, injection, disturbance, noise, dt=dt)


# What an ensemble needs, held against what there is, before an allocation fails.

_GB = 1e9


def require_memory(what: str, needed: float | int, remedy: str) -> None:
    """Raises ValueError where `needed` bytes are more than the default device has left.

    Where a machine does not tell what that is, nothing is refused.
    """
    free = free_memory(default_device())
    if free is not None and needed > free:
        raise ValueError(
            f"{what} needs about {needed / _GB:.3g} GB, but {free / _GB:.3g} GB are free: {remedy}"
        )
