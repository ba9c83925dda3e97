"""One response, measured or of a model, that can be asked at any frequency, and its numbers."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float

from jaxquad._core import is_concrete
from jaxquad.models import (
    AttitudeAxis,
    imaginary,
    LaggedIntegrator,
    Model,
    StateSpace,
    TransferFunction,
)
from jaxquad.spectra import FrequencyResponse


Response = FrequencyResponse | Model
AMBIGUOUS = 2.0  # rad between neighbours, from which the sense of a turn is a guess
_GRID = (0.01, 1000.0, 2000)  # rad/s, rad/s, points


class Interpolated(eqx.Module):
    """A measured response: ln|T| and the unwrapped phase run straight in ln(omega)."""

    omega: Float[Array, " frequencies"]  # rad/s
    log_magnitude: Float[Array, " frequencies"]
    phase: Float[Array, " frequencies"]  # rad
    covariance: Complex[Array, "frequencies frequencies"]  # of dT/T

    def frequency_response(
        self, omega: Float[Array, " points"]
    ) -> Complex[Array, "points outputs inputs"]:
        """Response at `omega` in rad/s, constant beyond the ends."""
        knots = jnp.log(self.omega)
        passed = jnp.searchsorted(knots, jnp.log(omega), side="right", method="compare_all")
        k = jnp.clip(passed - 1, 0, knots.size - 2)
        part = jnp.clip((jnp.log(omega) - knots[k]) / (knots[k + 1] - knots[k]), 0, 1)
        straight = (y[k] + part * (y[k + 1] - y[k]) for y in (self.log_magnitude, self.phase))
        return jnp.exp(jax.lax.complex(*straight))[:, None, None]

    @property
    def random_error(self) -> Float[Array, " frequencies"]:
        """1 sigma of ln|T|, and of the phase in rad."""
        return jnp.sqrt(jnp.real(jnp.diag(self.covariance)) / 2)


class Curve(eqx.Module):
    """One output to one input, divided by s `integrations` times, and the grid to search.

    `coherence` is None for a model, which is exact at any frequency.
    """

    model: Model
    omega: Float[Array, " frequencies"]  # rad/s
    coherence: Float[Array, " frequencies"] | None
    pair: tuple[int, int] = eqx.field(static=True)
    integrations: int = eqx.field(static=True)
    dropped: int = eqx.field(static=True)  # measured frequencies without a number

    def __call__(self, omega: Float[Array, " points"]) -> Complex[Array, " points"]:
        """Response at `omega` in rad/s."""
        return self._before_integrations(omega) / imaginary(omega) ** self.integrations

    @property
    def measured(self) -> Interpolated:
        """The interpolated response. Raises TypeError for a curve of a model."""
        if not isinstance(self.model, Interpolated):
            raise TypeError("a model has no measured response: it is exact")
        return self.model

    def phase(self, start: Float[ArrayLike, ""] | None) -> Float[Array, " frequencies"]:
        """Phase on the grid in rad, unwrapped upwards from the lowest frequency.

        There the response as given, before the integrations, has its principal value, or the one
        nearest to `start`.
        """
        phase = jnp.unwrap(jnp.angle(self._before_integrations(self.omega)))
        if start is not None:
            phase = phase + 2 * jnp.pi * jnp.round((start - phase[0]) / (2 * jnp.pi))
        return phase - self.integrations * jnp.pi / 2

    def _before_integrations(self, omega: Float[Array, " points"]) -> Complex[Array, " points"]:
        output, source = self.pair
        return self.model.frequency_response(omega)[:, output, source]


class _Opaque:
    """A model that is no pytree: new at every call, so that no compiled answer outlives it."""

    def __init__(self, model: Model):
        self.frequency_response = model.frequency_response


def curve_of(
    response: Response, omega: Float[ArrayLike, " frequencies"] | None, output: str | int | None,
    input: str | int | None, integrations: int = 0,
) -> Curve:  # fmt: skip
    """The curve of a `FrequencyResponse` or of a model, searched at `omega` in rad/s."""
    if isinstance(response, FrequencyResponse):
        return _measured(response, omega, output, input, integrations)
    if not isinstance(response, Model):
        raise ValueError(
            f"a {type(response).__name__} is no frequency response: give a "
            "jq.spectra.FrequencyResponse, or a model with a method frequency_response(omega)"
        )
    grid = np.geomspace(*_GRID) if omega is None else omega
    _require_grid(grid)
    grid = jnp.asarray(grid, jnp.result_type(float))
    shape = eqx.filter_eval_shape(lambda m, w: m.frequency_response(w), response, grid).shape
    if len(shape) != 3 or shape[0] != grid.size:
        raise ValueError(
            f"{type(response).__name__}.frequency_response gave the shape {shape} for {grid.size} "
            f"frequencies: it must be ({grid.size}, outputs, inputs)"
        )
    names = [tuple(f"{k}" for k in range(n)) for n in shape[1:]]
    pair = (_position("output", output, names[0]), _position("input", input, names[1]))
    model = _Opaque(response) if jax.tree.leaves(response) == [response] else response
    return Curve(model, grid, None, pair, integrations, 0)


_GROWS = 1e-6  # of the fastest pole: what of a real part is above rounding


def count_unstable_poles(response: Response, unstable_poles: int | None) -> int:
    """As given; else those of a model that knows its poles, and 0 of others and of tracers."""
    if unstable_poles is not None:
        return unstable_poles
    if isinstance(response, AttitudeAxis | LaggedIntegrator):
        response = response.transfer_function()
    if not isinstance(response, StateSpace | TransferFunction):
        return 0
    if not all(is_concrete(leaf) for leaf in jax.tree.leaves(response)):
        return 0
    poles = response.poles
    return int(np.sum(np.real(poles) > _GROWS * np.max(np.abs(poles), initial=0.0)))


def ambiguous(phase: Float[Array, " frequencies"]) -> Bool[Array, " intervals"]:
    """Between which neighbours a phase turns by so much that its sense is a guess."""
    return ~(jnp.abs(jnp.diff(phase)) < AMBIGUOUS)


def _measured(
    frf: FrequencyResponse, omega: Float[ArrayLike, " frequencies"] | None,
    output: str | int | None, input: str | int | None, integrations: int,
) -> Curve:  # fmt: skip
    o, i = _position("output", output, frf.output_names), _position("input", input, frf.input_names)
    values, error = (np.asarray(x)[:, o, i] for x in (frf.response, frf.random_error))
    measured, wanted = np.asarray(frf.omega), np.full(frf.omega.shape, True)
    if omega is not None:
        unknown = np.asarray(omega)[~np.isin(omega, measured)]
        if unknown.size:
            raise ValueError(
                f"omega holds {unknown[0]:.6g} rad/s, at which nothing was measured: choose from "
                "the omega of the response, as in frf.omega[5:60]"
            )
        wanted = np.isin(measured, omega)
    usable = wanted & np.isfinite(values) & np.isfinite(error) & (values != 0)
    grid = measured[usable]
    _require_grid(grid)
    level, phase = np.log(np.abs(values[usable])), np.unwrap(np.angle(values[usable]))
    with np.errstate(divide="ignore", invalid="ignore"):  # where there is no number
        shared = frf.relative_covariance(o, i)[np.ix_(usable, usable)]
    numbers = (jnp.asarray(x) for x in (grid, level, phase, shared))
    coherence = jnp.asarray(np.asarray(frf.coherence)[usable, o, i])
    dropped = int(np.sum(wanted & ~usable))
    return Curve(
        Interpolated(*numbers), jnp.asarray(grid), coherence, (0, 0), integrations, dropped
    )


def _position(kind: str, wanted: str | int | None, names: tuple[str, ...]) -> int:
    if wanted is None and len(names) == 1:
        return 0
    if isinstance(wanted, int) and 0 <= wanted < len(names):
        return wanted
    if isinstance(wanted, str) and wanted in names:
        return names.index(wanted)
    raise ValueError(
        f"{kind} is {wanted!r}, but the response has {len(names)}: choose {kind}= from "
        f"{', '.join(names)}, or a number from 0"
    )


def _require_grid(omega: Float[ArrayLike, " frequencies"]) -> None:
    if isinstance(omega, Array) and not is_concrete(omega):
        return
    grid = np.asarray(omega)
    if grid.ndim != 1 or grid.size < 3:
        raise ValueError(
            f"omega has the shape {grid.shape}: give a row of 3 usable frequencies or more"
        )
    if not (np.all(np.isfinite(grid)) and grid[0] > 0 and np.all(np.diff(grid) > 0)):
        raise ValueError(
            f"omega, from {grid[0]:.4g} to {grid[-1]:.4g} rad/s, must be finite, above 0 and "
            "rising: use numpy.geomspace"
        )


Residual = Callable[[Float[Array, " points"]], Float[Array, " points"]]
_HALVINGS = 60  # from a grid's interval to the last bit of a float64


def crossed(values: Float[Array, " frequencies"], direction: str) -> Bool[Array, " intervals"]:
    """Intervals in which `values` pass zero "falling", "rising" or in "both" directions.

    A curve that lies on zero but for rounding does not cross it.
    """
    above = values >= -1e4 * jnp.finfo(values.dtype).eps
    falls, rises = above[:-1] & ~above[1:], ~above[:-1] & above[1:]
    both = falls | rises
    finite = jnp.isfinite(values)
    return {"falling": falls, "rising": rises, "both": both}[direction] & finite[:-1] & finite[1:]


def crossings(
    residual: Residual, omega: Float[Array, " frequencies"], where: Bool[Array, " intervals"], *,
    rank: Float[Array, " intervals"] | None = None, limit: int = 1,
) -> Float[Array, " crossings"]:  # fmt: skip
    """The roots of `residual` in the intervals `where`, rising in rad/s; `nan` where there is none.

    `residual` treats each frequency by itself. Of more than `limit` roots, those of lowest `rank`
    are kept, by default the lowest frequencies. Each is bisected to machine accuracy, and its
    derivatives of any order with respect to what `residual` closes over are those of the implicit
    function theorem.
    """
    rank = jnp.arange(where.size, dtype=omega.dtype) if rank is None else rank
    chosen = jax.lax.top_k(jnp.where(where, -rank, -jnp.inf), min(limit, where.size))[1]
    chosen = jnp.sort(jnp.where(where[chosen], chosen, where.size))
    exists, interval = chosen < where.size, jnp.minimum(chosen, where.size - 1)
    root = between(residual, omega[interval], omega[interval + 1])
    return jnp.where(exists, root, jnp.nan)


def between(
    residual: Residual, low: Float[Array, " points"], high: Float[Array, " points"]
) -> Float[Array, " points"]:
    """Roots between frequencies where `residual` has opposite signs."""
    low, high = jax.lax.stop_gradient((low, high))

    def bisect(f, _):
        sign = f(low) >= 0

        def halve(_, ends):
            middle = jnp.sqrt(ends[0]) * jnp.sqrt(ends[1])
            left = (f(middle) >= 0) == sign
            return jnp.where(left, middle, ends[0]), jnp.where(left, ends[1], middle)

        return jax.lax.fori_loop(0, _HALVINGS, halve, (low, high))[1]

    def divide(slope, y):
        steep = slope(jnp.ones_like(y))
        # Where a curve only touches zero the derivative is infinite; unused rows stay 0.
        return y / jnp.where(steep == 0, jnp.finfo(y.dtype).tiny, steep)

    return jax.lax.custom_root(residual, low, bisect, divide)


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


class Evaluated(NamedTuple):
    """What a search of a curve gives back."""

    numbers: Numbers  # that have a standard error
    others: Numbers
    finite: Bool[Array, ""]  # whether the response is
    phase: Float[Array, " frequencies"]  # rad, unwrapped
    heeded: Bool[Array, " intervals"] | bool = True  # where it matters how the phase turns


Search = Callable[..., Evaluated]


def evaluate_curve(
    search: Search, curve: Curve, *args: Argument, places: tuple[str, ...] = ()
) -> dict[str, Any]:
    """The numbers of `search(curve, *args)`, their `standard_errors` if measured, and `basis`.

    `places` are the numbers beside which the measured coherence is of interest. Raises ValueError
    for a response that is not finite; under jit the numbers are `nan` then.
    """
    if curve.coherence is None:
        (values, others, basis), errors = _evaluate(search, curve, *args), {}
    else:
        values, others, basis, errors = _propagate(search, curve, *args)
    if is_concrete(basis.finite) and not bool(basis.finite):
        bad = np.asarray(curve.omega)[~np.isfinite(np.asarray(curve(curve.omega)))]
        where = f"at {bad[0]:.6g} rad/s" if bad.size else "once closed"
        raise ValueError(
            f"the response is not finite {where}: choose omega= without the poles on the imaginary "
            "axis (of 1 / (1 + L) too)"
        )
    values = values | others
    if curve.coherence is not None:  # the lesser of the two points beside each frequency
        coherence, grid = np.asarray(curve.coherence), np.asarray(curve.omega)
        least = {}
        for name in places:
            if np.isfinite(place := np.asarray(values[name])):
                above = np.clip(np.searchsorted(grid, place * (1 - 1e-12)), 0, grid.size - 1)
                below = np.searchsorted(grid, place * (1 + 1e-12), "right") - 1
                least[name] = float(min(coherence[above], coherence[max(below, 0)]))
        basis = eqx.tree_at(lambda b: b.coherence, basis, least)
    return values | {"standard_errors": errors, "basis": basis}


def only_finite(values: Numbers, finite: Bool[Array, ""]) -> Numbers:
    """`nan` for every number of a response that is not finite."""
    return {name: jnp.where(finite, value, jnp.nan) for name, value in values.items()}


def _searched(search: Search, curve: Curve, *args: Argument) -> tuple[Numbers, Numbers, Basis]:
    values, others, finite, phase, heeded = search(curve, *args)
    jumps = ambiguous(phase) & heeded
    unclear = jnp.where(jnp.any(jumps), curve.omega[jnp.argmax(jumps)], jnp.inf)
    band = jnp.stack([curve.omega[0], curve.omega[-1]])
    basis = Basis(band, phase[0], unclear, finite, {}, curve.dropped)
    return only_finite(values, finite), others, basis


_evaluate = eqx.filter_jit(_searched)


@eqx.filter_jit
def _propagate(
    search: Search, curve: Curve, *args: Argument
) -> tuple[Numbers, Numbers, Basis, Numbers]:

    def perturbed(change):
        model = curve.measured
        moved = (model.log_magnitude + change[0], model.phase + change[1])
        model = eqx.tree_at(lambda m: (m.log_magnitude, m.phase), model, moved)
        values, *rest = _searched(search, eqx.tree_at(lambda c: c.model, curve, model), *args)
        return values, (values, *rest)

    def spread(slope: Float[Array, " *numbers 2 frequencies"]) -> Float[Array, " *numbers"]:
        # dT/T is circular: the real part of conj(w) dT/T has half the variance of the total.
        w = jax.lax.complex(slope[..., 0, :], slope[..., 1, :])
        power = jnp.einsum("...f,fg,...g->...", jnp.conj(w), curve.measured.covariance, w)
        return jnp.sqrt(jnp.maximum(jnp.real(power) / 2, 0.0))

    still = jnp.zeros((2, curve.omega.size), curve.omega.dtype)
    slopes, (values, others, basis) = jax.jacfwd(perturbed, has_aux=True)(still)
    errors = {
        name: jnp.where(jnp.isfinite(value), spread(slopes[name]), jnp.nan)
        for name, value in values.items()
    }
    return values, others, basis, errors


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
    return shown(value, error, "deg", float(np.degrees(1.0)))


def decibels(value: Float[Array, ""] | float, error: Float[Array, ""] | float | None) -> str:
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
