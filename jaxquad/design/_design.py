import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxquad.excitation import Excitation

from ._criteria import Criterion
from ._prediction import Prediction


class Design(eqx.Module):
    """A multisine of the most informative spectrum within limits, with what it will tell.

    `dispersion` says, for each offered line, what information power there would add for the share
    of the limits it takes, scaled as in the equivalence theorem: without a cap on the lines it
    nowhere exceeds the number of parameters, and equals it at the lines of the best design.
    `efficiency` is a lower bound on the flight time of the best spectrum with these limits, cap and
    crest factors, over that of this one, for the same information.
    """

    excitation: Excitation
    power: Float[np.ndarray, " frequencies"]  # mean square of each line of the excitation
    predictions: tuple[Prediction, ...]  # one for each model of an ensemble
    offered: Float[np.ndarray, " offered"]  # rad/s
    dispersion: Float[np.ndarray, " offered"]
    efficiency: float = eqx.field(static=True)
    limits: dict[str, tuple[float, float]]  # peak, and its limit
    crest_factor: float = eqx.field(static=True)  # peak over root mean square
    criterion: Criterion
    lines: int = eqx.field(static=True)  # none takes more than 1/lines of the limits

    @property
    def prediction(self) -> Prediction:
        """For the first model."""
        return self.predictions[0]

    @property
    def omega(self) -> Float[np.ndarray, " frequencies"]:
        """The lines in rad/s."""
        return self.excitation.lines

    @property
    def standard_errors(self) -> Float[np.ndarray, " parameters"]:
        """Predicted, relative, for the first model."""
        return self.prediction.standard_errors

    @property
    def cramer_rao(self) -> Float[np.ndarray, " parameters"]:
        """Predicted, as CIFER's, in per cent, for the first model."""
        return self.prediction.cramer_rao

    @property
    def log_determinant(self) -> float:
        """Of the information of relative changes, for the first model."""
        return self.prediction.log_determinant

    def __str__(self) -> str:
        share = np.sort(self.power)[::-1].cumsum() / self.power.sum()
        most = int(np.searchsorted(share, 0.9) + 1)
        peaks = ", ".join(f"{n} {p:.4g} of {limit:.4g}" for n, (p, limit) in self.limits.items())
        models = f", averaged over {len(self.predictions)} models" * (len(self.predictions) > 1)
        return "\n".join(
            [
                f"{type(self.criterion).__name__} multisine{models}: {self.omega.size} of "
                f"{self.offered.size} lines, {most} with 90 % of the power (lines={self.lines})",
                str(self.excitation),
                f"peaks: {peaks}; crest factor {self.crest_factor:.3f}",
                f"dispersion at most {self.dispersion.max():.4f} for {len(self.prediction.names)} "
                f"parameters; efficiency at least {np.floor(1000 * self.efficiency) / 10:.1f} % "
                "of the best with these limits, cap and crest factors",
                str(self.prediction),
            ]
        )
