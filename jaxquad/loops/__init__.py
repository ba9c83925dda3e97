from jaxquad._core import per_member as per_member

from ._analysis import (
    analyse as analyse,
    loop_qualities as loop_qualities,
    LoopAnalysis as LoopAnalysis,
    LoopResponse as LoopResponse,
)
from ._closed_loop import close as close, join as join, OpenLoop as OpenLoop
from ._gain_window import gain_window as gain_window, GainWindow as GainWindow
from ._linear_parts import without_idle_states as without_idle_states
from ._loop import Loop as Loop
from ._protocols import (
    after_drive as after_drive,
    CarriesPayload as CarriesPayload,
    ChecksState as ChecksState,
    Controller as Controller,
    Drive as Drive,
    Plant as Plant,
    prepared as prepared,
    sample_interval as sample_interval,
    Sensor as Sensor,
    signals_of as signals_of,
)
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
