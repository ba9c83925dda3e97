"""Closed loops: `Loop`, its linear analysis, handling qualities."""

from jaxquad._core import align as align, per_member as per_member

from ._analysis import (
    analyse as analyse,
    linear_numbers as linear_numbers,
    loop_numbers as loop_numbers,
    LoopAnalysis as LoopAnalysis,
    LoopNumbers as LoopNumbers,
    LoopResponse as LoopResponse,
)
from ._bandwidth import attitude_bandwidth as attitude_bandwidth, Bandwidth as Bandwidth
from ._gain_window import gain_window as gain_window, GainWindow as GainWindow
from ._loop import Loop as Loop
from ._margins import (
    disturbance_rejection as disturbance_rejection,
    Margins as Margins,
    margins as margins,
    Rejection as Rejection,
)
from ._protocols import (
    after_drive as after_drive,
    CarriesPayload as CarriesPayload,
    ChecksState as ChecksState,
    Controller as Controller,
    Drive as Drive,
    LinearisablePlant as LinearisablePlant,
    Plant as Plant,
    prepared as prepared,
    sample_interval as sample_interval,
    Sensor as Sensor,
    signals_of as signals_of,
)
from ._rms import rms_response as rms_response, RmsResponse as RmsResponse
