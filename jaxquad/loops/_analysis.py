"""Numbers and responses of linear loops, of all axes of all members at once; gain windows."""

import functools as ft
from collections.abc import Collection, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from jaxquad._compile import brief_options, Jit
from jaxquad.control import LinearController
from jaxquad.records import AXES

from ._curve import crossings, decibels, degrees, lines, shown
from ._linear_loop import (
    abscissa,
    close,
    ClosedLoopMatrix,
    growth,
    join,
    linear_parts,
    LinearParts,
    noise_gain,
    OpenLoop,
    powers,
    SampledAxis,
    sharpest,
)
from ._loop import Loop
from ._margins import disturbance_rejection, margins


_LOWEST, _BEYOND, _POINTS = 1e-5, 1.0005, 500  # of pi / dt; a crossing may lie at pi / dt itself
_SMOOTH_LOWEST, _SMOOTH_POINTS = 1e-4, 160  # of pi / dt, where the smooth peak of |S| is looked for
_STATIC = 1e-9  # a static gain margin below it is rounding: the loop integrates
_STABLE = 1.0  # 1/s, what an unstable loop is made to decay at where only its gradient must exist

MARGINS = ("gain_margin", "gain_reduction", "phase_margin", "crossover", "delay_margin")
REJECTION = ("sensitivity_peak", "sensitivity_frequency", "rejection_bandwidth")
NUMBERS = ("abscissa", "noise_gain", *MARGINS, *REJECTION)


def linear_numbers(
    loop: Loop, axes: Sequence[int], wanted: Collection[str], *, smoothing: float = 1e-5
) -> dict[str, Float[Array, " axes *ensemble"]]:  # fmt: skip
    """The `wanted` numbers of a `LoopAnalysis`, and the abscissa, of some axes of all members.

    Noise gain and sensitivity peak stay finite and differentiable in an unstable loop; the peak is
    where a parabola through three neighbouring values of |1 + L|^2 is least.
    """
    parts, ensemble = linear_parts(loop, axes)

    def of_one(one: LinearParts) -> dict[str, Float[Array, ""]]:
        plant, controller = one.sampled()
        closed = close(plant, controller, one.memory).balanced()
        return numbers_of(join(plant, controller), closed, wanted, smoothing, smooth=True)

    numbers = jax.vmap(of_one)(parts)
    return {name: x.reshape(len(axes), *ensemble) for name, x in numbers.items()}


def numbers_of(
    loop: OpenLoop, closed: ClosedLoopMatrix, wanted: Collection[str], smoothing: float, *,
    smooth: bool = False,
) -> dict[str, Float[Array, ""]]:  # fmt: skip
    """The `wanted` numbers of one loop, and the abscissa; see `linear_numbers`."""
    smoothing = sharpest(smoothing, loop.dt, closed.matrix.dtype)
    ladder = powers(closed.matrix, loop.dt, smoothing)
    numbers = {"abscissa": abscissa(closed.matrix, ladder, loop.dt, smoothing)}
    rate = jax.lax.stop_gradient(numbers["abscissa"])
    stable = rate < 0
    if "noise_gain" in wanted:
        shift = jnp.where(stable, 0.0, (rate + _STABLE) * loop.dt)
        system = (closed.matrix, closed.noise, closed.command, closed.through)
        noise = noise_gain(*system, ladder, shift)
        numbers["noise_gain"] = noise if smooth else jnp.where(stable, noise, jnp.inf)
    if smooth and "sensitivity_peak" in wanted:
        numbers["sensitivity_peak"] = _smooth_peak(loop)
    # It holds all frequencies but 0: a crossing that is missing does not exist.
    grid = np.geomspace(_LOWEST, _BEYOND, _POINTS) * np.pi / loop.dt
    others, omega = {}, jnp.asarray(grid, loop.shift.dtype)
    if any(name in wanted for name in MARGINS):
        margin, static = margins(loop, omega=omega), loop.static_gain_margin()
        there = lambda x, missing: jnp.where(jnp.isnan(x), missing, x)
        up, down = there(margin.gain_margin, jnp.inf), there(margin.gain_reduction, 0.0)
        falls = (static < 1) & (static > _STATIC)
        of_margins = {
            "gain_margin": jnp.where(static >= 1, jnp.minimum(up, static), up),
            "gain_reduction": jnp.where(falls, jnp.maximum(down, static), down),
            "phase_margin": there(margin.phase_margin, jnp.inf),
            "crossover": margin.crossover,
            "delay_margin": there(margin.delay_margin, jnp.inf),
        }
        others = {name: jnp.where(stable, x, jnp.nan) for name, x in of_margins.items()}
    if any(name in wanted and name not in numbers for name in REJECTION):
        rejection = disturbance_rejection(loop, omega=omega)
        others |= {
            "sensitivity_peak": jnp.where(stable, rejection.peak, jnp.inf),
            "sensitivity_frequency": jnp.where(stable, rejection.peak_frequency, jnp.nan),
            "rejection_bandwidth": jnp.where(stable, rejection.bandwidth, jnp.nan),
        }
    return {name: x for name, x in others.items() if name in wanted} | numbers


