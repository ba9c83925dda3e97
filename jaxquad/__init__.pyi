from . import (
    autopilot as autopilot,
    control as control,
    datasets as datasets,
    design as design,
    ensembles as ensembles,
    excitation as excitation,
    export as export,
    identify as identify,
    loops as loops,
    models as models,
    plot as plot,
    records as records,
    report as report,
    simulation as simulation,
    spectra as spectra,
    tuning as tuning,
    workflows as workflows,
)
from ._compile import enable_compile_cache as enable_compile_cache, engine as engine
from ._core import __version__ as __version__, enable_x64 as enable_x64
from .control import (
    AdaptiveLADRC as AdaptiveLADRC,
    LADRC as LADRC,
    PID as PID,
)
from .ensembles import Ensemble as Ensemble
from .excitation import multisine as multisine, sweep as sweep
from .export import c_header as c_header
from .identify import (
    compare as compare,
    fit as fit,
    fit_state_space as fit_state_space,
    fit_transfer_function as fit_transfer_function,
    predict as predict,
    refine as refine,
    verify as verify,
)
from .loops import analyse as analyse, Loop as Loop
from .models import (
    crazyflie as crazyflie,
    DecoupledAxes as DecoupledAxes,
    LaggedIntegrator as LaggedIntegrator,
    quanser_hover as quanser_hover,
    StateSpace as StateSpace,
    TransferFunction as TransferFunction,
)
from .records import (
    propose as propose,
    read as read,
    Record as Record,
)
from .simulation import (
    evaluate as evaluate,
    Pulse as Pulse,
    scenario as scenario,
    simulate as simulate,
    Step as Step,
)
from .spectra import (
    frequency_response as frequency_response,
    FrequencyResponse as FrequencyResponse,
)
from .tuning import (
    certify as certify,
    Limit as Limit,
    Objective as Objective,
    tune as tune,
)
from .workflows import load_result as load_result
