import math

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float

from ._delay import delay_line, DelayLine
from ._protocols import Drive
from ._sensor import Encoder


class Settings(eqx.Module):
    """How a loop is run."""

    dt: float = eqx.field(static=True)  # s
    drive: Drive | None
    encoder: Encoder | None
    line: DelayLine | None
    substeps: int = eqx.field(static=True)
    bound: float = eqx.field(static=True)  # rad


def loop_settings(
    *,
    dt: float = 0.002,
    drive: Drive | None = None,
    encoder: Encoder | None = None,
    delay: Float[ArrayLike, "*ensemble"] = 0.0,
    longest_delay: float | None = None,
    substeps: int = 1,
    bound: float = 100.0,
) -> Settings:
    """The options of `simulate`, checked. Raises ValueError for what makes no sense."""
    if not (dt > 0 and math.isfinite(dt)):
        raise ValueError(f"dt is {dt} s: give a positive sample interval")
    if not (isinstance(substeps, int | np.integer) and substeps >= 1):
        raise ValueError(f"substeps is {substeps}: give a whole number of steps, 1 or more")
    if not (bound > 0 and math.isfinite(bound)):
        raise ValueError(f"bound is {bound} rad: give the largest angle that still counts as flown")
    line = delay_line(delay, dt, longest_delay)
    return Settings(dt, drive, encoder, line, int(substeps), float(bound))