def _smooth_peak(loop: OpenLoop) -> Float[Array, ""]:
    """Of all points on a grid; only those about the peak are differentiated."""
    grid = np.geomspace(_SMOOTH_LOWEST, 1.0, _SMOOTH_POINTS) * np.pi / loop.dt
    omega = jnp.asarray(grid, loop.shift.dtype)
    place = jnp.argmin(_parabolas(jax.lax.stop_gradient(loop).squared_distance(omega)))
    about = jax.lax.dynamic_slice(omega, (place,), (3,))
    square = loop.squared_distance(jnp.concatenate([about, omega[-1:]]))
    return 1 / jnp.sqrt(jnp.minimum(_parabolas(square[:3])[0], square[3]))


def _parabolas(square: Float[Array, " points"]) -> Float[Array, " inner"]:
    """The least |1 + L|^2 near each inner point: about a sharp peak of |S| it is a parabola."""
    low, middle, high = square[:-2], square[1:-1], square[2:]
    slope, bend = 0.5 * (high - low), low - 2 * middle + high
    deepest = (middle <= low) & (middle <= high) & (bend > 0)
    drop = jnp.where(deepest, 0.5 * slope**2 / jnp.where(deepest, bend, 1.0), 0.0)
    return jnp.maximum(middle - drop, 0.01 * middle)


class LoopResponse(eqx.Module):
    """One response of a closed sampled loop, a model for `jq.loops.attitude_bandwidth`."""

    loop: OpenLoop
    kind: str = eqx.field(static=True)

    @property
    def dt(self) -> float:
        """The sample interval in s."""
        return self.loop.dt

    def frequency_response(
        self, omega: Float[Array, " frequencies"]
    ) -> Complex[Array, "frequencies 1 1"]:
        """The response at `omega` in rad/s, up to pi / dt."""
        driven, disturbance, feedback, prefilter = self.loop.parts(omega)
        forward = {
            "reference": driven * prefilter,
            "disturbance": disturbance,
            "sensitivity": jnp.ones_like(driven),
            "noise": feedback,
        }
        return (forward[self.kind] / (1 - driven * feedback))[:, None, None]


