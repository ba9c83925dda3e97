from ._distributions import (
    Choice as Choice,
    Fixed as Fixed,
    Law as Law,
    LogNormal as LogNormal,
    LogUniform as LogUniform,
    Normal as Normal,
    Uniform as Uniform,
)
from ._ensemble import Ensemble as Ensemble
from ._members import Members as Members, Payload as Payload
