import equinox as eqx

from ._composite import Composite
from ._local_polynomial import LocalPolynomial
from ._periodic import Periodic
from ._welch import Welch


class JointInputOutput(eqx.Module):
    """Response by way of outside references r: G = S_ry S_ru^-1, unbiased in closed loop.

    The noise that the controller feeds back to the input is uncorrelated with the reference,
    so it averages out; in the direct estimate it does not. `spectra` is any of the estimators.
    Needs one reference for each input, and none that a feedback computes. Source: joint
    input-output method, Tischler & Remple; instrumental variables.
    """

    spectra: Welch | Composite | LocalPolynomial | Periodic = LocalPolynomial()
