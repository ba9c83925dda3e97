from ._density import spectral_density as spectral_density, SpectralDensity as SpectralDensity
from ._estimate import (
    frequency_response as frequency_response,
    JointInputOutput as JointInputOutput,
)
from ._frequency_response import FrequencyResponse as FrequencyResponse
from ._precision import (
    PrecisionError as PrecisionError,
    require_float64 as require_float64,
    require_x64 as require_x64,
)
from ._welch import Welch as Welch
