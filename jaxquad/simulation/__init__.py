from ._authority import (
    Authority as Authority,
    authority as authority,
    AuthorityWarning as AuthorityWarning,
    find_authority as find_authority,
)
from ._check_run import check_run as check_run
from ._compose import scenario as scenario
from ._disturbances import (
    ceti_gust as ceti_gust,
    gauss_markov as gauss_markov,
    Gust as Gust,
    Pulse as Pulse,
    WhiteNoise as WhiteNoise,
)
from ._evaluate import evaluate as evaluate, metrics as metrics
from ._excite import excite as excite
from ._hardware import Encoder as Encoder, MotorDrive as MotorDrive, Saturation as Saturation
from ._meter import (
    divisor as divisor,
    makes_step as makes_step,
    wide as wide,
    Window as Window,
    window as window,
)
from ._metrics import Metrics as Metrics, Spread as Spread, Summary as Summary
from ._over_devices import loop_over_devices as loop_over_devices, over_devices as over_devices
from ._references import (
    Ramp as Ramp,
    ReferenceModel as ReferenceModel,
    Sine as Sine,
    SmoothStep as SmoothStep,
    Step as Step,
)
from ._run import run_ensemble as run_ensemble, scan_loop as scan_loop
from ._sample import runge_kutta as runge_kutta
from ._scenario import Scenario as Scenario
from ._signal import Clock as Clock, Motion as Motion, Signal as Signal
from ._simulate import simulate as simulate, Simulation as Simulation
from ._slices import in_slices as in_slices
