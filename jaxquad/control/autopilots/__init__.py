"""The rate loops of Betaflight, PX4, ArduPilot and Crazyflie, and the filters that they run."""

from ._ardupilot import ArduPilotAttitude as ArduPilotAttitude, ArduPilotRate as ArduPilotRate
from ._betaflight import (
    adrc_b0 as adrc_b0,
    BetaflightADRC as BetaflightADRC,
    BetaflightAngle as BetaflightAngle,
    BetaflightPID as BetaflightPID,
    DMax as DMax,
    dynamic_cutoff as dynamic_cutoff,
    ItermRelax as ItermRelax,
    tpa_factor as tpa_factor,
)
from ._crazyflie import CrazyflieAttitude as CrazyflieAttitude, CrazyflieRate as CrazyflieRate
from ._filters import (
    ardupilot_notch as ardupilot_notch,
    BandwidthNotch as BandwidthNotch,
    betaflight_quality as betaflight_quality,
    Butterworth as Butterworth,
    Filter as Filter,
    FilterChain as FilterChain,
    FilterShare as FilterShare,
    Notch as Notch,
    PT1 as PT1,
    PT2 as PT2,
    PT3 as PT3,
    Section as Section,
)
from ._flown import (
    ardupilot_loop as ardupilot_loop,
    betaflight_loop as betaflight_loop,
    FlownBetaflight as FlownBetaflight,
    FlownLoop as FlownLoop,
    px4_loop as px4_loop,
    replay_terms as replay_terms,
)
from ._law import FirmwareLoop as FirmwareLoop, LoopState as LoopState
from ._px4 import PX4Attitude as PX4Attitude, PX4Rate as PX4Rate
