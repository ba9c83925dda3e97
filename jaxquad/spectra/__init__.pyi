from ._actuator import TWO_LAGS as TWO_LAGS, TwoLags as TwoLags
from ._error_covariance import (
    ErrorCovariance as ErrorCovariance,
    independent_errors as independent_errors,
)
from ._estimators import (
    Composite as Composite,
    DOMINATED as DOMINATED,
    EARLY as EARLY,
    Estimator as Estimator,
    in_hertz as in_hertz,
    JointInputOutput as JointInputOutput,
    LocalPolynomial as LocalPolynomial,
    Periodic as Periodic,
    Remark as Remark,
    Welch as Welch,
)
from ._feedback import (
    deembed as deembed,
    feedback_bias as feedback_bias,
    FeedbackBias as FeedbackBias,
    spectral_density as spectral_density,
    SpectralDensity as SpectralDensity,
)
from ._flown_loop import (
    BrokenLoop as BrokenLoop,
    Entry as Entry,
    estimate_broken_loop as estimate_broken_loop,
    estimate_step as estimate_step,
    StepResponse as StepResponse,
)
from ._frequency_response import (
    Distortion as Distortion,
    frequency_response as frequency_response,
    FrequencyResponse as FrequencyResponse,
)
from ._noise import find_line as find_line, SpectralLine as SpectralLine
from ._other_inputs import compare_with_input as compare_with_input, OtherInput as OtherInput
