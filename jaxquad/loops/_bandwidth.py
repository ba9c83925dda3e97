import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ._curve import (
    ambiguous,
    Basis,
    crossed,
    crossings,
    Curve,
    curve_of,
    degrees,
    evaluate_curve,
    Evaluated,
    lines,
    Numbers,
    Response,
    shown,
)


def missing_bandwidth(result: "Bandwidth") -> list[str]:
    """Why each number that is `nan` does not exist."""
    basis = result.basis
    reasons: list[str] = []
    for name, angle in (("phase_bandwidth", -135), ("omega_180", -180)):
        if not np.isfinite(vars(result)[name]) and bool(basis.finite):
            below = np.degrees(float(basis.start_phase)) <= angle
            how = (
                f"starts at {degrees(basis.start_phase, None)} already,"
                if below
                else f"does not fall to {angle} deg"
            )
            reasons.append(f"no {name}: the phase {how} {_reach(basis)}")
    if np.isfinite(result.omega_180) and not np.isfinite(result.gain_bandwidth):
        reasons.append("no gain_bandwidth: below w180 the magnitude is never 6 dB above that there")
    elif not np.isfinite(result.gain_bandwidth) and np.isfinite(result.phase_bandwidth):
        reasons.append("without w180 the bandwidth is at most the phase bandwidth")
    if np.isfinite(result.omega_180):
        top = float(2 * result.omega_180)
        if not np.isfinite(result.phase_delay):
            reasons.append(f"no phase_delay: 2 w180 is {top:.4g} rad/s, not {_reach(basis)}")
        elif not np.isfinite(result.phase_delay_fit):
            reasons.append("no phase_delay_fit: fewer than 3 frequencies from w180 to 2 w180")
    return reasons


def _reach(basis: Basis) -> str:
    unclear = float(basis.unclear)
    if np.isinf(unclear):
        return basis.where
    return (
        f"below {unclear:.4g} rad/s, from where it turns by more than 115 deg between neighbours: "
        "give more frequencies there, or choose others with omega="
    )


def doubtful_bandwidth(result: "Bandwidth") -> list[str]:
    """What may be wrong with the numbers that exist."""
    doubts, start = [], float(result.basis.start_phase)
    input_at = start + (np.pi / 2 if result.quantity == "rate" else 0.0)
    if result.branch != "as given" and (abs(input_at) > np.radians(150) or start > np.radians(90)):
        doubts.append(
            f"the phase starts at {np.degrees(start):.4g} deg: if that is wrong by 360 deg, give "
            "the true one as phase_at_start=; if the input has the opposite sign, reverse it"
        )
    if float(result.phase_crossings) > 1:
        doubts.append(
            f"the phase passes -135 or -180 deg {int(result.phase_crossings)} times: the lowest "
            "crossing counts"
        )
    if float(result.gain_crossings) > 1:
        doubts.append(
            f"the magnitude falls through the 6 dB level {int(result.gain_crossings)} times below "
            "w180: the gain bandwidth is the nearest, others are lower"
        )
    if bool(result.gain_bandwidth < result.phase_bandwidth):
        doubts.append(
            "gain-limited: ADS-33 warns of pilot-induced oscillation with attitude command"
        )
    distance = abs(float(result.gain_bandwidth) - float(result.phase_bandwidth))
    errors = result.standard_errors
    if distance < errors.get("gain_bandwidth", 0.0) + errors.get("phase_bandwidth", 0.0):
        doubts.append(
            "phase and gain bandwidth agree within their errors: the lesser is biased low"
        )
    return doubts


_POINTS = 64  # of a model, even in frequency from w180 to 2 w180


