from ._composite import Composite as Composite
from ._deembed import deembed as deembed
from ._density import spectral_density as spectral_density, SpectralDensity as SpectralDensity
from ._distortion import Distortion as Distortion
from ._errors import ErrorCovariance as ErrorCovariance, independent_errors as independent_errors
from ._estimate import Estimator as Estimator, frequency_response as frequency_response
from ._frequency_response import FrequencyResponse as FrequencyResponse
from ._joint import JointInputOutput as JointInputOutput
from ._local_polynomial import LocalPolynomial as LocalPolynomial
from ._periodic import Periodic as Periodic
from ._precision import (
    PrecisionError as PrecisionError,
    require_float64 as require_float64,
    require_x64 as require_x64,
)
from ._pull import Feedback as Feedback, feedback_pull as feedback_pull
from ._welch import Welch as Welch
