from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float


Kind = Literal["sweep", "multisine", "doublet", "3-2-1-1"]


class Excitation(eqx.Module):
    """A test signal on its own uniform clock, which starts at 0 s.

    The band `omega_min` .. `omega_max` is what a sweep runs through, the lowest and highest line
    of a multisine, and for a pulse the band around the peak of its spectrum that stays within
    3 dB of it. `duration` is that of the excited part, without the zeros before and after it.
    """

    time: Float[np.ndarray, " samples"]  # s
    signal: Float[np.ndarray, " samples"]  # in the unit of the amplitude
    lines: Float[np.ndarray, " frequencies"]  # rad/s, of a multisine; none for the others
    kind: Kind = eqx.field(static=True)
    omega_min: float = eqx.field(static=True, converter=float)  # rad/s
    omega_max: float = eqx.field(static=True, converter=float)  # rad/s
    amplitude: float = eqx.field(static=True, converter=float)  # peak
    sample_rate: float = eqx.field(static=True, converter=float)  # Hz
    duration: float = eqx.field(static=True, converter=float)  # s
    lead_in: float = eqx.field(static=True, converter=float, default=0.0)  # s at omega_min
    lead: float = eqx.field(static=True, converter=float, default=0.0)  # s of zeros before
    tail: float = eqx.field(static=True, converter=float, default=0.0)  # s of zeros after

    @property
    def samples(self) -> int:
        return self.time.size

    def __str__(self) -> str:
        return (
            f"{self.kind}: {self.omega_min:.4g} .. {self.omega_max:.4g} rad/s, amplitude "
            f"{self.amplitude:.4g}, {self.duration:.6g} s excited of {self.time[-1]:.6g} s at "
            f"{self.sample_rate:.6g} Hz"
        )
