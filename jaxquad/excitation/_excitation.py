from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float


Kind = Literal["sweep", "multisine", "doublet", "3-2-1-1"]


class Excitation(eqx.Module):
    """A test signal with uniform time stamps from 0 s.

    The band `omega_min` .. `omega_max` is the range of a sweep, the lowest and highest line of a
    multisine, and for a pulse the band around the peak of its spectrum within 3 dB. `duration` is
    that of the excited part, without the zeros before and after it.
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
        """Number of samples."""
        return self.time.size

    def __str__(self) -> str:
        return (
            f"{self.kind}: {self.omega_min:.4g} to {self.omega_max:.4g} rad/s "
            f"({self.omega_min / (2 * np.pi):.3g} to {self.omega_max / (2 * np.pi):.3g} Hz), "
            f"amplitude {self.amplitude:.4g}, {self.duration:.6g} s excited of "
            f"{self.time[-1]:.6g} s at {self.sample_rate:.6g} Hz"
        )
