from ._batch_result import BatchFit as BatchFit
from ._fit_batch import fit_batch as fit_batch
from ._gain_over_throttle import (
    gain_over_throttle as gain_over_throttle,
    throttle_levels as throttle_levels,
    ThrottledIntegrator as ThrottledIntegrator,
)
from ._guess_discrete import guess_discrete as guess_discrete
from ._known_filters import (
    behind_filters as behind_filters,
    filter_response as filter_response,
    KnownFilter as KnownFilter,
    measured_chain as measured_chain,
    MeasuredChain as MeasuredChain,
    without_filters as without_filters,
)
from ._thrust_curve import (
    actuator as actuator,
    B0Law as B0Law,
    B0Schedule as B0Schedule,
    curve_of_parameter as curve_of_parameter,
    CurveFirmware as CurveFirmware,
    FirmwareValue as FirmwareValue,
    GainBand as GainBand,
    GainOverThrottle as GainOverThrottle,
    PlantsOverThrottle as PlantsOverThrottle,
    ScaledB0 as ScaledB0,
    ThrottleLevels as ThrottleLevels,
)
from .frequency_domain._black_box import (
    BalancedStateSpace as BalancedStateSpace,
    fit_state_space as fit_state_space,
    StateSpaceFit as StateSpaceFit,
)
from .frequency_domain._cost import (
    coherence_weight as coherence_weight,
    CoherenceWeighted as CoherenceWeighted,
    Cost as Cost,
    MaximumLikelihood as MaximumLikelihood,
    paper_cost as paper_cost,
    Points as Points,
    usable as usable,
    WIDER_BAND as WIDER_BAND,
)
from .frequency_domain._fit import (
    fit as fit,
    guess_lagged_integrator as guess_lagged_integrator,
    solve_from_many as solve_from_many,
    spread_starts as spread_starts,
)
from .frequency_domain._parameters import (
    Changed as Changed,
    Free as Free,
    name_places as name_places,
    Parameters as Parameters,
    Place as Place,
    Positive as Positive,
    Real as Real,
    select_parameters as select_parameters,
    with_values as with_values,
)
from .frequency_domain._problem import (
    make_problem as make_problem,
    Prior as Prior,
    Problem as Problem,
    residuals as residuals,
)
from .frequency_domain._refits import (
    Bands as Bands,
    Candidate as Candidate,
    Explanation as Explanation,
)
from .frequency_domain._result import Fit as Fit
from .frequency_domain._sampled import as_sampled as as_sampled
from .frequency_domain._solve import least_squares as least_squares, Minimum as Minimum
from .frequency_domain._structure import (
    fit_damped as fit_damped,
    reduce_structure as reduce_structure,
    Reduction as Reduction,
)
from .frequency_domain._transfer_function import (
    fit_transfer_function as fit_transfer_function,
    guess_transfer_function as guess_transfer_function,
)
from .output_error._compare import compare as compare, Comparison as Comparison
from .output_error._noise import (
    ARMA as ARMA,
    AutoRegressive as AutoRegressive,
    Noise as Noise,
    NoiseModel as NoiseModel,
)
from .output_error._predict import Prediction as Prediction, WhiteNoise as WhiteNoise
from .output_error._problem import (
    KnownController as KnownController,
    SampledFeedback as SampledFeedback,
)
from .output_error._refine import refine as refine
from .output_error._simulated import (
    HasTransferFunction as HasTransferFunction,
    integrate_plant as integrate_plant,
    linear_model as linear_model,
)
from .output_error._verify import (
    Agreement as Agreement,
    AGREES as AGREES,
    CONTRADICTS as CONTRADICTS,
    GOOD_TIC as GOOD_TIC,
    predict as predict,
    Verification as Verification,
    verify as verify,
    WEAK as WEAK,
)
from .uncertainty._derived import (
    check_drawable as check_drawable,
    draw_models as draw_models,
    Factor as Factor,
    Factors as Factors,
    factors as factors,
    known_covariance as known_covariance,
    model_response as model_response,
    ResponseBand as ResponseBand,
    step_response as step_response,
    StepBand as StepBand,
    Tied as Tied,
)
from .uncertainty._discrepancy import Discrepancy as Discrepancy
from .uncertainty._log_density import LogDensity as LogDensity
from .uncertainty._misfit import MISFIT as MISFIT
from .uncertainty._verdict import (
    Bound as Bound,
    Combination as Combination,
    UndeterminedError as UndeterminedError,
    Verdict as Verdict,
)
