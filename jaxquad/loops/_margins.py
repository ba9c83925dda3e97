"""Margins of a loop, how it rejects disturbances, and whether it closes stably at all."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from ._curve import (
    ambiguous,
    Basis,
    between,
    count_unstable_poles,
    crossed,
    crossings,
    Curve,
    curve_of,
    decibels,
    degrees,
    evaluate_curve,
    Evaluated,
    lines,
    Numbers,
    only_finite,
    Response,
    shown,
)


_SLACK = 0.3  # of the slope at the lowest frequency, for a number of integrators
_TILT = jnp.pi / 3  # rad, of 1 + L at the lowest frequency from its limit at 0


def unstable_roots(
    omega: Float[Array, " frequencies"],
    loop: Complex[Array, " frequencies"],
    unstable_poles: Float[Array, ""],
) -> Float[Array, ""]:
    """Roots of 1 + L in the right half plane, `nan` where the frequencies do not tell.

    They tell if below the lowest the loop goes on as k / s^q, with a large magnitude if q > 0, and
    the highest is beyond the last crossover. The argument of 1 + L then grows by
    pi (P + q / 2 - Z) from 0 to infinity, with P `unstable_poles` of the loop and Z the answer.
    """
    values = 1 + loop
    argument = jnp.unwrap(jnp.angle(values))
    slope = jnp.log(jnp.abs(loop[1] / loop[0])) / jnp.log(omega[1] / omega[0])
    integrators = jnp.maximum(jnp.round(-slope), 0.0)
    is_power = (jnp.abs(slope + integrators) < _SLACK) | (slope > 0)
    is_large = (integrators == 0) | (jnp.abs(loop[0]) > 2)
    limit = jnp.exp(jax.lax.complex(jnp.zeros_like(slope), -integrators * jnp.pi / 2))
    tilt = jnp.angle(values[0] / limit)
    tilt = tilt - jnp.pi * jnp.round(tilt / jnp.pi)
    growth = argument[-1] - argument[0] + tilt - jnp.angle(values[-1])
    roots = jnp.round(unstable_poles + integrators / 2 - growth / jnp.pi)
    clear = ~jnp.any(ambiguous(argument)) & (jnp.abs(loop[-1]) < 1) & (jnp.abs(tilt) < _TILT)
    return jax.lax.stop_gradient(jnp.where(clear & is_large & is_power, roots, jnp.nan))


def remarks_on_roots(roots: float, unstable_poles: int) -> list[str]:
    if roots > 0:
        return [
            f"the closed loop is unstable: with {unstable_poles} unstable poles in the loop, "
            f"Nyquist counts {int(roots)} unstable roots; the numbers describe a loop "
            "that does not run, unless unstable_poles= or the sign of L is wrong"
        ]
    if roots < 0:
        return [
            f"the loop has {int(-roots)} more unstable poles than unstable_poles={unstable_poles}, "
            "or its sign is wrong"
        ]
    if roots != roots:
        return ["these frequencies do not tell whether the closed loop is stable: check it"]
    return []


_LIMIT = 16
_REAL = 1e-9  # imaginary over real part of a number that is real but for rounding
_ZERO = 1e-12  # rad, a phase margin that differs from 0 by rounding


class Margins(eqx.Module):
    """Stability margins of a loop L, closed as 1 + L = 0; `str()` says why one is missing (`nan`).

    A gain margin is the factor by which the loop's gain may change: `gain_margin` upwards,
    `gain_reduction` downwards, which only conditionally stable loops have. The lists hold every
    crossing, padded with `nan`; beyond 16, those nearest to -1.

    **Arguments:**

    - `phase_margin`, `delay_margin`: rad and s, the smallest (negative beyond -180 deg), at
        `crossover` and `delay_crossover`, rad/s.
    - `gain_margin`, `gain_reduction`: smallest factor above 1 and greatest below 1, at
        `phase_crossover` and `reduction_crossover`, rad/s.
    - `crossovers`: rad/s, where |L| = 1, with `phase_margins` (rad, -pi to pi) and
        `delay_margins` (s); `phase_crossovers`: rad/s, where L is real and negative, with
        `gain_margins`, 1 / |L|.
    - `unstable_roots`: of the closed loop, by Nyquist's count; nan if unknown.
    - `left_out`: crossings beyond 16 of a kind.
    - `standard_errors`: of a measured response, by the names above; else empty.
    - `basis`: what the numbers were found from; `unstable_poles`: of L.
    """

    phase_margin: Float[Array, ""]
    crossover: Float[Array, ""]
    delay_margin: Float[Array, ""]
    delay_crossover: Float[Array, ""]
    gain_margin: Float[Array, ""]
    phase_crossover: Float[Array, ""]
    gain_reduction: Float[Array, ""]
    reduction_crossover: Float[Array, ""]
    crossovers: Float[Array, " crossings"]
    phase_margins: Float[Array, " crossings"]
    delay_margins: Float[Array, " crossings"]
    phase_crossovers: Float[Array, " crossings"]
    gain_margins: Float[Array, " crossings"]
    unstable_roots: Float[Array, ""]
    left_out: Float[Array, ""]
    standard_errors: dict[str, Array]
    basis: Basis
    unstable_poles: int = eqx.field(static=True)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers."""
        roots = remarks_on_roots(float(self.unstable_roots), self.unstable_poles)
        missing, doubts, where = [], [], self.basis.where
        if not np.any(np.isfinite(self.crossovers)):
            missing.append(f"no phase or delay margin: |L| does not pass 1 {where}")
        if not np.any(np.isfinite(self.phase_crossovers)):
            missing.append(f"no gain margin: L does not cross -180 deg {where}")
        elif not np.isfinite(self.gain_margin):
            missing.append(f"no gain margin upwards: |L| is above 1 at every -180 deg {where}")
        if float(self.left_out) > 0:
            doubts.append(f"{int(self.left_out)} crossings farther from -1 are not listed")
        if np.isfinite(self.basis.unclear):
            doubts.append(
                f"from {float(self.basis.unclear):.4g} rad/s the loop turns by more than 115 deg "
                "between neighbours: crossings may be missed, give more frequencies there"
            )
        missing = missing if bool(self.basis.finite) else []
        return tuple(missing + roots + doubts + self.basis.remarks)

    def __str__(self) -> str:
        error = self.standard_errors.get
        named = (
            ("phase margin", "phase_margin", "crossover", degrees),
            ("delay margin", "delay_margin", "delay_crossover", lambda x, e: shown(x, e, "s")),
            ("gain margin", "gain_margin", "phase_crossover", decibels),
            ("gain reduction", "gain_reduction", "reduction_crossover", decibels),
        )
        rows = [
            (
                title,
                f"{text(vars(self)[name], error(name))} at "
                f"{shown(vars(self)[place], error(place), 'rad/s')}",
            )
            for title, name, place, text in named
            if np.isfinite(vars(self)[name])
        ]
        rows.append(("crossovers", _listed(self.crossovers)))
        rows.append(("crossings of -180 deg", _listed(self.phase_crossovers)))
        return "\n".join([f"margins, {self.basis.where}", lines(rows, [*self.remarks])])


