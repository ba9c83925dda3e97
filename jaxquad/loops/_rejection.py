"""How a loop rejects disturbances."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ._curve import (
    Basis,
    between,
    count_unstable_poles,
    crossed,
    Curve,
    curve_of,
    decibels,
    evaluate_curve,
    Evaluated,
    first,
    lines,
    only_finite,
    Response,
    shown,
)
from ._margins import remarks_on_roots, unstable_roots


_LEVEL = np.log(10.0) * -3 / 20  # -3 dB in nepers
_PLACES = ("bandwidth", "peak_frequency", "complementary_peak_frequency")


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
    numbers = evaluate_curve(_rejection_of, curve, quantity, poles, places=_PLACES)
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
    bandwidth = first(lambda w: jnp.log(jnp.abs(sensitivity(w))) - _LEVEL, curve.omega, rises)
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
