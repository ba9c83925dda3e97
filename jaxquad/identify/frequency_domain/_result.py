"""An identified model with its doubts: values, errors, covariance, verdict."""

import functools as ft
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, Key, PyTree

from jaxquad._core import concrete_values, is_traced, Message, plain_content, pytree_node
from jaxquad.records import Record

from ..output_error._noise import NoiseModel
from ..output_error._simulated import linear_model
from ..output_error._verify import Verification, verify
from ..uncertainty._derived import (
    derive,
    draw_models,
    model_response,
    ResponseBand,
    step_response,
    StepBand,
    Tied,
    tied_parameters,
    with_reach,
)
from ..uncertainty._discrepancy import Discrepancy
from ..uncertainty._log_density import Evidence, LogDensity, PriorDensity
from ..uncertainty._profiles import Profile
from ..uncertainty._verdict import (
    Combination,
    pooled_freedom,
    reach_of_interval,
    UndeterminedError,
    USUAL,
    Verdict,
)
from ._fit_table import parameter_lines, quality_lines
from ._parameters import Parameters
from ._refits import Bands, explain_misfit, Explanation, fit_bands, Origin
from ._solve import Minimum


@pytree_node
class Fit:
    """An identified model with its doubts; `str(fit)` is the table for a report.

    `verdict` says which parameters the record determines. Numbers of the others are kept as the
    solver left them: they are marked in the table, `determined` is false for them, and their
    standard errors are large, or infinite where some change of parameters leaves the responses
    exactly as they are. `cramer_rao` and `insensitivity` are CIFER's, in per cent
    (2 sqrt((H^-1)_ii) and 1/sqrt(H_ii) of the cost's Hessian); `standard_errors` and `covariance`
    are calibrated by the measured noise. Within `jax.grad` and its like, `model`, `values` and
    `fit[name]` have derivatives; all else counts as constant.
    """

    model: PyTree
    names: tuple[str, ...] = eqx.field(static=True)
    values: Float[Any, " parameters"]
    standard_errors: Float[np.ndarray, " parameters"]
    covariance: Float[np.ndarray, "parameters parameters"]
    noise_covariance: Float[np.ndarray, "parameters parameters"]
    cramer_rao: Float[np.ndarray, " parameters"]  # %
    insensitivity: Float[np.ndarray, " parameters"]  # %
    cost: float  # summed over the responses
    average_cost: float  # per response
    information: float  # Takeuchi's criterion: cost plus what fitting the noise took off it, twice
    chi_squared: float  # cost over what the measured noise alone would leave: about 1
    newton_decrement: float  # half of what one more Gauss-Newton step would take off the cost
    condition: float  # of the scaled Jacobian
    points: int  # frequencies used, over all responses
    steps: int
    verdict: Verdict
    remarks: tuple[Message, ...] = eqx.field(static=True)
    parameters: Parameters
    units: Float[np.ndarray, " parameters"]  # what relative changes are relative to
    relative_covariance: Float[np.ndarray, "parameters parameters"]
    relative_noise_covariance: Float[np.ndarray, "parameters parameters"]  # by the noise alone
    degrees_of_freedom: Float[np.ndarray, " parameters"]  # of the noise estimate behind the errors
    minima: tuple[Minimum, ...] = ()  # distinct stops of several starts, by the first weights
    discrepancy: Discrepancy | None = None  # what the model leaves unexplained, if it was looked at
    noise_models: tuple[tuple[NoiseModel, ...], ...] = ()  # of each record's outputs, by jq.refine
    origin: Origin | None = None  # the responses and options of `jq.fit`
    profiles: tuple[Profile, ...] = ()  # of weak parameters that keep their sign
    evidence: Evidence | None = None  # what `log_density` evaluates
    parameter_units: tuple[str, ...] = eqx.field(static=True, default=())  # for tables

    @property
    def identifiable(self) -> bool:
        """Whether the record determines every free parameter individually."""
        return self.verdict.identifiable

    @property
    def determined(self) -> Bool[np.ndarray, " parameters"]:
        """Which parameters the record determines individually."""
        return np.array([name not in self.verdict.undetermined for name in self.names])

    @property
    def combinations(self) -> tuple[Combination, ...]:
        """What is determined of the parameters that are not, one by one."""
        return self.verdict.combinations

    @property
    def correlation(self) -> Float[np.ndarray, "parameters parameters"]:
        """Correlation matrix of the parameters."""
        return self.covariance / np.outer(self.standard_errors, self.standard_errors)

    @property
    def noise_standard_errors(self) -> Float[np.ndarray, " parameters"]:
        """Standard errors by the measured noise alone, as if the model's structure were exact."""
        unbounded = np.isinf(self.standard_errors)
        return np.where(unbounded, np.inf, np.sqrt(np.diagonal(self.noise_covariance)))

    def __getitem__(self, name: str) -> Any:  # a float, or what a derivative traces
        """The value of one parameter: `fit["gain"]`; `fit.interval(name)` has its error.

        **Raises:** KeyError for a name that the fit does not have, UndeterminedError (a ValueError)
        where the record does not determine the parameter: `values` has where the solver stopped.
        """
        k = self._place(name)
        if not self.determined[k]:
            left = "where the solver stopped" if self.verdict.fitted else "the starting value"
            raise UndeterminedError(
                f"{name} has no value of its own: {self.verdict.summary}; {left} is "
                f"fit.values[{k}], for comparison alone"
            )
        return self.values[k] if is_traced(self.values) else float(self.values[k])

    def _place(self, name: str) -> int:
        if name not in self.names:
            raise KeyError(
                f"no free parameter {name!r}: this fit has {', '.join(self.names)}; what is tied "
                "to them is in fit.tied, and what follows from them has its value and error by "
                "fit.derived(lambda model: ...)"
            )
        return self.names.index(name)

    def __call__(
        self, record: Record, *, band: tuple[float, float] | None = None, hold: str | None = None
    ) -> Verification:
        """`jq.verify(fit, record)`, by default within `used_band`.

        **Raises:** what `jq.verify` raises; UndeterminedError where nothing was fitted.
        """
        self._require_model("a simulation")
        return verify(self, record, band=band, hold=hold)

    def _require_model(self, what: str) -> None:
        if not self.verdict.fitted:
            raise UndeterminedError(f"{what} needs a fitted model: {self.verdict.summary}")

    @property
    def used_band(self) -> tuple[float, float] | None:
        """The lowest and the highest frequency that the fit used, in rad/s; None if it is unknown.

        A fit in the time domain, by `jq.refine`, has none.
        """
        return None if self.origin is None or not self.verdict.fitted else self.origin.band

    @property
    def poles(self) -> np.ndarray:
        """Poles of the model in rad/s; see `jq.models.modes` for damping and frequency.

        `jq.identify.factors(fit)` has those of a `jq.TransferFunction` with standard errors.
        """
        return linear_model(self.model).poles

    @property
    def pole_reach(self) -> Complex[np.ndarray, " poles"]:
        """Half of the 95 % interval of each of the `poles`: of its real and of its imaginary part.

        By first order, model error included; as the real and the imaginary part of the result.
        """
        self._require_model("an interval of the poles")
        start = self.poles

        def poles(model: PyTree) -> Complex[np.ndarray, " poles"]:
            left, ordered = list(linear_model(model).poles), []
            for pole in start:  # in the order of the fit's poles
                ordered.append(left.pop(int(np.argmin(np.abs(np.array(left) - pole)))))
            return np.array(ordered, complex)

        reach = with_reach(self, poles)[1]
        return reach(np.real) + 1j * reach(np.imag)

    def step_response(self, time: Float[ArrayLike, " samples"]) -> StepBand:
        """The answer to a unit step of each input, with its 95 % band, model error included.

        `time` is equally spaced, from 0, in s.

        **Raises:** ValueError for other times, for a model that cannot be simulated, and where
        nothing was fitted.
        """
        self._require_model("a step response")
        value, reach = with_reach(self, lambda model: step_response(model, time))
        return StepBand(np.asarray(time, float), value, reach(lambda slopes: slopes))

    def response_band(self, omega: Float[ArrayLike, " frequencies"]) -> ResponseBand:
        """The response at `omega` (rad/s) with its 95 % band, model error included, to first order.

        **Raises:** ValueError where nothing was fitted.
        """
        self._require_model("a response")
        grid = np.asarray(omega, float)
        if grid.ndim != 1:
            raise ValueError(
                f"omega has the shape {grid.shape}: give a list of frequencies in rad/s"
            )
        value, reach = with_reach(self, lambda model: model_response(model, grid))
        decibels = 20 / np.log(10) * reach(lambda slopes: np.real(slopes / value))
        degrees = np.degrees(reach(lambda slopes: np.imag(slopes / value)))
        return ResponseBand(grid, value, decibels, degrees)

    def to_dict(self) -> dict[str, object]:
        """All numbers as JSON holds them, as in `result.json`: None for what is not finite."""
        return plain_content(_content(self))

    def interval(
        self, name: str, *, level: float | int = USUAL, model_error: bool = True
    ) -> tuple[float, float]:
        """The 95 % interval of one parameter; of one that keeps its sign, what has that sign.

        Within six standard errors of zero its sides are those of the profile likelihood, made so
        that twice as long ones hold what they promise, too.

        **Arguments:**

        - `name`: of the parameter.
        - `level`: the share of such intervals that hold the truth: 0.9 for 90 %. That of a
            parameter at zero ends at a one-sided limit.
        - `model_error`: count what the model's structure leaves unexplained, as
            `standard_errors` do; False for the measured noise alone.

        **Raises:** KeyError for a name that the fit does not have, ValueError for a level that
        does not lie between 0 and 1.
        """
        k = self._place(name)
        for bound in self.verdict.bounds:
            if bound.name == name:
                limit = bound.limit_at(level, model_error=model_error)
                return min(0.0, limit), max(0.0, limit)
        errors = self.standard_errors if model_error else self.noise_standard_errors
        reach = reach_of_interval(float(self.degrees_of_freedom[k]), level)
        ends = [float(self.values[k] + side * reach * errors[k]) for side in (-1, 1)]
        for profile in self.profiles if self.determined[k] else ():
            ends += profile.interval(k, float(errors[k]), reach, model_error=model_error)
        low, high = min(ends), max(ends)
        if not (self.determined[k] and self.parameters.logarithmic[k]):
            return low, high
        # It keeps its sign.
        return (low, min(high, 0.0)) if np.signbit(self.values[k]) else (max(low, 0.0), high)

    @property
    def tied(self) -> tuple[Tied, ...]:
        """The parameters that follow from others (`tied=` of `jq.fit`), with their errors."""
        return tied_parameters(self)

    def derived(
        self,
        quantity: Callable[[PyTree], Float[Array, ""]],
        name: str = "derived",
        *,
        model_error: bool = True,
    ) -> Combination:
        """Any function of the model with its standard error: `lambda m: m.lag + m.delay`.

        **Arguments:**

        - `quantity`: from a model to a number.
        - `name`: for messages and print.
        - `model_error`: as in `interval`.

        **Returns:** a `jq.identify.Combination`, by first-order propagation of the covariance.

        **Raises:** UndeterminedError where it depends on what the record does not determine.
        """
        if not self.verdict.fitted:
            raise UndeterminedError(f"{name} has no value: {self.verdict.summary}")
        if not callable(quantity):
            raise ValueError(
                f"quantity is {quantity!r}: give a function of the model, such as lambda model: "
                "model.lag + model.delay; fit[name] and fit.interval(name) have single parameters"
            )
        return derive(self, quantity, name, model_error=model_error)

    def bands(self) -> Bands:
        """The same parameters from the lower and from the upper half of the band.

        Where the two disagree, the model does not hold over the whole band. The band is halved on
        a logarithmic scale; each half is fitted from where this fit stopped.

        **Raises:** ValueError where the fit is not one of `jq.fit`.
        """
        return fit_bands(self)

    def explain(self) -> Explanation:
        """Which further term the responses want, where the model does not explain them.

        The model is fitted again with one more pole or zero, a pair of them, rate damping, the slow
        pair of a hovering vehicle, or, of a sweep, a gain or a clock that drifts with time; the
        lowest information criterion (BIC) decides. Where a remark says that the actuator has two
        lags, all this is behind such an actuator.

        **Raises:** ValueError where the fit is not one of `jq.fit`.
        """
        return explain_misfit(self)

    def freedom_of(self, slope: Float[np.ndarray, " parameters"]) -> float:
        """Degrees of freedom of a quantity with this `slope` by relative changes."""
        shares = slope**2 * np.diagonal(self.relative_covariance)
        return pooled_freedom(self.degrees_of_freedom, shares)

    def ensemble(self, n: int, key: Key[Array, ""], *, hold_undetermined: bool = False) -> PyTree:
        """Draw `n` models from the fit; leaves with free or tied numbers get a last axis `[n]`.

        Draws are normal in the coordinates of the fit (logarithms of parameters that keep their
        sign, so that a lag never comes out negative), with the calibrated covariance. A parameter
        of `verdict.bounds` is the absolute value of a normal one: it keeps its sign, too.

        **Arguments:**

        - `n`: how many.
        - `key`: of the random numbers.
        - `hold_undetermined`: keep what the record does not determine where the solver stopped,
            and let only the rest vary: right for quantities that `derived` accepts, and no spread
            at all for others.

        **Raises:** UndeterminedError where the record leaves parameters undetermined, and these are
        not held; ValueError where the fit found no minimum, or has no finite standard errors.
        """
        if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
            raise ValueError(f"n is {n}: give a whole number of models, 1 or more")
        if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
            raise ValueError(f"key is {key!r}: give a jax.random.key(0)")
        scores = jax.random.normal(key, (len(self.names), n))
        return draw_models(self, scores, hold_undetermined=hold_undetermined)

    @property
    def coordinates(self) -> Float[np.ndarray, " parameters"]:
        """The fitted values as `log_density` takes them: where samplers start.

        Logarithms of the sizes of parameters that keep their sign, of one at zero that of the
        change which shows; others relative to their typical size. `fit.parameters.coordinates`
        converts other values, `fit.parameters.values` converts back, by JAX too.
        """
        values = np.where(self.values == 0, self.units, self.values)
        return np.asarray(self.parameters.coordinates(values))

    def log_density(
        self,
        z: Float[ArrayLike, " parameters"],
        *,
        prior: Mapping[str, PriorDensity] | None = None,
        model_error: bool = True,
    ) -> Float[Array, ""]:
        """The logarithm of the parameters' posterior density at `z`, up to a constant.

        JAX differentiates, compiles and maps it, so NumPyro and BlackJAX sample it. Near the fit
        it has the covariance and Student's t of the default intervals, farther out the misfit's
        own shape, in units of half a chi-squared: docs/identification.md, "Posterior". `priors`
        of `jq.fit` are in it. `jq.identify.LogDensity(fit)` is the same for many fits at once.

        **Arguments:**

        - `z`: one coordinate for each parameter, as of `fit.coordinates`.
        - `prior`: `jq.ensembles.Normal(deviation, mean=...)`, `LogNormal`, `Uniform`, `LogUniform`
            by the parameter's name, in its unit. Others are flat in `z`, that is in the logarithm
            of what keeps its sign; within six standard errors of zero, where that has no finite
            integral, flat in the value.
        - `model_error`: as in `interval`.

        **Raises:** ValueError for another number of coordinates, a distribution without density or
        of the other sign, and a fit by another cost or of `jq.refine`; KeyError for an unknown
        name; UndeterminedError where neither record nor prior bounds a parameter; PrecisionError
        in 32 bits.
        """
        return LogDensity(self, prior, model_error=model_error)(z)

    def __str__(self) -> str:
        lines = [] if self.identifiable else [str(self.verdict)]
        if self.verdict.fitted:
            lines += [*parameter_lines(concrete_values(self, "str(fit)")), *quality_lines(self)]
        return "\n".join(lines + [f"! {remark}" for remark in self.remarks])