class LoopAnalysis(eqx.Module):
    """What a closed loop is worth, from `jq.analyse`; ensembles have arrays of their shape.

    `abscissa` is the real part of the slowest pole, found without eigenvalues; `stable` means that
    it is below 0. Where poles coincide, as LADRC places them, the gradient of a pole is infinite;
    the abscissa then lies above them, by less than the `smoothing` of `analyse` (1e-5 1/s
    unless given) or by what rounding does to them (at 2 ms 1e-4 1/s for two poles, 1 1/s for five).
    Its gradient grows as 1 / smoothing there: tune with 0.1 or 1.
    Margins are those of the loop broken at the command. In an unstable loop they are `nan`, and
    sensitivity peak and noise gain are infinite, whose gradients are 0.

    **Arguments:**

    - `abscissa`: 1/s; `stable`: whether every pole decays.
    - `sensitivity_peak`, `sensitivity_frequency`: Ms, the greatest |S|, and where, rad/s.
    - `rejection_bandwidth`: rad/s, where |S| first rises through -3 dB.
    - `gain_margin`, `gain_reduction`: factors by which the gain may rise (inf if any), and to which
        it may fall (0 if any).
    - `phase_margin`, `crossover`: rad, and at which frequency, rad/s.
    - `delay_margin`: s, from the phase margin at its crossover.
    - `noise_gain`: rms of the command per rms of white measurement noise.
    - `closed`, `loop`: the closed loop as a matrix, the loop broken at the command; `dt`: s.
    """

    abscissa: Float[Array, "*ensemble"]
    stable: Bool[Array, "*ensemble"]
    sensitivity_peak: Float[Array, "*ensemble"]
    sensitivity_frequency: Float[Array, "*ensemble"]
    rejection_bandwidth: Float[Array, "*ensemble"]
    gain_margin: Float[Array, "*ensemble"]
    gain_reduction: Float[Array, "*ensemble"]
    phase_margin: Float[Array, "*ensemble"]
    crossover: Float[Array, "*ensemble"]
    delay_margin: Float[Array, "*ensemble"]
    noise_gain: Float[Array, "*ensemble"]
    closed: ClosedLoopMatrix
    loop: OpenLoop
    dt: float = eqx.field(static=True)

    @property
    def poles(self) -> np.ndarray:
        """ln(z) / dt of the closed loop's poles, slowest first, rad/s; on the host, not under jit.

        A pole at z = 0, such as a command on its way, is at minus infinity. Coincident poles come
        out apart by a root of the rounding error.
        """
        z = np.linalg.eigvals(np.asarray(self.closed.matrix)).astype(complex)
        with np.errstate(divide="ignore"):
            rate = np.log(np.abs(z)) / self.dt
        # Not a sum: 1j times an angle would put nan beside an infinite rate.
        s = np.stack([rate, np.angle(z) / self.dt], axis=-1).view(complex)[..., 0]
        return np.take_along_axis(s, np.argsort(-rate, axis=-1, kind="stable"), axis=-1)

    @property
    def reference(self) -> LoopResponse:
        """From the angle of the reference to the sampled angle; rate and acceleration held at 0."""
        return LoopResponse(self.loop, "reference")

    @property
    def disturbance(self) -> LoopResponse:
        """From a torque in N m, held over a sample, to the sampled angle in rad."""
        return LoopResponse(self.loop, "disturbance")

    @property
    def sensitivity(self) -> LoopResponse:
        """S = 1 / (1 + L)."""
        return LoopResponse(self.loop, "sensitivity")

    @property
    def noise(self) -> LoopResponse:
        """From measurement noise in rad to the command."""
        return LoopResponse(self.loop, "noise")

    def member(self, *place: int) -> "LoopAnalysis":
        """One of an ensemble."""
        if len(place) != self.abscissa.ndim:
            raise ValueError(
                f"member {place} of an ensemble of shape {self.abscissa.shape}: give one index each"
            )
        return jax.tree.map(lambda x: x[place], self)

    def __str__(self) -> str:
        if self.abscissa.ndim:
            stable = np.asarray(self.stable)
            share = f"ensemble of {stable.size} loops, {100 * np.mean(stable):.3g} % stable"
            if not np.any(stable):
                return share
            worst = lambda x, find: float(find(np.asarray(x)[stable]))
            rows = [
                ("slowest pole", f"{worst(self.abscissa, np.max):.4g} 1/s"),
                ("Ms", f"{worst(self.sensitivity_peak, np.max):.4g}"),
                ("phase margin", f"{np.degrees(worst(self.phase_margin, np.min)):.4g} deg"),
                ("delay margin", f"{1e3 * worst(self.delay_margin, np.min):.4g} ms"),
                ("noise gain", f"{worst(self.noise_gain, np.max):.4g} command/rad"),
            ]
            return "\n".join([share, "worst of the stable ones:", lines(rows, [])])
        if np.isnan(self.abscissa):
            return "no analysis: a number is not finite, or the delay is beyond longest_delay"
        if not bool(self.stable):
            return f"unstable loop\n  grows as exp({float(self.abscissa):.4g} t / s): no margins"
        factors = float(self.gain_margin), float(self.gain_reduction)
        up, down = (decibels(x, None) if 0 < x < np.inf else "any" for x in factors)
        phase, late = "any", "any"
        if np.isfinite(self.phase_margin):
            phase = f"{degrees(self.phase_margin, None)} at {float(self.crossover):.4g} rad/s"
            late = shown(self.delay_margin, None, "ms", 1e3)
        peak = float(self.sensitivity_frequency)
        rows = [
            ("slowest pole", shown(self.abscissa, None, "1/s")),
            ("Ms", f"{float(self.sensitivity_peak):.4g} at {peak:.4g} rad/s"),
            ("gain margin", f"{up} up, {down} down"),
            ("phase margin", phase),
            ("delay margin", late),
            ("noise gain", f"{float(self.noise_gain):.4g} command/rad, rms of white noise"),
        ]
        return "\n".join(["stable loop", lines(rows, [])])


