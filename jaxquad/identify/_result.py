from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key, PyTree

from ._draws import draw_models
from ._identifiability import Combination, Identifiability, NotIdentifiable
from ._parameters import Parameters
from ._remarks import FEWER
from ._starts import Minimum


_SHOWN = 6  # stops of several starts


def fit_table(fit: Any) -> str:
    """Identifiability first, then the table of parameters, then how good the fit is."""
    lines = [*_verdict(fit), *_parameters(fit), _quality(fit), *_minima(fit)]
    return "\n".join(lines + [f"! {remark}" for remark in fit.remarks])


def _verdict(fit: Any) -> list[str]:
    if fit.identifiable:
        return []
    lost = fit.identifiability.undetermined
    lines = [f"NOT IDENTIFIABLE from this record, each by itself: {', '.join(lost)}"]
    if fit.combinations:
        known = " and ".join(combination.name for combination in fit.combinations)
        apart = all(name in lost for row in fit.null_directions for name in row)
        only = "only " if apart else ""  # else a parameter in it is determined by itself, too
        lines.append(f"  {only}{known} is determined by this record")
    elif fit.identifiability.curved:
        curved = ", ".join(fit.identifiability.curved)
        lines.append(f"  what it determines of {curved} is neither a product nor a sum of them")
    else:
        lines.append("  nothing about them is determined by this record")
    lines += [f"    {combination}" for combination in fit.combinations]
    for direction in fit.null_directions:
        parts = ", ".join(f"{share:+.3f} {name}" for name, share in direction.items())
        lines.append(f"  null direction (relative changes that change nothing): {parts}")
    if not any("ran to" in remark or FEWER in remark for remark in fit.remarks):
        lines += _remedies(lost)
    return lines


def _remedies(lost: tuple[str, ...]) -> list[str]:
    names = " or ".join(lost)
    return [
        f"  to resolve it: fix {names} at a measured value (leave it out of free=); or give what a",
        "  data sheet or a static test says of them, jq.identify.Prior(name or function, value, std.err.);",
        f"  or fit a second record under a known change of {names} (conditions=)",
    ]


def _parameters(fit: Any) -> list[str]:
    width = max(9, *(len(name) for name in fit.names))
    heads = (f"{'parameter':<{width}}", f"{'value':>11}", f"{'std.err.':>10}")
    lines = [" ".join([*heads, f"{'95 % interval':>25}", f"{'CR %':>7}", f"{'I %':>7}"])]
    for k, name in enumerate(fit.names):
        cells = [f"{'-':>11}", f"{'-':>10}", f"{'not determined':>25}", f"{'-':>7}", f"{'-':>7}"]
        if name not in fit.identifiability.undetermined:
            low, high = fit.interval(name)
            cells = [f"{fit.values[k]:11.5g}", f"{fit.standard_errors[k]:10.2g}"]
            cells += [f"{f'{low:.5g} .. {high:.5g}':>25}"]
            cells += [f"{fit.cramer_rao[k]:7.2f}", f"{fit.insensitivity[k]:7.2f}"]
        lines.append(" ".join([f"{name:<{width}}", *cells]))
    return lines


def _minima(fit: Any) -> list[str]:
    """Where the starts led, if there were several."""
    if not fit.minima:
        return []
    starts = sum(len(point.starts) for point in fit.minima)
    lines = [f"{starts} starts led to {len(fit.minima)} points:"]
    for point in fit.minima[:_SHOWN]:
        values = ", ".join(f"{value:.4g}" for value in point.values)
        lines.append(f"  cost {point.cost:9.4g} from {len(point.starts)}: {point.kind}; {values}")
    rest = len(fit.minima) - _SHOWN
    return lines + ([f"  and {rest} more of higher cost"] if rest > 0 else [])


def _quality(fit: Any) -> str:
    condition = f"{fit.condition:.3g}" if fit.condition < 1e6 else "singular"
    return (
        f"cost {fit.cost:.4g} (average {fit.average_cost:.4g}), misfit / random error "
        f"{np.sqrt(fit.chi_squared):.2f}, {fit.points} points, condition {condition}, "
        f"Newton decrement {fit.newton_decrement:.1e}, {fit.steps} steps"
    )


