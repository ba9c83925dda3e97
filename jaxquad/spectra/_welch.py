from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxquad.records import Record

from ._window import window


class Welch(eqx.Module):
    """Averaged spectra of overlapping windows at any frequencies (CIFER's FRESPID).

    `window_length` in s; by default a fifth of the longest record, so that five independent
    windows are averaged. `integrators` is the number of pure integrations between input and
    output: the output is differenced so many times before it is windowed, and the response divided
    by the differencing filter. That keeps the steep response of 1/s^n from leaking
    through the window (a 40 s Hann window is wrong by 10 % at 0.4 rad/s without it). `delay`, in s,
    is about how much the output lags the input: it is taken out before windowing and put back
    after, since a late output is weighed by another part of the window (1 % at the end of a sweep).
    `detrend` removes from each segment its "constant", its "linear" trend, or "none".
    """

    window_length: float | None = eqx.field(static=True, default=None)
    overlap: float = eqx.field(static=True, default=0.8)
    shape: str = eqx.field(static=True, default="hann")
    detrend: str = eqx.field(static=True, default="constant")
    integrators: int = eqx.field(static=True, default=0)
    delay: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        window(self.shape, 4)
        if not 0 <= self.overlap < 1:
            raise ValueError(f"overlap {self.overlap} is not in [0, 1): 0.5 or 0.8 are usual")
        if self.detrend not in ("none", "constant", "linear"):
            raise ValueError(f"detrend {self.detrend!r}: choose none, constant or linear")
        if self.integrators not in (0, 1, 2, 3):
            raise ValueError(f"integrators {self.integrators}: give 0 to 3 integrations")
        if not 0 <= self.delay < 10:
            raise ValueError(f"delay {self.delay} s: give 0 to 10 s")
        if self.window_length is not None and not self.window_length > 0:
            raise ValueError(f"window_length {self.window_length} s must be positive")

    def length(self, records: Sequence[Record]) -> int:
        """Samples to a window."""
        usable = max(record.samples for record in records) - self.integrators
        shortest = min(record.samples for record in records) - self.integrators
        seconds = self.window_length or usable * records[0].dt / 5
        length = int(round(seconds / records[0].dt))
        if length < 8 or length > shortest or (length == shortest and len(records) < 2):
            raise ValueError(
                f"a window of {seconds:.4g} s has {length} samples, the shortest record "
                f"{shortest}: at least two windows of 8 samples must fit; set window_length "
                f"below {shortest * records[0].dt / 2:.4g} s"
            )
        if self.delay >= length * records[0].dt:
            raise ValueError(
                f"a delay of {self.delay:.4g} s is not shorter than the window of {seconds:.4g} s"
            )
        return length

    def late(self, record: Record) -> int:
        """Samples of `delay`."""
        return int(round(self.delay / record.dt))

    def default_omega(self, records: Sequence[Record]) -> Float[np.ndarray, " frequencies"]:
        """100 log-spaced frequencies, from three cycles to a window to a tenth of the sample rate.

        Below, what leaks through the window outweighs the random error of a good record.
        """
        dt = records[0].dt
        length = self.length(records)
        if length <= 30:
            raise ValueError(
                f"a window of {length} samples resolves nothing below a tenth of the sample rate: "
                "set a longer window_length, or name the frequencies with omega="
            )
        return np.geomspace(6 * np.pi / (length * dt), 2 * np.pi / (10 * dt), 100)
