"""The chirps that a log holds, and which of them a proposal is for."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

from .._errors import RecordError


Point = Literal["", "rate", "mixer", "angle"]


class NumberedChirp(NamedTuple):
    """One of the chirps that a log holds.

    `number` counts them in the order of time, from 1; `axis` is empty where it turns none; `place`
    says in words what it was added to; `low` and `high` are its band, 0 where it is unknown.
    """

    number: int
    axis: str
    place: str
    point: Point
    start: float  # s
    stop: float
    low: float = 0.0  # Hz
    high: float = 0.0

    def __str__(self) -> str:
        band = f", {self.low:.4g} .. {self.high:.4g} Hz" if 0 < self.low < self.high else ""
        span = f"t = {self.start:.6g} .. {self.stop:.6g} s"
        return f"{self.number}: {self.axis or 'no axis'}, {self.place}, {span}{band}"


class Selection(NamedTuple):
    """What a proposal is for: an axis, one of the log's chirps, a span of time; None: all."""

    axis: str | None = None
    chirp: int | None = None  # its number
    start: float | None = None  # s
    stop: float | None = None

    def part_of(self, chirp: NumberedChirp) -> NumberedChirp | None:
        """What the span leaves of a chirp."""
        start = chirp.start if self.start is None else max(chirp.start, self.start)
        stop = chirp.stop if self.stop is None else min(chirp.stop, self.stop)
        return chirp._replace(start=start, stop=stop) if start < stop else None


def choose_chirps(chirps: Sequence[NumberedChirp], wanted: Selection) -> list[NumberedChirp]:
    """The chirp of that number; else the longest within the span and on the axis that are wanted.

    With it come all others on its axis at its place. One that turns no axis is taken where there is
    no other. Raises RecordError for a number that no chirp has.
    """
    if wanted.chirp is not None:
        return [_numbered(chirps, wanted)]
    inside = [part for chirp in chirps if (part := wanted.part_of(chirp))]
    turning = [chirp for chirp in inside if chirp.axis]
    candidates = [chirp for chirp in turning if wanted.axis in (None, chirp.axis)]
    candidates = candidates if turning else inside
    if not candidates:
        return []
    best = max(candidates, key=lambda chirp: chirp.stop - chirp.start)
    return [x for x in candidates if (x.axis, x.place) == (best.axis, best.place)]


def _numbered(chirps: Sequence[NumberedChirp], wanted: Selection) -> NumberedChirp:
    listed = "; ".join(map(str, chirps)) or "none"
    chirp = next((x for x in chirps if x.number == wanted.chirp), None)
    if chirp is None:
        raise RecordError(f"there is no chirp {wanted.chirp}. Chirps of this log: {listed}.")
    if wanted.axis not in (None, chirp.axis):
        raise RecordError(
            f"chirp {wanted.chirp} is not on the axis {wanted.axis}: leave one of them out. Chirps "
            f"of this log: {listed}."
        )
    part = wanted.part_of(chirp)
    if part is None:
        raise RecordError(
            f"chirp {wanted.chirp} lies outside the span of start and stop: leave them out. Chirps "
            f"of this log: {listed}."
        )
    return part