def analyse(
    loop: Loop, axis: int | str = "roll", *, member: int | tuple[int, ...] | None = None,
    smoothing: float = 1e-5,
) -> LoopAnalysis:  # fmt: skip
    """Stability, margins and noise of one axis with its sampled controller, exactly.

    The plant is discretised under a held command that acts `delay` seconds late, whatever part of a
    sample that is, and joined with `controller.linear(axis, member)`: no continuous approximation,
    no Pade. Limits, encoder and dry friction have no linear part and are left out; a
    `jq.models.Multirotor` is taken near level flight. Every number is differentiable (abscissa and
    noise gain once) with respect to plant, controller and delay, and works under jit and vmap. An
    ensemble in any of the three gives arrays of its shape, from one compile. A delay traced by them
    that exceeds `longest_delay` gives `nan`.

        print(jq.analyse(jq.Loop(plant, jq.LADRC(10.0, 30.0, 0.85), delay=0.004), "roll"))

    **Arguments:**

    - `loop`: see `jq.Loop`.
    - `axis`: by name (roll, pitch, yaw) or number.
    - `member`: the index of one member of an ensemble; None analyses all.
    - `smoothing`: 1/s, how sharp the abscissa is, see `LoopAnalysis`.

    **Returns:** a `LoopAnalysis`.

    **Raises:** ValueError for a plant or controller without a linear form, an axis or member that
    does not exist, and ensembles that do not match.

    Source: Franklin, Powell & Workman, Digital Control of Dynamic Systems, section 4.3.
    """
    if not isinstance(loop, Loop):
        raise ValueError(
            f"loop is a {type(loop).__name__}: give jq.Loop(plant, controller, ...), or "
            "jq.loops.margins(model) for the margins of a model alone"
        )
    if not 0 < smoothing < float("inf"):
        raise ValueError(
            f"smoothing is {smoothing} 1/s: give a rate above 0, as 1e-5 or, to tune, 0.1."
        )
    place = None if member is None else tuple(int(k) for k in np.atleast_1d(member))
    return _analyse_axis(loop, axis_index(axis), place, smoothing)


@eqx.filter_jit
def _analyse_axis(
    loop: Loop, axis: int, member: tuple[int, ...] | None, smoothing: float
) -> LoopAnalysis:
    parts, ensemble = linear_parts(loop, [axis], member)
    analysis = analyse_parts(parts, smoothing)
    return jax.tree.map(lambda x: x.reshape(ensemble + x.shape[1:]), analysis)


