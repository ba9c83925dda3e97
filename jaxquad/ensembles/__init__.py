"""Uncertain plants: distributions, members drawn from them, the posterior of a fit."""

from ._distributions import (
    Choice as Choice,
    Distribution as Distribution,
    Fixed as Fixed,
    LogNormal as LogNormal,
    LogUniform as LogUniform,
    Normal as Normal,
    Uniform as Uniform,
)
from ._ensemble import Ensemble as Ensemble
from ._members import Members as Members, Payload as Payload
from ._posterior import make_plant as make_plant, Posterior as Posterior
