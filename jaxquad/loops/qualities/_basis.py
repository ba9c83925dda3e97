"""What the numbers of a response were found from, and how they are printed."""

from collections.abc import Callable, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxquad._core import is_concrete

from ._curve import ambiguous, around, Curve


Numbers = dict[str, Array]
Argument = Array | str | float | Callable | None


class Basis(eqx.Module):
    """What the numbers were found from; `remarks` and `str` of a result speak of it."""

    band: Float[Array, "2"]  # rad/s, lowest and highest frequency searched
    start_phase: Float[Array, ""]  # rad, at the lowest frequency
    unclear: Float[Array, ""]  # rad/s, from which the phase is ambiguous; inf if nowhere
    finite: Bool[Array, ""]
    coherence: dict[str, float]  # measured, beside each frequency found
    dropped: int = eqx.field(static=True, default=0)

    @property
    def where(self) -> str:
        """The band in words."""
        return f"within {float(self.band[0]):.4g}..{float(self.band[1]):.4g} rad/s"

    @property
    def remarks(self) -> list[str]:
        """What concerns every number of the result."""
        remarks = []
        if not bool(self.finite):
            remarks.append("the response is not finite at some frequency: no number is given")
        if self.dropped:
            remarks.append(f"{self.dropped} measured frequencies without a number are left out")
        for name, value in self.coherence.items():
            if value < 0.6:
                remarks.append(f"the coherence at the {name} is {value:.2f}, below 0.6: unreliable")
        return remarks


def basis_of(
    curve: Curve,
    phase: Float[Array, " frequencies"],
    finite: Bool[Array, ""],
    heeded: Bool[Array, " intervals"] | bool = True,
) -> Basis:
    """The basis of what was found on a curve with this unwrapped phase, where it is `heeded`."""
    jumps = ambiguous(phase) & heeded
    unclear = jnp.where(jnp.any(jumps), curve.omega[jnp.argmax(jumps)], jnp.inf)
    band = jnp.stack([curve.omega[0], curve.omega[-1]])
    return Basis(band, phase[0], unclear, finite, {}, curve.dropped)


def evaluate_curve(
    numbers: Callable[..., tuple[Numbers, Numbers, Basis]], curve: Curve, *args: Argument
) -> tuple[Numbers, Basis, Numbers]:
    """Numbers, basis and standard errors of a curve; the last are empty for a model.

    `numbers(curve, *args)` gives the numbers that have a standard error, those that have none, and
    their basis. Raises ValueError for a response that is not finite; under jit the numbers
    are `nan` then.
    """
    if curve.coherence is None:
        (values, others, basis), errors = _evaluated(numbers, curve, *args), {}
    else:
        values, others, basis, errors = _propagated(numbers, curve, *args)
    if is_concrete(basis.finite) and not bool(basis.finite):
        bad = np.asarray(curve.omega)[~np.isfinite(np.asarray(curve(curve.omega)))]
        where = (
            f"at {bad[0]:.6g} rad/s" if bad.size else "once closed or multiplied with a spectrum"
        )
        raise ValueError(
            f"the response is not finite {where}: choose omega= without the poles on the imaginary "
            "axis (of 1 / (1 + L) too), and a spectrum of 0 or more"
        )
    return values | others, basis, errors


def only_finite(values: Numbers, finite: Bool[Array, ""]) -> Numbers:
    """`nan` for every number of a response that is not finite."""
    return {name: jnp.where(finite, value, jnp.nan) for name, value in values.items()}


def with_coherence(basis: Basis, curve: Curve, places: Mapping[str, ArrayLike]) -> Basis:
    """The basis, with the lesser coherence of the two points beside each frequency found."""
    if curve.coherence is None:
        return basis
    coherence = np.asarray(curve.coherence)
    least = {
        name: float(np.min(coherence[around(curve.omega, place)]))
        for name, place in places.items()
        if np.isfinite(place)
    }
    return eqx.tree_at(lambda b: b.coherence, basis, least)


@eqx.filter_jit
def _evaluated(numbers: Callable, curve: Curve, *args: Argument) -> tuple[Numbers, Numbers, Basis]:
    return numbers(curve, *args)


@eqx.filter_jit
def _propagated(
    numbers: Callable, curve: Curve, *args: Argument
) -> tuple[Numbers, Numbers, Basis, Numbers]:

    def perturbed(change):
        model = curve.measured
        moved = (model.log_magnitude + change[0], model.phase + change[1])
        model = eqx.tree_at(lambda m: (m.log_magnitude, m.phase), model, moved)
        values, *rest = numbers(eqx.tree_at(lambda c: c.model, curve, model), *args)
        return values, (values, *rest)

    still = jnp.zeros((2, curve.omega.size), curve.omega.dtype)
    slopes, (values, others, basis) = jax.jacfwd(perturbed, has_aux=True)(still)
    errors = {
        name: jnp.where(jnp.isfinite(value), _spread(slopes[name], curve), jnp.nan)
        for name, value in values.items()
    }
    return values, others, basis, errors


def _spread(
    slope: Float[Array, " *numbers 2 frequencies"], curve: Curve
) -> Float[Array, " *numbers"]:
    # dT/T is circular: the real part of conj(w) dT/T has half the variance of the whole.
    w = jax.lax.complex(slope[..., 0, :], slope[..., 1, :])
    power = jnp.einsum("...f,fg,...g->...", jnp.conj(w), curve.measured.covariance, w)
    return jnp.sqrt(jnp.maximum(jnp.real(power) / 2, 0.0))


def shown(
    value: Float[Array, ""] | float,
    error: Float[Array, ""] | float | None,
    unit: str,
    scale: float = 1.0,
) -> str:
    """`value` times `scale` with its standard error."""
    if not np.isfinite(value):
        return "-"
    doubt = "" if error is None else f" +- {float(error) * scale:.2g}"
    return f"{float(value) * scale:.4g}{doubt} {unit}"


def degrees(value: Float[Array, ""] | float, error: Float[Array, ""] | float | None) -> str:
    """An angle in rad as degrees."""
    return shown(value, error, "deg", float(np.degrees(1.0)))


def decibels(value: Float[Array, ""] | float, error: Float[Array, ""] | float | None) -> str:
    """A ratio in dB."""
    if not np.isfinite(value):
        return "-"
    scale = 20 / np.log(10)
    relative = None if error is None else np.asarray(error) / np.asarray(value)
    doubt = "" if relative is None else f" +- {scale * float(relative):.2g}"
    return f"{scale * np.log(float(value)):.4g}{doubt} dB"


def lines(rows: list[tuple[str, str]], remarks: list[str]) -> str:
    """Names and numbers in two columns, then the remarks."""
    width = max(len(name) for name, _ in rows)
    table = [f"  {name:<{width}}  {text}" for name, text in rows]
    return "\n".join(table + [f"  ! {remark}" for remark in remarks])