def _phase_delays(
    curve: Curve, phase: Float[Array, " frequencies"], w180: Float[Array, ""], top: Float[Array, ""]
) -> Numbers:
    """Phase delays in s, `nan` past `top`: the phase lost from w180 to 2 w180, over 2 w180; and
    half the slope of the straight line through the phase between them.

    There a measured phase counts at its own frequencies with the coherence weight of Tischler &
    Remple, eq. (11.4); a model's at 64 even ones.
    """
    exists = 2 * w180 <= top
    start = jnp.where(exists, w180, curve.omega[0])
    ends = _phase_at(curve, phase, jnp.stack([start, 2 * start]))
    if curve.coherence is None:
        points = start * jnp.linspace(1, 2, _POINTS, dtype=start.dtype)
        weights = jnp.ones_like(points)
    else:
        points = curve.omega
        inside = (points >= start) & (points <= 2 * start)
        weights = jnp.where(inside, (1.58 * (1 - jnp.exp(-curve.coherence))) ** 2, 0.0)
    x, y = points / start, _phase_at(curve, phase, points)
    total = jnp.maximum(jnp.sum(weights), jnp.finfo(x.dtype).tiny)
    centred = x - jnp.sum(weights * x) / total
    spread = jnp.sum(weights * centred**2)
    slope = jnp.sum(weights * centred * y) / jnp.where(spread > 0, spread, 1.0)
    fits = exists & (jnp.sum(weights > 0) >= 3)
    return {
        "phase_delay": jnp.where(exists, (ends[0] - ends[1]) / (2 * start), jnp.nan),
        "phase_delay_fit": jnp.where(fits, -slope / (2 * start), jnp.nan),
    }


def _phase_at(
    curve: Curve, phase: Float[Array, " frequencies"], omega: Float[Array, " points"]
) -> Float[Array, " points"]:
    """Unwrapped phase at `omega`, on the branch that `phase` has on the grid."""
    branch = jnp.interp(jnp.log(omega), jnp.log(curve.omega), phase)
    branch = jax.lax.stop_gradient(branch)
    turned = curve(omega) * jnp.exp(jax.lax.complex(jnp.zeros_like(branch), -branch))
    return branch + jnp.angle(turned)


_PHASE_MARGIN = np.pi / 4
_GAIN_MARGIN = 10 ** (6 / 20)
_PLACES = ("phase_bandwidth", "gain_bandwidth", "omega_180")


