import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from ._closed_loop import close, ClosedLoopMatrix, join, OpenLoop
from ._linear_parts import linear_parts, LinearParts
from ._loop import Loop
from ._spectrum import abscissa, noise_gain, powers, sharpest
from .qualities._margins import margins
from .qualities._rejection import disturbance_rejection
from .qualities._text import decibels, degrees, lines, shown


class LoopResponse(eqx.Module):
    """One response of a closed sampled loop, for `jq.loops.attitude_bandwidth`, plots and the like."""

    loop: OpenLoop
    kind: str = eqx.field(static=True)

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
    """

    abscissa: Float[Array, "*ensemble"]  # 1/s
    stable: Bool[Array, "*ensemble"]
    sensitivity_peak: Float[Array, "*ensemble"]  # Ms
    sensitivity_frequency: Float[Array, "*ensemble"]  # rad/s, of that peak
    rejection_bandwidth: Float[Array, "*ensemble"]  # rad/s, where |S| first rises through -3 dB
    gain_margin: Float[Array, "*ensemble"]  # factor by which the gain may rise; inf if any
    gain_reduction: Float[Array, "*ensemble"]  # factor to which it may fall; 0 if any
    phase_margin: Float[Array, "*ensemble"]  # rad
    crossover: Float[Array, "*ensemble"]  # rad/s, of the phase margin
    delay_margin: Float[Array, "*ensemble"]  # s, from the phase margin at its crossover
    noise_gain: Float[Array, "*ensemble"]  # rms of the command per rms of white measurement noise
    closed: ClosedLoopMatrix
    loop: OpenLoop
    dt: float = eqx.field(static=True)  # s

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
        return _table(self) if self.abscissa.ndim == 0 else _summary(self)


def _table(loop: LoopAnalysis) -> str:
    if np.isnan(loop.abscissa):
        return "no analysis: a number is not finite, or the delay is beyond longest_delay"
    if not bool(loop.stable):
        return f"unstable loop\n  grows as exp({float(loop.abscissa):.4g} t / s): no margins"
    peak, crossover = float(loop.sensitivity_frequency), float(loop.crossover)
    up, down = _gain(loop.gain_margin), _gain(loop.gain_reduction)
    rows = [
        ("slowest pole", shown(loop.abscissa, None, "1/s")),
        ("Ms", f"{float(loop.sensitivity_peak):.4g} at {peak:.4g} rad/s"),
        ("gain margin", f"{up} up, {down} down"),
        ("phase margin", "any"),
        ("delay margin", "any"),
        ("noise gain", f"{float(loop.noise_gain):.4g} command/rad, rms of white noise"),
    ]
    if np.isfinite(loop.phase_margin):
        rows[3] = ("phase margin", f"{degrees(loop.phase_margin, None)} at {crossover:.4g} rad/s")
        rows[4] = ("delay margin", shown(loop.delay_margin, None, "ms", 1e3))
    return "\n".join(["stable loop", lines(rows, [])])


def _gain(factor: Float[Array, ""]) -> str:
    return decibels(factor, None) if 0 < factor < np.inf else "any"


def _summary(loop: LoopAnalysis) -> str:
    stable = np.asarray(loop.stable)
    share = f"ensemble of {stable.size} loops, {100 * np.mean(stable):.3g} % stable"
    if not np.any(stable):
        return share
    worst = lambda x, find: float(find(np.asarray(x)[stable]))
    rows = [
        ("slowest pole", f"{worst(loop.abscissa, np.max):.4g} 1/s"),
        ("Ms", f"{worst(loop.sensitivity_peak, np.max):.4g}"),
        ("phase margin", f"{np.degrees(worst(loop.phase_margin, np.min)):.4g} deg"),
        ("delay margin", f"{1e3 * worst(loop.delay_margin, np.min):.4g} ms"),
        ("noise gain", f"{worst(loop.noise_gain, np.max):.4g} command/rad"),
    ]
    return "\n".join([share, "worst of the stable ones:", lines(rows, [])])


_LOWEST, _BEYOND, _POINTS = 1e-5, 1.0005, 500  # of pi / dt; a crossing may lie at pi / dt itself
_NOTHING = 1e-9  # a static gain margin that is rounding: the loop integrates
_STABLE = 1.0  # 1/s, what an unstable loop is made to decay at where only its gradient must exist


def analyse(
    loop: Loop,
    axis: int | str = "roll",
    *,
    member: int | tuple[int, ...] | None = None,
    smoothing: float = 1e-5,
) -> LoopAnalysis:
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
    if not 0 < smoothing < float("inf"):
        raise ValueError(
            f"smoothing is {smoothing} 1/s: give a rate above 0, as 1e-5 or, to tune, 0.1."
        )
    return _analysed(linear_parts(loop, axis, member), smoothing)


@eqx.filter_jit
def _analysed(parts: LinearParts, smoothing: float) -> LoopAnalysis:
    if parts.member is not None or not parts.ensemble:
        return _one(parts, parts.member or (), smoothing)
    places = jnp.unravel_index(jnp.arange(int(np.prod(parts.ensemble))), parts.ensemble)
    flat = jax.vmap(lambda *place: _one(parts, place, smoothing))(*places)
    return jax.tree.map(lambda x: x.reshape(parts.ensemble + x.shape[1:]), flat)


def _one(parts: LinearParts, place: tuple, smoothing: float) -> LoopAnalysis:
    plant, controller = parts.of_member(place)
    loop, closed = join(plant, controller), close(plant, controller, parts.memory).balanced()
    smoothing = sharpest(smoothing, parts.dt, closed.matrix.dtype)
    ladder = powers(closed.matrix, parts.dt, smoothing)
    slowest = abscissa(closed.matrix, ladder, parts.dt, smoothing)
    rate = jax.lax.stop_gradient(slowest)
    stable = rate < 0
    shift = jnp.where(stable, 0.0, (rate + _STABLE) * parts.dt)
    noise = noise_gain(closed.matrix, closed.noise, closed.command, closed.through, ladder, shift)
    return LoopAnalysis(
        abscissa=slowest,
        stable=stable,
        noise_gain=jnp.where(stable, noise, jnp.inf),
        **loop_qualities(loop, stable),
        closed=closed,
        loop=loop,
        dt=parts.dt,
    )


def loop_qualities(loop: OpenLoop, stable: Bool[Array, ""]) -> dict[str, Array]:
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
