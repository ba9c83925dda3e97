from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from ._draws import draw_models
from ._parameters import Parameters
from ._starts import Minimum
from ._verdict import Combination, UndeterminedError, Verdict


_SHOWN = 6  # optima of several starts


def fit_table(fit: "Fit") -> str:
    """The verdict where it is a refusal, the table of parameters, and how good the fit is."""
    lines = [] if fit.identifiable else [str(fit.verdict)]
    if fit.verdict.fitted:
        lines += [*_parameters(fit), _quality(fit), *_minima(fit)]
    return "\n".join(lines + [f"! {remark}" for remark in fit.remarks])


_MARK = " *"  # behind the name of a parameter that is not determined


def _parameters(fit: "Fit") -> list[str]:
    marks = np.where(fit.determined, "", _MARK)
    names = [f"{name}{mark}" for name, mark in zip(fit.names, marks, strict=True)]
    width = max(9, *map(len, names))
    heads = (f"{'parameter':<{width}}", f"{'value':>11}", f"{'std. error':>10}")
    heads = (*heads, f"{'95 % interval':>25}", f"{'CR %':>7}", f"{'insensitivity %':>15}")
    lines = [" ".join(heads)]
    for k, name in enumerate(names):
        low, high = fit.interval(fit.names[k])
        interval = f"{low:.5g} .. {high:.5g}" if fit.determined[k] else "not determined"
        cells = [f"{fit.values[k]:11.5g}", f"{fit.standard_errors[k]:10.2g}", f"{interval:>25}"]
        cells += [f"{fit.cramer_rao[k]:7.2f}", f"{fit.insensitivity[k]:15.2f}"]
        lines.append(" ".join([f"{name:<{width}}", *cells]))
    if not fit.identifiable:
        lines.append("* where the solver stopped; this record does not determine it by itself")
    return lines


def counted(number: int, one: str, many: str = "") -> str:
    """`1 start`, `2 starts`."""
    return f"{number} {one if number == 1 else many or one + 's'}"


def _minima(fit: "Fit") -> list[str]:
    """The optima at which the starts ended, if there were several."""
    if not fit.minima:
        return []
    starts = sum(len(point.starts) for point in fit.minima)
    lines = [f"{counted(starts, 'start')}, {counted(len(fit.minima), 'optimum', 'optima')}:"]
    for point in fit.minima[:_SHOWN]:
        values = ", ".join(f"{value:.4g}" for value in point.values)
        lines.append(f"  cost {point.cost:9.4g} from {len(point.starts)}: {point.kind}; {values}")
    rest = len(fit.minima) - _SHOWN
    return lines + ([f"  and {rest} more of higher cost"] if rest > 0 else [])


def _quality(fit: "Fit") -> str:
    condition = f"{fit.condition:.3g}" if fit.condition < 1e6 else "singular"
    return (
        f"cost {fit.cost:.4g} (average {fit.average_cost:.4g}), misfit / random error "
        f"{np.sqrt(fit.chi_squared):.2f}, {fit.points} points, condition {condition}, "
        f"Newton decrement {fit.newton_decrement:.1e}, {fit.steps} steps"
    )


class Fit(eqx.Module):
    """An identified model with its doubts; `str(fit)` is the table for a report.

    `verdict` says which parameters the record determines. Numbers of the others are kept as the
    solver left them: they are marked in the table, `determined` is false for them, and their
    standard errors are large, or infinite where some change of parameters leaves the responses
    exactly as they are. `cramer_rao` and `insensitivity` are CIFER's, in per cent
    (2 sqrt((H^-1)_ii) and 1/sqrt(H_ii) of the cost's Hessian); `standard_errors` and `covariance`
    are calibrated by the measured noise.
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
    verdict: Verdict
    remarks: tuple[str, ...] = eqx.field(static=True)
    parameters: Parameters
    units: Float[np.ndarray, " parameters"]  # what relative changes are relative to
    relative_covariance: Float[np.ndarray, "parameters parameters"]
    minima: tuple[Minimum, ...] = ()  # distinct stops of several starts, by the first weights

    @property
    def identifiable(self) -> bool:
        """Whether the record determines every free parameter by itself."""
        return self.verdict.identifiable

    @property
    def determined(self) -> Bool[np.ndarray, " parameters"]:
        """Which parameters the record determines by themselves."""
        return np.array([name not in self.verdict.undetermined for name in self.names])

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """What is determined of the parameters that are not, one by one."""
        return self.verdict.combinations

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

        First-order propagation of the covariance. Raises `UndeterminedError`, a ValueError, where
        the quantity depends on what the record does not determine.
        """
        if not self.verdict.fitted:
            raise UndeterminedError(f"{name} has no value: {self.verdict.summary}")
        here = jnp.asarray(self.values)
        gradient = jax.grad(lambda x: quantity(self.parameters.replace(self.model, x)))(here)
        slope = np.asarray(gradient) * self.units
        if self._moves(quantity, slope):
            lost = ", ".join(self.verdict.undetermined)
            raise UndeterminedError(
                f"{name} changes with what this record does not determine ({lost}): fit it under "
                "a jq.identify.Prior or with a second record, or ask for a determined combination"
            )
        error = float(np.sqrt(slope @ self.relative_covariance @ slope))
        return Combination(name, float(quantity(self.model)), error)

    def ensemble(self, n: int, key: Key[Array, ""], *, hold_undetermined: bool = False) -> PyTree:
        """`n` models drawn from the fit; leaves with free or tied numbers get a last axis `[n]`.

        The draws are normal in the coordinates of the fit (logarithms of what keeps its sign, so
        that a lag never comes out negative), with the calibrated covariance, widened where the
        standard errors are. Raises `UndeterminedError` where the record leaves parameters
        undetermined. With `hold_undetermined` these directions stay where the solver stopped and
        only what is determined varies: right for quantities that `derived` accepts, and no spread
        at all for others. Raises ValueError for a fit that found no minimum or has no finite
        standard errors, and for parameters that ran to zero.
        """
        if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
            raise ValueError(f"n is {n}: draw a whole number of models, 1 or more")
        scores = jax.random.normal(key, (len(self.names), n))
        return draw_models(self, scores, hold_undetermined=hold_undetermined)

    def _moves(self, quantity: Callable[[PyTree], Float[Array, ""]], slope: np.ndarray) -> bool:
        """Whether a quantity changes with what leaves all responses as they are."""
        verdict = self.verdict
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
