"""Closed loops in time: scenarios, signals, sensors, drives, metrics."""

from jaxquad._compile import run_ensemble as run_ensemble

from ._flight_metrics import (
    find_steps as find_steps,
    FlightMetrics as FlightMetrics,
    Window as Window,
    window as window,
)
from ._hardware import (
    Authority as Authority,
    authority as authority,
    AuthorityWarning as AuthorityWarning,
    beyond_authority as beyond_authority,
    Encoder as Encoder,
    find_authority as find_authority,
    MotorDrive as MotorDrive,
    RotorDrive as RotorDrive,
    Saturation as Saturation,
)
from ._metrics import (
    evaluate as evaluate,
    Metrics as Metrics,
    metrics as metrics,
    Spread as Spread,
    Summary as Summary,
)
from ._parallel import (
    Devices as Devices,
    devices_for as devices_for,
    in_slices as in_slices,
    loop_over_devices as loop_over_devices,
    over_cores as over_cores,
    over_devices as over_devices,
    placed as placed,
)
from ._scenario import excite as excite, Scenario as Scenario, scenario as scenario
from ._signal import (
    ceti_gust as ceti_gust,
    Clock as Clock,
    gauss_markov as gauss_markov,
    Gust as Gust,
    Motion as Motion,
    Pulse as Pulse,
    Ramp as Ramp,
    Signal as Signal,
    Sine as Sine,
    SmoothStep as SmoothStep,
    Step as Step,
    WhiteNoise as WhiteNoise,
)
from ._simulate import (
    check_run as check_run,
    scan_loop as scan_loop,
    simulate as simulate,
    Simulation as Simulation,
)
from ._step import runge_kutta as runge_kutta, SampleResult as SampleResult
