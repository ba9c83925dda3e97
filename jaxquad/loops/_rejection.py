"""How a loop rejects disturbances, and the root mean square of a response."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import is_concrete

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
    def modulus_margin(self) -> Float[Array, ""]:
        """Least distance of L from -1."""
        return 1 / self.peak

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


_SIDES = {"one": 1.0, "two": 2.0}  # multiples of the spectrum that the positive frequencies hold
_ORDERS = (8, 5)  # of Gauss' rule in each interval, and of the one that checks it


class RmsResponse(eqx.Module):
    """Root mean square of a response within a band, in the unit of the output.

    **Arguments:**

    - `rms`: root mean square, in the unit of the output.
    - `edges`: shares of the power from the lowest and the highest octave.
    - `integration_error`: of a model's rms, relative.
    - `incoherent`: share of the power from a measured coherence below 0.6.
    - `standard_errors`: of a measured response; else empty.
    - `basis`: what the numbers were found from.
    """

    rms: Float[Array, ""]
    edges: Float[Array, "2"]
    integration_error: Float[Array, ""]
    incoherent: Float[Array, ""]
    standard_errors: dict[str, Array]
    basis: Basis

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader has to know before using the number."""
        remarks = [
            f"{100 * share:.2g} % of the power comes from the {end} octave: more may lie beyond"
            for end, share in zip(("lowest", "highest"), np.asarray(self.edges), strict=True)
            if share > 0.01
        ]
        if float(self.integration_error) > 1e-3:
            remarks.append(
                f"the integral is good to {100 * float(self.integration_error):.2g} % only: give "
                "more frequencies around the peaks"
            )
        if float(self.incoherent) > 0.05:
            remarks.append(
                f"{100 * float(self.incoherent):.2g} % of the power comes from frequencies with a "
                "coherence below 0.6: unreliable"
            )
        return tuple(remarks + self.basis.remarks)

    def __str__(self) -> str:
        rows = [("rms", shown(self.rms, self.standard_errors.get("rms"), "output units").strip())]
        return "\n".join([f"rms response, {self.basis.where}", lines(rows, [*self.remarks])])


def rms_response(
    response: Response,
    spectrum: Callable | Float[ArrayLike, " frequencies"] | Float[ArrayLike, ""], *,
    sides: str = "one", omega: Float[ArrayLike, " frequencies"] | None = None,
    output: str | int | None = None, input: str | int | None = None,
) -> RmsResponse:  # fmt: skip
    """Root mean square of the output for an input of known spectrum, within the frequencies given.

    A model is integrated by Gauss' rule in ln omega between the neighbours of `omega`. A measured
    response is a power law between its frequencies, and the part that its random error adds to
    |T|^2 is taken out. Nothing outside the band is counted, see `edges`. An unstable model has no
    rms, which cannot be seen here.

    **Arguments:**

    - `response`, `omega`, `output`, `input`: as in `jq.loops.margins`.
    - `spectrum`: the input's power spectral density per Hz: a function of omega in rad/s, values on
        the grid, or one value for white noise.
    - `sides`: "one" takes it as one-sided, as `jq.spectra.spectral_density` gives it: rms^2 is the
        integral of |T|^2 S domega / (2 pi) over the positive frequencies. "two" doubles rms^2;
        white noise of two-sided density 1 gives the H2 norm of a stable model.

    **Returns:** an `RmsResponse`.

    **Raises:** ValueError for a spectrum of another length or below 0, and an unknown channel or
    grid.

    Source: Wiener-Khinchin; Tischler & Remple, spectral analysis.
    """
    if sides not in _SIDES:
        raise ValueError(f'sides is {sides!r}: choose "one" or "two"')
    curve = curve_of(response, omega, output, input)
    if not callable(spectrum):
        values = jnp.asarray(spectrum, curve.omega.dtype)
        spectrum = jnp.full_like(curve.omega, 1.0) * values if values.ndim == 0 else values
        if spectrum.shape != curve.omega.shape:
            raise ValueError(
                f"the spectrum has the shape {spectrum.shape} for {curve.omega.size} frequencies: "
                "give one value for each, one for all, or a function of omega"
            )
        if is_concrete(spectrum) and not np.all(np.asarray(spectrum) >= 0):
            least = np.min(np.asarray(spectrum))
            raise ValueError(f"the spectrum goes down to {least:.4g}: a power is 0 or more")
    return RmsResponse(**evaluate_curve(_numbers, curve, spectrum, _SIDES[sides]))


