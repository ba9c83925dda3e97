from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxquad.models import DecoupledAxes, Multirotor
from jaxquad.qualities import disturbance_rejection, margins

from ._case import Case, case_of
from ._loop import close, join, SampledLoop
from ._result import LoopAnalysis
from ._spectrum import abscissa, noise_gain, powers, sharpest


_LOWEST, _BEYOND, _POINTS = 1e-5, 1.0005, 500  # of pi / dt; a crossing may lie at pi / dt itself
_NOTHING = 1e-9  # a static gain margin that is rounding: the loop integrates
_STABLE = 1.0  # 1/s, what an unstable loop is made to decay at where only its gradient must exist


def analyse_loop(
    plant: DecoupledAxes | Multirotor,
    controller: Any,
    *,
    axis: int = 0,
    member: int | tuple[int, ...] | None = None,
    dt: float | None = None,
    delay: Float[ArrayLike, "..."] = 0.0,
    longest_delay: float | None = None,
    smoothing: float = 1e-5,
) -> LoopAnalysis:
    """Stability, margins and noise of one axis with its sampled controller, exactly.

    The plant is discretised under a held command that acts `delay` seconds late, whatever part of a
    sample that is, and joined with `controller.linear(axis, member)`: no continuous approximation,
    no Pade. Limits, encoder and dry friction have no linear part and are left out; a
    `jq.Multirotor` is taken near level flight. Every number is differentiable (abscissa and noise
    gain once) with respect to plant, controller and delay, and works under jit and vmap. An
    ensemble in any of the three gives arrays of its shape, from one compile; `member` picks one.
    `dt` is the controller's unless it has none. A traced `delay` needs `longest_delay`, in s, and
    gives `nan` beyond it. `smoothing`, in 1/s, says how sharp the abscissa is, see `LoopAnalysis`.
    Raises ValueError for parts that do not fit together.
    Source: Franklin, Powell & Workman, Digital Control of Dynamic Systems, section 4.3.
    """
    if not 0 < smoothing < float("inf"):
        raise ValueError(
            f"smoothing is {smoothing} 1/s: give a rate above 0, as 1e-5 or, to tune, 0.1."
        )
    return _analysed(case_of(plant, controller, axis, member, dt, delay, longest_delay), smoothing)


@eqx.filter_jit
def _analysed(case: Case, smoothing: float) -> LoopAnalysis:
    if case.member is not None or not case.ensemble:
        return _one(case, case.member or (), smoothing)
    places = jnp.unravel_index(jnp.arange(int(np.prod(case.ensemble))), case.ensemble)
    flat = jax.vmap(lambda *place: _one(case, place, smoothing))(*places)
    return jax.tree.map(lambda x: x.reshape(case.ensemble + x.shape[1:]), flat)


def _one(case: Case, place: tuple, smoothing: float) -> LoopAnalysis:
    plant, controller = case.parts(place)
    loop, closed = join(plant, controller), close(plant, controller, case.memory).balanced()
    smoothing = sharpest(smoothing, case.dt, closed.matrix.dtype)
    ladder = powers(closed.matrix, case.dt, smoothing)
    slowest = abscissa(closed.matrix, ladder, case.dt, smoothing)
    rate = jax.lax.stop_gradient(slowest)
    stable = rate < 0
    shift = jnp.where(stable, 0.0, (rate + _STABLE) * case.dt)
    noise = noise_gain(closed.matrix, closed.noise, closed.command, closed.through, ladder, shift)
    return LoopAnalysis(
        abscissa=slowest,
        stable=stable,
        noise_gain=jnp.where(stable, noise, jnp.inf),
        **_qualities(loop, stable),
        closed=closed,
        loop=loop,
        dt=case.dt,
    )


def _qualities(loop: SampledLoop, stable: Bool[Array, ""]) -> dict[str, Array]:
    grid = np.geomspace(_LOWEST, _BEYOND, _POINTS) * np.pi / loop.dt
    omega = jnp.asarray(grid, loop.shift.dtype)
    margin, rejection = margins(loop, omega=omega), disturbance_rejection(loop, omega=omega)
    # The grid holds all frequencies but 0: a crossing that is missing does not exist.
    static = loop.static_gain_margin()
    up, down = _or(jnp.inf, margin.gain_margin), _or(0.0, margin.gain_reduction)
    found = {
        "gain_margin": jnp.where(static >= 1, jnp.minimum(up, static), up),
        "gain_reduction": jnp.where(
            (static < 1) & (static > _NOTHING), jnp.maximum(down, static), down
        ),
        "phase_margin": _or(jnp.inf, margin.phase_margin),
        "crossover": margin.crossover,
        "delay_margin": _or(jnp.inf, margin.delay_margin),
        "rejection_bandwidth": rejection.bandwidth,
    }
    found = {name: jnp.where(stable, value, jnp.nan) for name, value in found.items()}
    found["sensitivity_peak"] = jnp.where(stable, rejection.peak, jnp.inf)
    found["sensitivity_frequency"] = jnp.where(stable, rejection.peak_frequency, jnp.nan)
    return found


def _or(missing: float, value: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.where(jnp.isnan(value), missing, value)
