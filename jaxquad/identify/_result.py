import equinox as eqx
import numpy as np
from jaxtyping import Float, PyTree

from ._combination import Combination
from ._identifiable import Identifiability
from ._table import fit_table


class Fit(eqx.Module):
    """An identified model with its doubts; `str(fit)` is the table for a report.

    Numbers that the record does not determine are `nan`, with an infinite standard error: their
    determined combinations are in `combinations`. `cramer_rao` and `insensitivity` are CIFER's, in percent
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
    chi_squared: float  # squared misfit over random error, per degree of freedom
    newton_decrement: float  # what one more Gauss-Newton step would lower the cost by
    condition: float  # of the scaled Jacobian
    points: int  # frequencies used, over all responses
    steps: int
    identifiability: Identifiability
    remarks: tuple[str, ...] = eqx.field(static=True)

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

    def __str__(self) -> str:
        return fit_table(self)
