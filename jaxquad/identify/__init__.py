from ._combination import Combination as Combination
from ._cost import (
    CoherenceWeighted as CoherenceWeighted,
    Cost as Cost,
    MaximumLikelihood as MaximumLikelihood,
)
from ._fit import fit as fit
from ._guess import guess_lagged_integrator as guess_lagged_integrator
from ._identifiable import NotIdentifiable as NotIdentifiable
from ._parameters import Positive as Positive, Real as Real
from ._problem import Prior as Prior
from ._result import Fit as Fit
from ._verify import Verification as Verification, verify as verify
