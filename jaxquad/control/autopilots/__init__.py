"""The rate loops of Betaflight, PX4, ArduPilot and Crazyflie, and the filters that they run."""

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