def margins(
    loop: Response, *, omega: Float[ArrayLike, " frequencies"] | None = None,
    unstable_poles: int | None = None, output: str | int | None = None,
    input: str | int | None = None,
) -> Margins:  # fmt: skip
    """Gain, phase and delay margins of a loop's response L, with negative feedback.

    Margins are distances to -1 in gain, phase and delay, whatever the branch of the phase, and mean
    what their names say where the closed loop is stable, which is counted by Nyquist's criterion. A
    missing crossing gives `nan`, not infinity: it may lie beyond the frequencies given. Two
    crossings between the same neighbours of `omega` are not seen. A model without integrators and
    of negative static gain crosses -180 deg at frequency 0.

    **Arguments:**

    - `loop`: a `jq.spectra.FrequencyResponse`, whose numbers are interpolated (ln|T| and phase
        straight in ln omega) and carry standard errors, or any model with
        `frequency_response(omega)`, whose numbers are exact and differentiable, also under jit.
    - `omega`: rad/s. A model is searched there, by default at 2000 log-spaced values from 0.01 to
        1000; of a measured response it picks some of its own frequencies.
    - `unstable_poles`: how many the loop L has. By default those of a model of s, as
        `jq.TransferFunction` or `jq.StateSpace`, and none under jit and of other loops.
    - `output`, `input`: the channel, by name or number; None where there is one.

    **Returns:** `Margins`.

    **Raises:** ValueError for an unknown channel or grid.

    Source: Tischler & Remple, broken-loop responses; delay margin = phase margin / crossover.
    """
    curve = curve_of(loop, omega, output, input)
    unstable_poles = count_unstable_poles(loop, unstable_poles)
    poles = jnp.asarray(unstable_poles, curve.omega.dtype)
    numbers = evaluate_curve(_margins_of, curve, poles, places=_PLACES)
    return Margins(**numbers, unstable_poles=unstable_poles)