def _content(fit: Fit) -> dict[str, object]:
    """The verdict of a fit, and the numbers where something was fitted."""
    verdict, discrepancy = fit.verdict, fit.discrepancy
    words = ("kind", "summary", "undetermined", "reasons", "remedies")
    bounds = [bound._asdict() for bound in verdict.bounds]
    content: dict[str, object] = {
        "identifiable": fit.identifiable,
        "verdict": {**{name: getattr(verdict, name) for name in words}, "bounds": bounds},
        "remarks": fit.remarks,
    }
    if not verdict.fitted:
        return content

    def numbers(value, error, determined, noise_error, interval) -> dict[str, object]:
        return {
            "value": value,
            "standard_error": error,
            "determined": bool(determined),
            "interval_95": interval(),
            "noise_standard_error": noise_error,
            "noise_interval_95": interval(model_error=False),
        }

    parameters, per_parameter = [], (fit.values, fit.standard_errors, fit.determined)
    for k, name in enumerate(fit.names):
        value, error, determined = (part[k] for part in per_parameter)
        facts = value, error, determined, fit.noise_standard_errors[k]
        parameters.append(
            {
                "name": name,
                "unit": fit.parameter_units[k] if fit.parameter_units else None,
                **numbers(*facts, ft.partial(fit.interval, name)),
                "width": None if discrepancy is None else discrepancy.widths[k],
                "cramer_rao_percent": fit.cramer_rao[k],
                "insensitivity_percent": fit.insensitivity[k],
            }
        )
    ties = []
    for tied in fit.tied:
        facts = tied.value, tied.standard_error, tied.determined, tied.noise_standard_error
        entry = {"name": tied.name, "tied_to": tied.follows}
        ties.append(entry | numbers(*facts, tied.interval))
    size = None
    if discrepancy is not None:
        size = {
            "amplitude_rad": discrepancy.amplitude,
            "length_ln_omega": discrepancy.length,
            "probability_of_none": discrepancy.none,
        }
    combinations = [one.content() | {"interval_95": one.interval} for one in fit.combinations]
    quality = ("cost", "average_cost", "chi_squared", "condition", "newton_decrement", "points")
    return {
        **content,
        "parameters": parameters,
        "tied": ties,
        "combinations": combinations,
        "null_directions": verdict.null_directions,
        "covariance": fit.covariance,
        "noise_covariance": fit.noise_covariance,
        "discrepancy": size,
        **{name: getattr(fit, name) for name in (*quality, "steps")},
    }
