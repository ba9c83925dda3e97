from ._actuator import MotorDrive as MotorDrive, Saturation as Saturation
from ._authority import (
    Authority as Authority,
    authority as authority,
    AuthorityWarning as AuthorityWarning,
)
from ._chunks import run_ensemble as run_ensemble
from ._compile import (
    compiler_options as compiler_options,
    Engine as Engine,
    engine as engine,
)
from ._compose import scenario as scenario
from ._disturbances import (
    ceti_gust as ceti_gust,
    Gust as Gust,
    Pulse as Pulse,
    WhiteNoise as WhiteNoise,
)
from ._evaluate import evaluate as evaluate, metrics as metrics
from ._excite import excite as excite
from ._integrate import runge_kutta as runge_kutta
from ._metrics import Metrics as Metrics
from ._noise import gauss_markov as gauss_markov
from ._over_devices import over_devices as over_devices
from ._references import (
    Ramp as Ramp,
    ReferenceModel as ReferenceModel,
    Sine as Sine,
    SmoothStep as SmoothStep,
    Step as Step,
)
from ._scenario import Scenario as Scenario
from ._sensor import Encoder as Encoder
from ._signal import Clock as Clock, Motion as Motion, Signal as Signal
from ._simulate import simulate as simulate
from ._simulation import Simulation as Simulation
from ._slices import in_slices as in_slices
from ._summary import Spread as Spread, Summary as Summary