_PLACES = ("crossover", "phase_crossover", "reduction_crossover")


def _margins_of(curve: Curve, unstable_poles: Float[Array, ""]) -> Evaluated:
    values = jax.lax.stop_gradient(curve(curve.omega))
    level, angle = jnp.log(jnp.abs(values)), jnp.angle(-values)
    # Across the positive axis the angle of -L jumps by a turn.
    at_one, at_real = crossed(level, "both"), crossed(angle, "both")
    at_real &= jnp.abs(jnp.diff(angle)) < jnp.pi
    rank = [jnp.minimum(jnp.abs(x[:-1]), jnp.abs(x[1:])) for x in (angle, level)]
    numbers = _phase_margins(curve, at_one, rank[0]) | _gain_margins(curve, at_real, rank[1])
    left_out = [jnp.maximum(jnp.sum(where) - _LIMIT, 0) for where in (at_one, at_real)]
    counts = {
        "left_out": (left_out[0] + left_out[1]).astype(level.dtype),
        "unstable_roots": unstable_roots(curve.omega, values, unstable_poles),
    }
    finite = jnp.all(jnp.isfinite(values))
    phase = jax.lax.stop_gradient(curve.phase(None))
    # How a loop of small gain turns does not matter.
    heard = jnp.maximum(level[:-1], level[1:]) > np.log(0.1)
    return Evaluated(numbers, counts, finite, phase, heard)


def _phase_margins(curve: Curve, where: Array, rank: Array) -> Numbers:
    places = crossings(
        lambda w: jnp.log(jnp.abs(curve(w))), curve.omega, where, rank=rank, limit=_LIMIT
    )
    stand_in = jnp.where(jnp.isfinite(places), places, curve.omega[0])
    margin = jnp.where(jnp.isfinite(places), jnp.angle(-curve(stand_in)), jnp.nan)
    ahead = jnp.where(margin > -_ZERO, jnp.maximum(margin, 0.0), margin + 2 * jnp.pi)
    delay = ahead / places
    sizes = (jnp.where(jnp.isfinite(places), jnp.abs(x), jnp.inf) for x in (margin, delay))
    least, soonest = (jnp.argmin(size) for size in sizes)
    return {
        "phase_margin": margin[least],
        "crossover": places[least],
        "delay_margin": delay[soonest],
        "delay_crossover": places[soonest],
        "crossovers": places,
        "phase_margins": margin,
        "delay_margins": delay,
    }


def _gain_margins(curve: Curve, where: Array, rank: Array) -> Numbers:
    places = crossings(lambda w: jnp.angle(-curve(w)), curve.omega, where, rank=rank, limit=_LIMIT)
    stand_in = jnp.where(jnp.isfinite(places), places, curve.omega[0])
    margin = jnp.where(jnp.isfinite(places), 1 / jnp.abs(curve(stand_in)), jnp.nan)
    listed = places.size
    if curve.coherence is None:
        # The crossing of -180 deg at frequency 0 of a model of negative static gain.
        zero = jnp.zeros(1, curve.omega.dtype)
        gain = jax.lax.stop_gradient(curve(zero))[0]
        crosses = jnp.isfinite(gain) & (jnp.real(gain) < 0)
        crosses &= jnp.abs(jnp.imag(gain)) < _REAL * jnp.abs(jnp.real(gain))
        stand_in = jnp.where(crosses, zero, curve.omega[:1])
        static = jnp.where(crosses, 1 / jnp.abs(curve(stand_in)[0]), jnp.nan)
        place = jnp.where(crosses, zero[0], jnp.nan)
        places, margin = jnp.append(places, place), jnp.append(margin, static)
        rising = jnp.argsort(jax.lax.stop_gradient(places))  # nan is last
        places, margin = places[rising], margin[rising]
    up = jnp.argmin(jnp.where(margin >= 1, margin, jnp.inf))
    down = jnp.argmax(jnp.where(margin < 1, margin, 0.0))
    rises, falls = margin[up] >= 1, margin[down] < 1
    return {
        "gain_margin": jnp.where(rises, margin[up], jnp.nan),
        "phase_crossover": jnp.where(rises, places[up], jnp.nan),
        "gain_reduction": jnp.where(falls, margin[down], jnp.nan),
        "reduction_crossover": jnp.where(falls, places[down], jnp.nan),
        "phase_crossovers": places[:listed],
        "gain_margins": margin[:listed],
    }


