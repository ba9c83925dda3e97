from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.control import LinearController

from ._curve import first
from ._linear_loop import axis_index, close, linear_parts, LinearParts, SampledAxis
from ._loop import Loop
from ._spectrum import abscissa, growth, powers, sharpest


_REACH = 1e4  # of the search, as a factor and its inverse
_COARSE, _FINE, _ROUNDS = 121, 15, 2  # gains of the search, and of each closer look
_SHARP = 1e-5  # 1/s, to which the edges of stability are known


class GainWindow(NamedTuple):
    """Between which values of b/b0 a loop is stable; `nan` where none is.

    An end that the search does not reach, a ten-thousandth or ten thousand times the plant's own
    gain, is 0 or infinite.

    **Arguments:**

    - `low`, `high`: b/b0, in the shape of the loop's ensemble.
    """

    low: Float[Array, "*ensemble"]
    high: Float[Array, "*ensemble"]

    def __str__(self) -> str:
        low, high = np.atleast_1d(self.low), np.atleast_1d(self.high)
        if np.all(np.isnan(low)):
            return "no gain makes the loop stable"
        text = f"stable for gains of {np.nanmax(low):.4g} to {np.nanmin(high):.4g}"
        return text if low.size == 1 else f"{text}, all of {np.sum(~np.isnan(low))} members"


def gain_window(
    loop: Loop, axis: int | str = "roll", *, member: int | tuple[int, ...] | None = None
) -> GainWindow:
    """The values of r = b/b0 for which the controller keeps the plant stable.

    b is the plant's gain, torque per unit of command over inertia. All values are tried, whatever
    the plant's own, with the same lag, delay, damping/inertia and stiffness/inertia; b0 is the
    controller's. For a controller without b0 the window is that of b itself, in rad/s^2 per unit of
    command. The edges are roots of the abscissa, exact to 1e-5 1/s and differentiable. Of several
    windows it is the one that holds the plant's own gain, else the one with the most stable loop. A
    window narrower than a thousandth of its place may be missed.

    **Arguments:** those of `jq.analyse`.

    **Returns:** a `GainWindow`, in the shape of the loop's ensemble.

    **Raises:** ValueError as `jq.analyse` does.
    """
    parts, ensemble = linear_parts(loop, [axis_index(axis)], member)
    return GainWindow(*(edge.reshape(ensemble) for edge in _windows(parts)))


@eqx.filter_jit
def _windows(parts: LinearParts) -> GainWindow:
    if parts.count == 1:
        return jax.tree.map(lambda x: x[None], _window(parts.at(0)))
    return jax.vmap(_window)(parts)


def _window(parts: LinearParts) -> GainWindow:
    plant, controller = parts.sampled()
    sharp = sharpest(_SHARP, parts.dt, plant.fresh.dtype)
    ladder = lambda matrix: powers(matrix, parts.dt, sharp)
    fixed = jax.lax.stop_gradient((plant, controller))
    grown = lambda factor: growth(ladder(_closed(*fixed, factor, parts.memory)), parts.dt)
    rate = jax.vmap(grown)

    def slowest(factor: Float[Array, ""]) -> Float[Array, ""]:
        matrix = _closed(plant, controller, factor, parts.memory)
        return abscissa(matrix, ladder(matrix), parts.dt, sharp)

    def newton_step(root: Float[Array, ""]) -> Float[Array, ""]:
        """`root` a Newton step on, with its derivatives by the implicit function theorem."""
        place = jnp.where(jnp.isnan(root), 1.0, root)
        value, slope = jax.jvp(slowest, (place,), (jnp.ones_like(place),))
        slope = jax.lax.stop_gradient(slope)
        return root - value / jnp.where(slope == 0, 1.0, slope)

    # Closer looks at the most stable gain, for windows that a coarse search steps over.
    factors = jnp.asarray(np.geomspace(1 / _REACH, _REACH, _COARSE), plant.fresh.dtype)
    share = jnp.linspace(0, 1, _FINE + 2, dtype=plant.fresh.dtype)[1:-1]
    for _ in range(_ROUNDS):
        best = jnp.argmin(rate(factors))
        ends = [factors[jnp.clip(best + k, 0, factors.size - 1)] for k in (-1, 1)]
        closer = ends[0] * (ends[1] / ends[0]) ** share
        factors = jnp.sort(jnp.concatenate([factors, closer]))
    rates = rate(factors)
    # The stable neighbours of the plant's own gain, or of the most stable one.
    unity = jnp.argmin(jnp.abs(jnp.log(factors)))
    anchor = jnp.where(rates[unity] < 0, unity, jnp.argmin(rates))
    label = jnp.cumsum(~(rates < 0))
    inside = (rates < 0) & (label == label[anchor])
    exists, ratio = jnp.any(inside), parts.ratio

    crossed = jnp.stack([~inside[:-1] & inside[1:], inside[:-1] & ~inside[1:]])
    roots = jax.lax.stop_gradient(jax.vmap(lambda where: first(rate, factors, where))(crossed))
    edges = jax.vmap(newton_step)(roots)
    is_open = jnp.stack([inside[0], inside[-1]])
    edges = jnp.where(is_open, jnp.array([0.0, jnp.inf], edges.dtype), edges) * ratio
    return GainWindow(*jnp.where(exists, edges, jnp.nan))


def _closed(
    plant: SampledAxis, controller: LinearController, factor: Float[Array, ""], memory: int
) -> Float[Array, "states states"]:
    scaled = plant._replace(fresh=plant.fresh * factor, stale=plant.stale * factor)
    return close(scaled, controller, memory).balanced().matrix
