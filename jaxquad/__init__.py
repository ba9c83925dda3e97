"""From a flight record to an identified model with honest error bars, in JAX."""

from .control import PD as PD, place_pd as place_pd
from .excitation import (
    check_guidelines as check_guidelines,
    doublet as doublet,
    Excitation as Excitation,
    harmonics as harmonics,
    multisine as multisine,
    sweep as sweep,
    three_two_one_one as three_two_one_one,
)
from .identify import (
    CoherenceWeighted as CoherenceWeighted,
    Combination as Combination,
    Fit as Fit,
    fit as fit,
    guess_lagged_integrator as guess_lagged_integrator,
    MaximumLikelihood as MaximumLikelihood,
    NotIdentifiable as NotIdentifiable,
    Positive as Positive,
    Prior as Prior,
    Real as Real,
    reduce_structure as reduce_structure,
    Reduction as Reduction,
    Verification as Verification,
    verify as verify,
)
from .models import (
    Allocation as Allocation,
    Attitude as Attitude,
    AttitudeAxis as AttitudeAxis,
    LaggedIntegrator as LaggedIntegrator,
    MotorLag as MotorLag,
    Multirotor as Multirotor,
    QUANSER_HOVER as QUANSER_HOVER,
    quanser_hover as quanser_hover,
    realise as realise,
    simulate_linear as simulate_linear,
    TransferFunction as TransferFunction,
)
from .records import (
    Channel as Channel,
    channels as channels,
    detrend as detrend,
    mix as mix,
    read as read,
    ReadError as ReadError,
    Record as Record,
    RecordError as RecordError,
    RecordWarning as RecordWarning,
    resample as resample,
    select as select,
    trim as trim,
)
from .simulate import (
    Encoder as Encoder,
    excite as excite,
    gauss_markov as gauss_markov,
    MotorDrive as MotorDrive,
    Scenario as Scenario,
    simulate as simulate,
    Simulation as Simulation,
)
from .spectra import (
    Composite as Composite,
    ErrorCovariance as ErrorCovariance,
    frequency_response as frequency_response,
    FrequencyResponse as FrequencyResponse,
    independent_errors as independent_errors,
    JointInputOutput as JointInputOutput,
    PrecisionError as PrecisionError,
    spectral_density as spectral_density,
    SpectralDensity as SpectralDensity,
    Welch as Welch,
)