class Fit(eqx.Module):
    """An identified model with its doubts; `str(fit)` is the table for a report.

    Numbers that the record does not determine are `nan`, with an infinite standard error: their
    determined combinations are in `combinations`. `cramer_rao` and `insensitivity` are CIFER's, in
    per cent (2 sqrt((H^-1)_ii) and 1/sqrt(H_ii) of the cost's Hessian); `standard_errors` and
    `covariance` are calibrated by the measured noise.
    """

    model: PyTree
    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[np.ndarray, " parameters"]
    standard_errors: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    cramer_rao: Float[np.ndarray, " parameters"]  # %
    insensitivity: Float[np.ndarray, " parameters"]  # %
    cost: float  # summed over the responses
    average_cost: float  # per response
    information: float  # Takeuchi's criterion: cost plus what fitting the noise took off it, twice
    chi_squared: float  # cost over what the measured noise alone would leave: about 1
    newton_decrement: float  # what one more Gauss-Newton step would lower the cost by
    condition: float  # of the scaled Jacobian
    points: int  # frequencies used, over all responses
    steps: int
    identifiability: Identifiability
    remarks: tuple[str, ...] = eqx.field(static=True)
    parameters: Parameters
    units: Float[np.ndarray, " parameters"]  # what relative changes are relative to
    relative_covariance: Float[np.ndarray, "parameters parameters"]
    minima: tuple[Minimum, ...] = ()  # distinct stops of several starts, by the first weights

    @property
    def identifiable(self) -> bool:
        """Whether the record determines every free parameter by itself."""
        return not self.identifiability.undetermined

    @property
    def null_directions(self) -> tuple[dict[str, float], ...]:
        """Relative changes of parameters that leave the responses as they are."""
        return self.identifiability.null_directions

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """What is determined of the parameters that are not, one by one."""
        return self.identifiability.determined

    @property
    def correlation(self) -> Float[np.ndarray, "parameters parameters"]:
        """Correlation matrix of the parameters."""
        return self.covariance / np.outer(self.standard_errors, self.standard_errors)

    def interval(self, name: str) -> tuple[float, float]:
        """The 95 % interval of one parameter."""
        k = self.names.index(name)
        reach = 1.96 * self.standard_errors[k]
        return float(self.values[k] - reach), float(self.values[k] + reach)

    def derived(
        self, quantity: Callable[[PyTree], Float[Array, ""]], name: str = "derived"
    ) -> Combination:
        """Any function of the model with its standard error: `lambda m: m.lag + m.delay`.

        First-order propagation of the covariance. Raises `NotIdentifiable` where the quantity
        depends on what the record does not determine.
        """
        here = jnp.asarray(self._fitted())
        gradient = jax.grad(lambda x: quantity(self.parameters.replace(self.model, x)))(here)
        slope = np.asarray(gradient) * self.units
        if self._moves(quantity, slope):
            lost = ", ".join(self.identifiability.undetermined)
            raise NotIdentifiable(
                f"{name} changes with what this record does not determine ({lost}): fit it under "
                "a jq.identify.Prior or with a second record, or ask for a determined combination"
            )
        error = float(np.sqrt(slope @ self.relative_covariance @ slope))
        return Combination(name, float(quantity(self.model)), error)

    def ensemble(self, n: int, key: Key[Array, ""], *, hold_undetermined: bool = False) -> PyTree:
        """`n` models drawn from the fit; leaves with free or tied numbers get a last axis `[n]`.

        The draws are normal in the coordinates of the fit (logarithms of what keeps its sign, so
        that a lag never comes out negative), with the calibrated covariance, widened where the
        standard errors are. Raises `NotIdentifiable` where the record leaves parameters
        undetermined. With `hold_undetermined` these directions stay where the solver stopped and
        only what is determined varies: right for quantities that `derived` accepts, and no spread
        at all for others. Raises ValueError for a fit that found no minimum or has no finite
        standard errors, and for parameters that ran to zero.
        """
        if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
            raise ValueError(f"n is {n}: draw a whole number of models, 1 or more")
        scores = jax.random.normal(key, (len(self.names), n))
        return draw_models(self, scores, hold_undetermined=hold_undetermined)

    def _fitted(self) -> Float[np.ndarray, " parameters"]:
        """Values where the solver stopped, the undetermined ones too."""
        leaves = jax.tree.leaves(eqx.filter(self.model, eqx.is_inexact_array))
        places = self.parameters.places[: len(self.names)]
        return np.array([np.asarray(leaves[p.leaf]).reshape(-1)[p.index] for p in places])

    def _moves(self, quantity: Callable[[PyTree], Float[Array, ""]], slope: np.ndarray) -> bool:
        """Whether a quantity changes with what leaves all responses as they are."""
        verdict = self.identifiability
        first_order = np.abs(verdict.exact @ slope) > 1e-6 * np.linalg.norm(slope)
        touched = [slope[self.names.index(name)] != 0 for name in verdict.curved]
        here = float(quantity(self.model))
        others = [
            float(quantity(self.parameters.replace(self.model, jnp.asarray(values))))
            for values in verdict.alternatives
        ]
        apart = [abs(other - here) > 1e-6 * abs(here) for other in others]
        return bool(np.any(first_order) or any(touched) or any(apart))

    def __str__(self) -> str:
        return fit_table(self)
