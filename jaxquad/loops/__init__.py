"""Closed loops: `Loop`, its linear analysis, handling qualities."""

from jaxquad._core import align as align, per_member as per_member

from ._analysis import (
    analyse as analyse,
    gain_window as gain_window,
    GainWindow as GainWindow,
    linear_numbers as linear_numbers,
    loop_numbers as loop_numbers,
    LoopAnalysis as LoopAnalysis,
    LoopNumbers as LoopNumbers,
    LoopResponse as LoopResponse,
)
from ._bandwidth import attitude_bandwidth as attitude_bandwidth, Bandwidth as Bandwidth
from ._loop import (
    CarriesPayload as CarriesPayload,
    ChecksState as ChecksState,
    Controller as Controller,
    Drive as Drive,
    LinearisablePlant as LinearisablePlant,
    Loop as Loop,
    Plant as Plant,
    Sensor as Sensor,
)
from ._margins import (
    disturbance_rejection as disturbance_rejection,
    Margins as Margins,
    margins as margins,
    Rejection as Rejection,
)
