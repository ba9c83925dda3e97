from ._analysis import (
    analyse_loop as analyse_loop,
    loop_qualities as loop_qualities,
    LoopAnalysis as LoopAnalysis,
    LoopResponse as LoopResponse,
)
from ._case import without_idle_states as without_idle_states
from ._closed_loop import close as close, join as join, SampledLoop as SampledLoop
from ._gain_window import gain_window as gain_window, GainWindow as GainWindow
from ._sampled_axis import AxisParameters as AxisParameters, sampled as sampled
from ._spectrum import (
    abscissa as abscissa,
    noise_gain as noise_gain,
    powers as powers,
    sharpest as sharpest,
)
from .qualities._bandwidth import attitude_bandwidth as attitude_bandwidth, Bandwidth as Bandwidth
from .qualities._margins import Margins as Margins, margins as margins
from .qualities._rejection import (
    disturbance_rejection as disturbance_rejection,
    Rejection as Rejection,
)
from .qualities._rms import rms_response as rms_response, RmsResponse as RmsResponse
