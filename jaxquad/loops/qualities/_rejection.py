from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from ._basis import (
    Basis,
    basis_of,
    decibels,
    evaluate_curve,
    lines,
    Numbers,
    only_finite,
    shown,
    with_coherence,
)
from ._curve import between, count_unstable_poles, crossed, Curve, curve_of, first, Response
from ._margins import remarks_on_roots, unstable_roots


_LEVEL = np.log(10.0) * -3 / 20  # -3 dB in nepers
_PLACES = ("bandwidth", "peak_frequency", "complementary_peak_frequency")


class Rejection(eqx.Module):
    """How a loop rejects disturbances: S = 1 / (1 + L), and T = 1 - S.

    `str()` says why a number is missing (`nan`), and where a peak lies on the edge of the band.

    **Arguments:**

    - `bandwidth`: rad/s, DRB: where |S| first rises through -3 dB.
    - `peak`: DRP or Ms: greatest |S|.
    - `peak_frequency`: rad/s, of that peak.
    - `complementary_peak`: Mt: greatest |T|.
    - `complementary_peak_frequency`: rad/s, of that peak.
    - `start`: |S| at the lowest frequency.
    - `rivals`: measured points within two standard errors of the peak of S.
    - `unstable_roots`: of the closed loop, by Nyquist's count; nan if unknown.
    - `standard_errors`: of a measured response, by the names above; else empty.
    - `basis`: what the numbers were found from.
    - `unstable_poles`: of L.
    - `quantity`: what the response is of.
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
    def modulus_margin(self) -> Float[Array, ""]:
        """Least distance of L from -1."""
        return 1 / self.peak

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader has to know before using the numbers."""
        roots = []
        if self.quantity == "loop":
            roots = remarks_on_roots(float(self.unstable_roots), self.unstable_poles)
        return tuple(_missing(self) + roots + _edges(self) + self.basis.remarks)

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
    response: Response,
    *,
    quantity: str = "loop",
    omega: Float[ArrayLike, " frequencies"] | None = None,
    unstable_poles: int | None = None,
    output: str | int | None = None,
    input: str | int | None = None,
) -> Rejection:
    """Disturbance rejection bandwidth and peak, and the complementary peak, of a control loop.

    The peak of a measured response is its greatest value at a measured frequency: noise pushes it
    up. Whether the closed loop is stable is counted by Nyquist's criterion.

    **Arguments:**

    - `response`: a `jq.spectra.FrequencyResponse`, whose numbers are interpolated (ln|T| and phase
        straight in ln omega) and carry standard errors, or any model with
        `frequency_response(omega)`, whose numbers are exact and differentiable, also under jit.
    - `quantity`: what the response is, the "loop" L, with negative feedback, or the "sensitivity"
        S, from a disturbance at the output to the output.
    - `omega`: rad/s. A model is searched there, by default at 2000 log-spaced values from 0.01 to
        1000; of a measured response it picks some of its own frequencies.
    - `unstable_poles`: how many the loop L has. By default those of a model of s, as
        `jq.TransferFunction` or `jq.StateSpace`, and none under jit and of other loops.
    - `output`, `input`: the channel, by name or number; None where there is one.

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
    values, basis, errors = evaluate_curve(_numbers, curve, quantity, poles)
    basis = with_coherence(basis, curve, {name: values[name] for name in _PLACES})
    return Rejection(
        **values,
        standard_errors=errors,
        basis=basis,
        unstable_poles=unstable_poles,
        quantity=quantity,
    )


def _numbers(
    curve: Curve, quantity: str, unstable_poles: Float[Array, ""]
) -> tuple[Numbers, Numbers, Basis]:
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
    numbers = {
        "bandwidth": bandwidth,
        "peak": peak,
        "complementary_peak": other,
        "start": jnp.exp(level[0]),
    }
    others = {
        "peak_frequency": at,
        "complementary_peak_frequency": there,
        "rivals": _rivals(curve, level, loop, quantity),
        "unstable_roots": by_nyquist if quantity == "loop" else unknown,
    }
    finite = jnp.all(jnp.isfinite(loop)) & jnp.all(jnp.isfinite(level))
    phase = jax.lax.stop_gradient(curve.phase(None))
    others = only_finite(others, finite)
    return only_finite(numbers, finite), others, basis_of(curve, phase, finite)


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
    place = between(slope, omega[jnp.maximum(k - 1, 0)], omega[jnp.minimum(k + 1, last)])
    height = level(place[None])[0]
    # A peak that the grid does not resolve has more than one place of no slope.
    better = inside & (height >= grid[k] - 1e-12)
    return jnp.exp(jnp.where(better, height, grid[k])), jnp.where(better, place, omega[k])


def _rivals(curve: Curve, level: Array, loop: Array, quantity: str) -> Float[Array, ""]:
    if curve.coherence is None:
        return jnp.zeros((), level.dtype)
    gain = jnp.abs(loop / (1 + loop)) if quantity == "loop" else jnp.ones_like(level)
    doubt = 2 * gain * curve.measured.random_error
    close = level + doubt >= jnp.max(level)
    return jax.lax.stop_gradient(jnp.sum(close).astype(level.dtype) - 1)


def _missing(result: Rejection) -> list[str]:
    if np.isfinite(result.bandwidth) or not bool(result.basis.finite):
        return []
    start = decibels(result.start, None)
    if float(np.log(result.start)) >= _LEVEL:
        return [f"no DRB: |S| starts at {start}, above -3 dB; give lower frequencies"]
    return [f"no DRB: |S| does not rise to -3 dB {result.basis.where}"]


def _edges(result: Rejection) -> list[str]:
    remarks, ends = [], np.asarray(result.basis.band)
    for title, name in (("S", "peak"), ("T", "complementary_peak")):
        if float(vars(result)[f"{name}_frequency"]) in ends:
            remarks.append(
                f"the greatest |{title}| is on the edge of the band: no peak, or one beyond"
            )
    if float(result.rivals) > 0:
        remarks.append(
            f"{int(result.rivals)} more points lie within two standard errors of the peak of S: "
            "the greatest of them is high by chance"
        )
    return remarks
