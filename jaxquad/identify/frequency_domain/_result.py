"""An identified model with its doubts: values, errors, covariance, verdict."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Complex, Float, Key, PyTree

from jaxquad._core import Message, plain_content, pytree_node
from jaxquad.records import Record

from ..output_error._noise import NoiseModel
from ..output_error._simulated import linear_model
from ..output_error._verify import Verification, verify
from ..uncertainty._curves import (
    fitted_response,
    fitted_step_response,
    pole_reach,
    ResponseBand,
    StepBand,
)
from ..uncertainty._derived import derive, Tied, tied_parameters
from ..uncertainty._draw_models import draw_models, known_covariance
from ..uncertainty._error_budget import Discrepancy, Matrix
from ..uncertainty._verdict import (
    Combination,
    pooled_freedom,
    reach_of_interval,
    UndeterminedError,
    USUAL,
    Verdict,
)
from ._fit_content import fit_content, fit_table
from ._parameters import Parameters
from ._refits import Bands, explain_misfit, Explanation, fit_bands, Origin
from ._starts import Minimum


@pytree_node
class Fit:
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

    def __getitem__(self, name: str) -> float:
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
        return float(self.values[k])

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
        """Simulate the model on a record and compare: `jq.verify(fit, record)`.

        **Arguments:**

        - `record`: one that was not fitted.
        - `band`: (low, high) in rad/s, to compare within; by default `used_band`.
        - `hold`: as in `jq.verify`.

        **Returns:** a `jq.identify.Verification`, with the simulated output.

        **Raises:** what `jq.verify` raises; UndeterminedError where nothing was fitted.
        """
        self._require_model("a simulation")
        band = self.used_band if band is None else band
        return verify(self.model, record, band=band, hold=hold)

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
        return pole_reach(self, self._covariance_of_curves())

    def step_response(self, time: Float[ArrayLike, " samples"]) -> StepBand:
        """The answer to a unit step of each input, with its 95 % band, model error included.

        **Arguments:**

        - `time`: equally spaced, from 0, in s.

        **Returns:** a `jq.identify.StepBand`: `time`, `value`, `low`, `high`.

        **Raises:** ValueError for other times, for a model that cannot be simulated, and where
        nothing was fitted.
        """
        self._require_model("a step response")
        return fitted_step_response(self, time, self._covariance_of_curves())

    def response_band(self, omega: Float[ArrayLike, " frequencies"]) -> ResponseBand:
        """The frequency response with its 95 % band, model error included, by first order.

        **Arguments:**

        - `omega`: in rad/s.

        **Returns:** a `jq.identify.ResponseBand`.

        **Raises:** ValueError where nothing was fitted.
        """
        self._require_model("a response")
        return fitted_response(self, omega, self._covariance_of_curves())

    def _covariance_of_curves(self) -> Matrix:
        """Of relative changes. Directions along which no response changes are left out."""
        return self.relative_covariance if self.identifiable else known_covariance(self)

    def to_dict(self) -> dict[str, object]:
        """All numbers as JSON holds them, as in `result.json`: None for what is not finite."""
        return plain_content(fit_content(self))

    def interval(
        self, name: str, *, level: float | int = USUAL, model_error: bool = True
    ) -> tuple[float, float]:
        """The 95 % interval of one parameter; of one that keeps its sign, what has that sign.

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
        reach = reach_of_interval(float(self.degrees_of_freedom[k]), level) * errors[k]
        low, high = float(self.values[k] - reach), float(self.values[k] + reach)
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

        **Returns:**

        A `jq.identify.Combination`, by first-order propagation of the covariance.

        **Raises:**

        - `UndeterminedError`: the quantity depends on what the record does not determine.
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

        **Returns:** a `jq.identify.Bands`, a table in print.

        **Raises:**

        - `ValueError`: the fit is not one of `jq.fit`.
        """
        return fit_bands(self)

    def explain(self) -> Explanation:
        """Which further term the responses want, where the model does not explain them.

        The model is fitted again with one more pole or zero, a pair of them, rate damping, or the
        slow pair of a hovering vehicle; the lowest information criterion (BIC) decides.

        **Returns:** a `jq.identify.Explanation`, a table in print.

        **Raises:**

        - `ValueError`: the fit is not one of `jq.fit`.
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

        **Returns:**

        A model like `Fit.model`.

        **Raises:**

        - `UndeterminedError`: the record leaves parameters undetermined, and these are not held.
        - `ValueError`: the fit found no minimum, or has no finite standard errors.
        """
        if isinstance(n, bool) or not isinstance(n, int | np.integer) or n < 1:
            raise ValueError(f"n is {n}: give a whole number of models, 1 or more")
        if not (isinstance(key, jax.Array) and jnp.issubdtype(key.dtype, jax.dtypes.prng_key)):
            raise ValueError(f"key is {key!r}: give a jax.random.key(0)")
        scores = jax.random.normal(key, (len(self.names), n))
        return draw_models(self, scores, hold_undetermined=hold_undetermined)

    def __str__(self) -> str:
        return fit_table(self)
