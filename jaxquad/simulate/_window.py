from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxquad.excitation._checks import whole_samples


_REST = 20  # the last of so many parts of the window, in which a step's reference stands still
_STILL = 0.02  # of the step
_ROUNDING = 1e-6
_ASIDE = 0.2  # of the step, how far the reference may leave the way from start to end


class Window(NamedTuple):
    """The samples that are judged, by their index."""

    first: Int[Array, ""]
    last: Int[Array, ""]
    loaded: Int[Array, ""]  # first of those that count as under load
    until: Int[Array, ""]  # last of those that count as the answer to a step


def window(
    samples: int, dt: float, *, start: float, stop: float | None, load_start: float | None
) -> tuple[int, int, int, int]:
    """The indices of a `Window` for `start` <= t < `stop`.

    The answer to a step ends where the load begins, if that is later than `start`.
    Raises ValueError for times that are no whole samples and for a window that is none.
    """
    rate = 1 / dt
    first = whole_samples("start", start, rate, fewest=0)
    end = samples if stop is None else whole_samples("stop", stop, rate)
    loaded = (
        first if load_start is None else whole_samples("load_start", load_start, rate, fewest=0)
    )
    if not (first + 2 <= end <= samples and first <= loaded < end):
        raise ValueError(
            f"a window from {start:.6g} to {end * dt:.6g} s, under load from {loaded * dt:.6g} s: "
            f"of the {samples * dt:.6g} s that there are, give two samples or more, and "
            "start <= load_start < stop"
        )
    return first, end - 1, loaded, (loaded if loaded > first else end) - 1


def makes_step(
    reference: Float[Array, "samples axes ..."], judged: Window
) -> Bool[Array, "axes ..."]:
    """Whether the reference goes from one value to another, more or less straight, and stays."""
    judged = judged._replace(last=judged.until)
    start, end = reference[jnp.maximum(judged.first - 1, 0)], reference[judged.last]
    size, low, high = jnp.abs(end - start), jnp.minimum(start, end), jnp.maximum(start, end)
    aside = (reference < (low - _ASIDE * size)[None]) | (reference > (high + _ASIDE * size)[None])
    moving = jnp.abs(reference - end[None]) > (_STILL * size)[None]
    resting = judged._replace(first=judged.last - (judged.last - judged.first) // _REST)
    wrong = (aside & inside(judged, reference)) | (moving & inside(resting, reference))
    return ~wrong.any(axis=0)


def share_beyond(
    limit: Float[Array, "axes ..."], signal: Float[Array, "samples axes ..."], judged: Window
) -> Float[Array, "axes ..."]:
    """Share of the window's samples in which a signal exceeds a limit in size."""
    rows = limit.astype(signal.dtype)[None]
    members = max(rows.ndim, signal.ndim)
    rows, signal = (x.reshape(x.shape + (1,) * (members - x.ndim)) for x in (rows, signal))
    shape = jnp.broadcast_shapes(rows.shape, signal.shape)
    rows, signal = jnp.broadcast_to(rows, shape), jnp.broadcast_to(signal, shape)
    beyond = (jnp.abs(signal) > rows * (1 + _ROUNDING)) & inside(judged, signal)
    count = (judged.last - judged.first + 1).astype(rows.dtype)
    return jnp.sum(beyond.astype(rows.dtype), axis=0) / count


def inside(judged: Window, like: Float[Array, "samples ..."]) -> Bool[Array, "samples ..."]:
    """Which samples are judged, shaped to go with `like`."""
    index = jnp.arange(like.shape[0]).reshape((-1,) + (1,) * (like.ndim - 1))
    return jnp.broadcast_to((index >= judged.first) & (index <= judged.last), like.shape)