def _listed(places: Float[Array, " crossings"]) -> str:
    numbers = np.asarray(places)[np.isfinite(np.asarray(places))]
    return ", ".join(f"{x:.4g}" for x in numbers) + " rad/s" if numbers.size else "none"


_LEVEL = np.log(10.0) * -3 / 20  # -3 dB in nepers
_REJECTION_PLACES = ("bandwidth", "peak_frequency", "complementary_peak_frequency")


class Rejection(eqx.Module):
    """How a loop rejects disturbances: S = 1 / (1 + L), and T = 1 - S.

    `str()` says why a number is missing (`nan`), and where a peak lies on the edge of the band.

    **Arguments:**

    - `bandwidth`: rad/s, DRB: where |S| first rises through -3 dB; `start`: |S| at the lowest
        frequency.
    - `peak`, `peak_frequency`: DRP or Ms, the greatest |S|, and where, rad/s.
    - `complementary_peak`, `complementary_peak_frequency`: Mt, the greatest |T|, and where, rad/s.
    - `rivals`: measured points within two standard errors of the peak of S.
    - `unstable_roots`: of the closed loop, by Nyquist's count; nan if unknown.
    - `standard_errors`: of a measured response, by the names above; else empty.
    - `basis`, `unstable_poles`, `quantity`: what the numbers were found from, of L, what the
        response is of.
    """

    bandwidth: Float[Array, ""]
    peak: Float[Array, ""]
    peak_frequency: Float[Array, ""]
    complementary_peak: Float[Array, ""]
    complementary_peak_frequency: Float[Array, ""]
    start: Float[Array, ""]
    rivals: Float[Array, ""]
    unstable_roots: Float[Array, ""]
    standard_errors: dict[str, Array]
    basis: Basis
    unstable_poles: int = eqx.field(static=True)
    quantity: str = eqx.field(static=True)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers."""
        roots = []
        if self.quantity == "loop":
            roots = remarks_on_roots(float(self.unstable_roots), self.unstable_poles)
        missing, doubts, ends = [], [], np.asarray(self.basis.band)
        if not np.isfinite(self.bandwidth) and bool(self.basis.finite):
            missing = [f"no DRB: |S| does not rise to -3 dB {self.basis.where}"]
            if float(np.log(self.start)) >= _LEVEL:
                start = decibels(self.start, None)
                missing = [f"no DRB: |S| starts at {start}, above -3 dB; give lower frequencies"]
        for title, name in (("S", "peak"), ("T", "complementary_peak")):
            if float(vars(self)[f"{name}_frequency"]) in ends:
                doubts.append(
                    f"the greatest |{title}| is on the edge of the band: no peak, or one beyond"
                )
        if float(self.rivals) > 0:
            doubts.append(
                f"{int(self.rivals)} more points lie within two standard errors of the peak of S: "
                "the greatest of them is high by chance"
            )
        return tuple(missing + roots + doubts + self.basis.remarks)

    def __str__(self) -> str:
        error = self.standard_errors.get
        rows = [("DRB", shown(self.bandwidth, error("bandwidth"), "rad/s"))]
        for title, name in (("DRP = Ms", "peak"), ("Mt", "complementary_peak")):
            place = float(vars(self)[f"{name}_frequency"])
            height = decibels(vars(self)[name], error(name))
            rows.append((title, f"{height} at {place:.4g} rad/s"))
        return "\n".join(
            [f"disturbance rejection, {self.basis.where}", lines(rows, [*self.remarks])]
        )


def disturbance_rejection(
    response: Response, *, quantity: str = "loop",
    omega: Float[ArrayLike, " frequencies"] | None = None, unstable_poles: int | None = None,
    output: str | int | None = None, input: str | int | None = None,
) -> Rejection:  # fmt: skip
    """Disturbance rejection bandwidth and peak, and the complementary peak, of a control loop.

    The peak of a measured response is its greatest value at a measured frequency: noise pushes it
    up. Whether the closed loop is stable is counted by Nyquist's criterion.

    **Arguments:**

    - `response`, `omega`, `unstable_poles`, `output`, `input`: as in `jq.loops.margins`.
    - `quantity`: what the response is, the "loop" L, with negative feedback, or the "sensitivity"
        S, from a disturbance at the output to the output.

    **Returns:** a `Rejection`.

    **Raises:** ValueError for an unknown quantity, channel or grid.

    Source: MIL-DTL-32742 / CONDUIT's DRB (-3 dB) and DRP.
    """
    if quantity not in ("loop", "sensitivity"):
        raise ValueError(f'quantity is {quantity!r}: choose "loop" or "sensitivity"')
    curve = curve_of(response, omega, output, input)
    if quantity == "loop":
        unstable_poles = count_unstable_poles(response, unstable_poles)
    unstable_poles = unstable_poles or 0
    poles = jnp.asarray(unstable_poles, curve.omega.dtype)
    numbers = evaluate_curve(_rejection_of, curve, quantity, poles, places=_REJECTION_PLACES)
    return Rejection(**numbers, unstable_poles=unstable_poles, quantity=quantity)


def _rejection_of(curve: Curve, quantity: str, unstable_poles: Float[Array, ""]) -> Evaluated:
    def sensitivity(omega):
        values = curve(omega)
        return 1 / (1 + values) if quantity == "loop" else values

    def complement(omega):
        values = curve(omega)
        return values / (1 + values) if quantity == "loop" else 1 - values

    level = jnp.log(jnp.abs(sensitivity(curve.omega)))
    rises = crossed(jax.lax.stop_gradient(level) - _LEVEL, "rising")
    deficit = lambda w: jnp.log(jnp.abs(sensitivity(w))) - _LEVEL
    bandwidth = crossings(deficit, curve.omega, rises)[0]
    (peak, at), (other, there) = (_peak(f, curve) for f in (sensitivity, complement))
    loop = jax.lax.stop_gradient(curve(curve.omega))
    unknown = jnp.asarray(jnp.nan, level.dtype)
    by_nyquist = unstable_roots(curve.omega, loop, unstable_poles)
    rivals = jnp.zeros((), level.dtype)
    if curve.coherence is not None:
        gain = jnp.abs(loop / (1 + loop)) if quantity == "loop" else jnp.ones_like(level)
        close = level + 2 * gain * curve.measured.random_error >= jnp.max(level)
        rivals = jax.lax.stop_gradient(jnp.sum(close).astype(level.dtype) - 1)
    numbers = {
        "bandwidth": bandwidth,
        "peak": peak,
        "complementary_peak": other,
        "start": jnp.exp(level[0]),
    }
    others = {
        "peak_frequency": at,
        "complementary_peak_frequency": there,
        "rivals": rivals,
        "unstable_roots": by_nyquist if quantity == "loop" else unknown,
    }
    finite = jnp.all(jnp.isfinite(loop)) & jnp.all(jnp.isfinite(level))
    phase = jax.lax.stop_gradient(curve.phase(None))
    return Evaluated(numbers, only_finite(others, finite), finite, phase)


def _peak(response: Callable, curve: Curve) -> tuple[Float[Array, ""], Float[Array, ""]]:
    def level(omega):
        return jnp.log(jnp.abs(response(omega)))

    def slope(omega):
        return jax.jvp(level, (omega,), (omega,))[1]

    grid = level(curve.omega)
    k, omega = jnp.argmax(grid), jax.lax.stop_gradient(curve.omega)
    if curve.coherence is not None:
        return jnp.exp(grid[k]), omega[k]
    last = omega.size - 1
    inside = (k > 0) & (k < last)
    ends = omega[jnp.maximum(k - 1, 0)], omega[jnp.minimum(k + 1, last)]
    place = between(slope, ends[0][None], ends[1][None])
    height, place = level(place)[0], place[0]
    # A peak that the grid does not resolve has more than one place of no slope.
    better = inside & (height >= grid[k] - 1e-12)
    return jnp.exp(jnp.where(better, height, grid[k])), jnp.where(better, place, omega[k])
