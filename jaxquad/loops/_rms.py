from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from jaxquad._core import is_concrete

from ._curve import (
    Basis,
    basis_of,
    Curve,
    curve_of,
    evaluate_curve,
    lines,
    Numbers,
    only_finite,
    Response,
    shown,
)


def nodes_between(
    omega: Float[Array, " frequencies"], order: int
) -> tuple[
    Float[Array, "intervals nodes"],
    Float[Array, "intervals nodes"],
    Float[Array, "intervals nodes"],
]:
    """Frequencies, places from 0 to 1, and weights in ln(omega) of Gauss' rule in each interval."""
    nodes, weights = (jnp.asarray(x, omega.dtype) for x in np.polynomial.legendre.leggauss(order))
    low, width = jnp.log(omega)[:-1, None], jnp.diff(jnp.log(omega))[:, None]
    part = jnp.broadcast_to(((nodes + 1) / 2)[None], (omega.size - 1, order))
    return jnp.exp(low + width * part), part, width * (weights / 2)[None]


def power_law(
    low: Float[Array, "intervals 1"],
    high: Float[Array, "intervals 1"],
    part: Float[Array, "intervals nodes"],
) -> Float[Array, "intervals nodes"]:
    """Values between two ends, straight in logarithms; straight where an end is 0."""
    positive = (low > 0) & (high > 0)
    a, b = (jnp.where(positive, x, 1.0) for x in (low, high))
    return jnp.where(
        positive,
        jnp.exp((1 - part) * jnp.log(a) + part * jnp.log(b)),
        (1 - part) * low + part * high,
    )


def logarithmic_mean(
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
    spectrum: Callable | Float[ArrayLike, " frequencies"] | Float[ArrayLike, ""],
    *,
    sides: str = "one",
    omega: Float[ArrayLike, " frequencies"] | None = None,
    output: str | int | None = None,
    input: str | int | None = None,
) -> RmsResponse:
    """Root mean square of the output for an input of known spectrum, within the frequencies given.

    A model is integrated by Gauss' rule in ln omega between the neighbours of `omega`. A measured
    response is a power law between its frequencies, and the part that its random error adds to
    |T|^2 is taken out. Nothing outside the band is counted, see `edges`. An unstable model has no
    rms, which cannot be seen here.

    **Arguments:**

    - `response`: a `jq.spectra.FrequencyResponse`, whose numbers are interpolated (ln|T| and phase
        straight in ln omega) and carry standard errors, or any model with
        `frequency_response(omega)`, whose numbers are exact and differentiable, also under jit.
    - `spectrum`: the input's power spectral density per Hz: a function of omega in rad/s, values on
        the grid, or one value for white noise.
    - `sides`: "one" takes it as one-sided, as `jq.spectra.spectral_density` gives it: rms^2 is the
        integral of |T|^2 S domega / (2 pi) over the positive frequencies. "two" doubles rms^2;
        white noise of two-sided density 1 gives the H2 norm of a stable model.
    - `omega`: rad/s. A model is searched there, by default at 2000 log-spaced values from 0.01 to
        1000; of a measured response it picks some of its own frequencies.
    - `output`, `input`: the channel, by name or number; None where there is one.

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
    values, basis, errors = evaluate_curve(_numbers, curve, spectrum, _SIDES[sides])
    return RmsResponse(**values, standard_errors=errors, basis=basis)


def _numbers(
    curve: Curve, spectrum: Callable | Float[Array, " frequencies"], sides: float
) -> tuple[Numbers, Numbers, Basis]:
    if curve.coherence is None:
        powers, rough = (_gauss(curve, spectrum, order) for order in _ORDERS)
        total = jnp.sum(powers)
        doubt = jnp.abs(jnp.sum(rough) / jnp.where(total > 0, total, 1.0) - 1) / 2
    else:
        density = spectrum(curve.omega) if callable(spectrum) else spectrum
        power = jnp.abs(curve(curve.omega)) ** 2 / (1 + 2 * curve.measured.random_error**2)
        y, x = power * density * curve.omega, jnp.log(curve.omega)
        powers = logarithmic_mean(y[:-1], y[1:]) * jnp.diff(x)
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
    numbers = only_finite({"rms": jnp.sqrt(total)}, finite)
    phase = jax.lax.stop_gradient(curve.phase(None))
    return numbers, only_finite(others, finite), basis_of(curve, phase, finite)


def _gauss(
    curve: Curve, spectrum: Callable | Float[Array, " frequencies"], order: int
) -> Float[Array, " intervals"]:
    """|T|^2 times the spectrum, integrated over each interval."""
    omega, part, weights = nodes_between(curve.omega, order)
    if callable(spectrum):
        density = spectrum(omega.reshape(-1)).reshape(omega.shape)
    else:
        density = power_law(spectrum[:-1, None], spectrum[1:, None], part)
    power = jnp.abs(curve(omega.reshape(-1)).reshape(omega.shape)) ** 2
    return jnp.sum(power * density * omega * weights, axis=1)
