from ._combination import Combination as Combination
from ._cost import (
    CoherenceWeighted as CoherenceWeighted,
    Cost as Cost,
    MaximumLikelihood as MaximumLikelihood,
)
from ._factors import Factor as Factor, Factors as Factors, factors as factors
from ._fit import fit as fit
from ._fit_batch import BatchFit as BatchFit, fit_batch as fit_batch
from ._guess import guess_lagged_integrator as guess_lagged_integrator
from ._identifiable import NotIdentifiable as NotIdentifiable
from ._output_error import refine as refine
from ._parameters import Positive as Positive, Real as Real
from ._problem import Prior as Prior
from ._reduce import reduce_structure as reduce_structure, Reduction as Reduction
from ._result import Fit as Fit
from ._starts import Minimum as Minimum
from ._transfer_function_fit import fit_transfer_function as fit_transfer_function
from ._transfer_function_guess import guess_transfer_function as guess_transfer_function
from ._verification import Agreement as Agreement, Verification as Verification
from ._verify import verify as verify