def _numbers(
    curve: Curve, spectrum: Callable | Float[Array, " frequencies"], sides: float
) -> Evaluated:
    if curve.coherence is None:
        powers, rough = (_gauss(curve, spectrum, order) for order in _ORDERS)
        total = jnp.sum(powers)
        doubt = jnp.abs(jnp.sum(rough) / jnp.where(total > 0, total, 1.0) - 1) / 2
    else:
        density = spectrum(curve.omega) if callable(spectrum) else spectrum
        power = jnp.abs(curve(curve.omega)) ** 2 / (1 + 2 * curve.measured.random_error**2)
        y, x = power * density * curve.omega, jnp.log(curve.omega)
        powers = _logarithmic_mean(y[:-1], y[1:]) * jnp.diff(x)
        doubt = jnp.zeros((), x.dtype)
    powers = powers * sides / (2 * jnp.pi)
    total = jnp.sum(powers)
    share = powers / jnp.where(total > 0, total, 1.0)
    low, high = curve.omega[:-1] < 2 * curve.omega[0], curve.omega[1:] > curve.omega[-1] / 2
    edges = [jnp.sum(jnp.where(end, share, 0.0)) for end in (low, high)]
    incoherent = jnp.zeros_like(total)
    if curve.coherence is not None:
        poor = jnp.minimum(curve.coherence[:-1], curve.coherence[1:]) < 0.6
        incoherent = jnp.sum(jnp.where(poor, share, 0.0))
    others = {
        "edges": jnp.stack(edges),
        "integration_error": doubt,
        "incoherent": incoherent,
    }
    finite = (
        jnp.all(powers >= 0)
        & jnp.all(jnp.isfinite(powers))
        & jnp.all(jnp.isfinite(curve(curve.omega)))
    )
    phase = jax.lax.stop_gradient(curve.phase(None))
    return Evaluated({"rms": jnp.sqrt(total)}, only_finite(others, finite), finite, phase)


def _gauss(
    curve: Curve, spectrum: Callable | Float[Array, " frequencies"], order: int
) -> Float[Array, " intervals"]:
    """|T|^2 times the spectrum, integrated over each interval by Gauss' rule in ln(omega).

    Between its values a spectrum is straight in logarithms, and straight where an end is 0.
    """
    grid = curve.omega
    nodes, weights = (jnp.asarray(x, grid.dtype) for x in np.polynomial.legendre.leggauss(order))
    low, width = jnp.log(grid)[:-1, None], jnp.diff(jnp.log(grid))[:, None]
    part = jnp.broadcast_to(((nodes + 1) / 2)[None], (grid.size - 1, order))
    omega, weights = jnp.exp(low + width * part), width * (weights / 2)[None]
    if callable(spectrum):
        density = spectrum(omega.reshape(-1)).reshape(omega.shape)
    else:
        ends = spectrum[:-1, None], spectrum[1:, None]
        positive = (ends[0] > 0) & (ends[1] > 0)
        a, b = (jnp.where(positive, x, 1.0) for x in ends)
        curved = jnp.exp((1 - part) * jnp.log(a) + part * jnp.log(b))
        density = jnp.where(positive, curved, (1 - part) * ends[0] + part * ends[1])
    power = jnp.abs(curve(omega.reshape(-1)).reshape(omega.shape)) ** 2
    return jnp.sum(power * density * omega * weights, axis=1)


def _logarithmic_mean(
    low: Float[Array, " intervals"], high: Float[Array, " intervals"]
) -> Float[Array, " intervals"]:
    """The mean of an exponential between its ends; half the sum where an end is 0."""
    positive = (low > 0) & (high > 0)
    a, b = (jnp.where(positive, x, 1.0) for x in (low, high))
    growth = jnp.log(b / a)
    flat = jnp.abs(growth) < 1e-4
    safe = jnp.where(flat, 1.0, growth)
    mean = a * jnp.where(flat, 1 + growth / 2 + growth**2 / 6, jnp.expm1(safe) / safe)
    return jnp.where(positive, mean, (low + high) / 2)