class Bandwidth(eqx.Module):
    """Attitude bandwidth and phase delay of ADS-33; `str()` says why a number is missing (`nan`).

    `bandwidth` is the lesser of the phase and the gain bandwidth, as for rate command; for
    attitude command with attitude hold, ADS-33 takes the phase bandwidth alone.

    **Arguments:**

    - `bandwidth`: rad/s; `phase_bandwidth`, `omega_180`: rad/s, where the phase falls through -135
        and -180 deg; `gain_bandwidth`: rad/s, where the magnitude is 6 dB above that at w180.
    - `phase_delay`: s, from the phase at w180 and at 2 w180; `phase_delay_fit`: s, from a straight
        line through the phase between them.
    - `gain_crossings`, `phase_crossings`: how often the magnitude falls through that level below
        w180, and the phase passes -135 or -180 deg.
    - `standard_errors`: of a measured response, by the names above; else empty.
    - `basis`, `quantity`, `branch`: what the numbers were found from, what the response is of, and
        who chose the branch of the phase at the lowest frequency.
    """

    bandwidth: Float[Array, ""]
    phase_bandwidth: Float[Array, ""]
    gain_bandwidth: Float[Array, ""]
    omega_180: Float[Array, ""]
    phase_delay: Float[Array, ""]
    phase_delay_fit: Float[Array, ""]
    gain_crossings: Float[Array, ""]
    phase_crossings: Float[Array, ""]
    standard_errors: dict[str, Array]
    basis: Basis
    quantity: str = eqx.field(static=True)
    branch: str = eqx.field(static=True)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers."""
        return tuple(missing_bandwidth(self) + doubtful_bandwidth(self) + self.basis.remarks)

    def __str__(self) -> str:
        names = ("bandwidth", *_PLACES, "phase_delay", "phase_delay_fit")
        units = ["rad/s"] * 4 + ["s"] * 2
        rows = [
            (name, shown(vars(self)[name], self.standard_errors.get(name), unit))
            for name, unit in zip(names, units, strict=True)
        ]
        phase = f"{degrees(self.basis.start_phase, None)} ({self.branch})"
        rows.append(("phase at the lowest frequency", phase))
        return "\n".join([f"attitude bandwidth, {self.basis.where}", lines(rows, [*self.remarks])])


def attitude_bandwidth(
    response: Response, *, quantity: str = "attitude",
    omega: Float[ArrayLike, " frequencies"] | None = None,
    phase_at_start: Float[ArrayLike, ""] | None = None, output: str | int | None = None,
    input: str | int | None = None,
) -> Bandwidth:  # fmt: skip
    """Bandwidth, phase delay and w180 of an attitude's response to the pilot's or tester's input.

    The phase is unwrapped upwards from the lowest frequency. The lowest crossings downwards count;
    for the gain bandwidth the nearest below w180. Nothing is found where the phase turns by more
    than 115 deg between neighbours. Standard errors are first-order, from the covariance of the
    measured errors.

    **Arguments:**

    - `response`, `omega`, `output`, `input`: as in `jq.loops.margins`.
    - `quantity`: what it is the response of, the "attitude" or the "rate", which is divided by s.
    - `phase_at_start`: rad, of the response as given: the phase at the lowest frequency is the one
        nearest to it. Give it where the response starts near -180 deg or behind a delay; None is
        the principal value.

    **Returns:** a `Bandwidth`.

    **Raises:** ValueError for an unknown quantity, channel or grid.

    Source: ADS-33E-PRF fig. 2; Tischler & Remple, handling-qualities chapter.
    """
    if quantity not in ("attitude", "rate"):
        raise ValueError(f'quantity is {quantity!r}: choose "attitude" or "rate"')
    curve = curve_of(response, omega, output, input, int(quantity == "rate"))
    start = None if phase_at_start is None else jnp.asarray(phase_at_start, curve.omega.dtype)
    numbers = evaluate_curve(_numbers, curve, start, places=_PLACES)
    branch = "principal value" if start is None else "as given"
    return Bandwidth(**numbers, quantity=quantity, branch=branch)


def _numbers(curve: Curve, start: Float[Array, ""] | None) -> Evaluated:
    values = jax.lax.stop_gradient(curve(curve.omega))
    phase = jax.lax.stop_gradient(curve.phase(start))
    clear = jnp.cumsum(ambiguous(phase)) == 0
    by_phase = _falls_through(curve, phase, clear, _PHASE_MARGIN - jnp.pi)
    w180 = _falls_through(curve, phase, clear, -jnp.pi)
    by_gain, crossings = _gain_bandwidth(curve, values, w180)
    # Up to the top the phase's branch is certain: all is clear from the lowest frequency on.
    top = jnp.where(jnp.all(clear), curve.omega[-1], curve.omega[jnp.argmin(clear)])
    targets = (-jnp.pi, _PHASE_MARGIN - jnp.pi)
    passes = [jnp.sum(crossed(phase - target, "both") & clear) for target in targets]
    numbers = {
        "bandwidth": jnp.minimum(by_phase, by_gain),
        "phase_bandwidth": by_phase,
        "gain_bandwidth": by_gain,
        "omega_180": w180,
    } | _phase_delays(curve, phase, w180, top)
    counts = {
        "gain_crossings": crossings,
        "phase_crossings": jnp.maximum(*passes).astype(w180.dtype),
    }
    finite = jnp.all(jnp.isfinite(values))
    return Evaluated(numbers, counts, finite, phase)


def _falls_through(
    curve: Curve, phase: Float[Array, " frequencies"], clear: Array, target: float
) -> Float[Array, ""]:
    turn = complex(np.exp(-1j * target))

    def beyond(omega):
        return jnp.angle(curve(omega) * turn)

    return crossings(beyond, curve.omega, crossed(phase - target, "falling") & clear)[0]


def _gain_bandwidth(
    curve: Curve, values: Array, w180: Float[Array, ""]
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    exists = jnp.isfinite(w180)
    # Derivatives of what does not exist must not reach what does: hence a finite stand-in.
    place = jnp.where(exists, w180, curve.omega[-1])
    level = jnp.log(jnp.abs(curve(place[None])))[0] + np.log(_GAIN_MARGIN)

    def excess(omega):
        return jnp.log(jnp.abs(curve(omega))) - level

    grid = jnp.log(jnp.abs(values)) - jax.lax.stop_gradient(level)
    where = crossed(grid, "falling") & (curve.omega[:-1] < place) & exists
    nearest = -jnp.arange(where.size, dtype=place.dtype)
    bandwidth = crossings(excess, curve.omega, where, rank=nearest)[0]
    return bandwidth, jnp.sum(where).astype(place.dtype)