def axis_index(axis: int | str) -> int:
    """The number of an axis. Raises ValueError for a name that it does not have."""
    if isinstance(axis, int):
        if axis < 0:
            raise ValueError(f"axis is {axis}: give 0 or above, or one of {', '.join(AXES)}")
        return axis
    if axis not in AXES:
        raise ValueError(f"axis is {axis!r}: choose one of {', '.join(AXES)}, or a number")
    return AXES.index(axis)


@ft.partial(Jit, options=brief_options)
def analyse_parts(parts: LinearParts, smoothing: float) -> LoopAnalysis:
    """The analysis of each loop, on a first axis."""

    def analyse_one(one: LinearParts) -> LoopAnalysis:
        plant, controller = one.sampled()
        loop, closed = join(plant, controller), close(plant, controller, one.memory).balanced()
        numbers = numbers_of(loop, closed, NUMBERS, smoothing)
        stable = jax.lax.stop_gradient(numbers["abscissa"]) < 0
        return LoopAnalysis(**numbers, stable=stable, closed=closed, loop=loop, dt=one.dt)

    return parts.map(analyse_one)


_STATES = 5  # all controllers get as many: then they share what is compiled


class LoopNumbers(NamedTuple):
    """Numbers of the linear loops of an ensemble; NaN where an unstable loop has no such number."""

    stable: Bool[np.ndarray, " axes *ensemble"]
    abscissa: Float[np.ndarray, " axes *ensemble"]  # 1/s
    sensitivity_peak: Float[np.ndarray, " axes *ensemble"]
    gain_margin: Float[np.ndarray, " axes *ensemble"]  # factor
    gain_reduction: Float[np.ndarray, " axes *ensemble"]  # factor
    phase_margin: Float[np.ndarray, " axes *ensemble"]  # rad
    delay_margin: Float[np.ndarray, " axes *ensemble"]  # s
    noise_gain: Float[np.ndarray, " axes *ensemble"]  # rms of the command per rad rms


def loop_numbers(loop: Loop, axes: Sequence[int]) -> LoopNumbers:
    """`analyse` of some axes of all members at once; stability by the eigenvalues themselves."""
    parts, ensemble = linear_parts(loop, axes, states=_STATES)
    analysis = analyse_parts(parts, 1e-5)
    slowest = np.real(analysis.poles[:, 0])
    stable = np.asarray(analysis.stable) & (slowest < 0)
    numbers = {
        name: np.where(stable, np.asarray(vars(analysis)[name]), np.nan)
        for name in LoopNumbers._fields[2:]
    }
    rows = (stable, slowest, *numbers.values())
    return LoopNumbers(*(x.reshape(len(axes), *ensemble) for x in rows))


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
    return parts.map(_window)


def _window(parts: LinearParts) -> GainWindow:
    plant, controller = parts.sampled()
    sharp = sharpest(_SHARP, parts.dt, plant.fresh.dtype)
    ladder = lambda matrix: powers(matrix, parts.dt, sharp)

    def closed(
        plant: SampledAxis, controller: LinearController, factor: Float[Array, ""]
    ) -> Float[Array, "states states"]:
        scaled = plant._replace(fresh=plant.fresh * factor, stale=plant.stale * factor)
        return close(scaled, controller, parts.memory).balanced().matrix

    fixed = jax.lax.stop_gradient((plant, controller))
    rate = jax.vmap(lambda factor: growth(ladder(closed(*fixed, factor)), parts.dt))

    def slowest(factor: Float[Array, ""]) -> Float[Array, ""]:
        matrix = closed(plant, controller, factor)
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
    roots = jax.vmap(lambda where: crossings(rate, factors, where)[0])(crossed)
    edges = jax.vmap(newton_step)(jax.lax.stop_gradient(roots))
    is_open = jnp.stack([inside[0], inside[-1]])
    edges = jnp.where(is_open, jnp.array([0.0, jnp.inf], edges.dtype), edges) * ratio
    return GainWindow(*jnp.where(exists, edges, jnp.nan))
