import functools as ft
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float

from jaxquad.records import Record

from ._welch import Welch


_LENGTHS = 5
_CYCLES = 20  # of the highest frequency, in the shortest window


class Composite(eqx.Module):
    """Several window lengths, combined at every frequency (CIFER's FRESPID and COMPOSITE).

    Long windows serve the low frequencies, short ones average more and serve the high ones. Each
    pair's spectra are weighed by (eps_i / eps_min)^-4 of their random errors. `windows` are lengths
    in s; by default five, log-spaced from a third of all records together (half a record at most)
    to 20 cycles of the highest frequency. Lengths are rounded to whole blocks of samples that they
    share. The other options are those of `jq.Welch`.
    """

    windows: tuple[float, ...] | None = eqx.field(static=True, default=None)
    overlap: float = eqx.field(static=True, default=0.8)
    shape: str = eqx.field(static=True, default="hann")
    detrend: str = eqx.field(static=True, default="constant")
    integrators: int = eqx.field(static=True, default=0)
    delay: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        if self.windows is not None and len(set(self.windows)) < max(len(self.windows), 1):
            raise ValueError(f"windows {self.windows}: give one or more different lengths in s")
        for length in self.windows or (None,):
            self._member(length)

    def members(
        self, records: Sequence[Record], omega: Float[ArrayLike, " frequencies"] | None
    ) -> tuple[Welch, ...]:
        """One estimator for each window length, the longest first."""
        lengths = self.windows or self._lengths(records, omega)
        return tuple(self._member(length) for length in sorted(lengths, reverse=True))

    def _lengths(
        self, records: Sequence[Record], omega: Float[ArrayLike, " frequencies"] | None
    ) -> list[float]:
        dt = records[0].dt
        spans = [(record.samples - self.integrators) * dt for record in records]
        longest = min(max(spans) / 2, sum(spans) / 3, min(spans) * 0.9)
        highest = 2 * np.pi / (10 * dt) if omega is None else float(np.max(omega))
        shortest = np.clip(_CYCLES * 2 * np.pi / highest, longest / 10, longest)
        return np.unique(np.geomspace(shortest, longest, _LENGTHS)).tolist()

    def _member(self, length: float | None) -> Welch:
        return _welch(length, self.overlap, self.shape, self.detrend, self.integrators, self.delay)


# Making and checking a module takes as long as transforming one window length.
_welch = ft.lru_cache(maxsize=64)(Welch)
