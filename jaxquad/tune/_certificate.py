from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ._certificate_text import described, verdict
from ._distance import Distance
from ._judged import Judged
from ._row import Row, row_of


class Certificate(eqx.Module):
    """What a design was shown to do, on members of an ensemble that its tuner never saw.

    It `holds` if no member is linearly unstable (by the exact poles), none diverged in flight, no
    observer is unstable by itself (it would run away in saturation), and every limit is met; the
    first line of `str()` says so, or what failed by how much and where. None unstable of n members
    drawn at random proves a share: at most 1.2 % with 95 % confidence for n = 256
    (Clopper-Pearson), and no more than that. Numbers are SI; print is in degrees.
    The first of the `designs` is the one that is certified; the others are peers on the same
    members and noise. Numbers of the linear loop leave out members that are unstable, counted in
    `rows`. Of several axes each member counts by its worst one, but for the integrals in `rows`,
    which are sums.
    """

    designs: dict[str, Judged]  # by name; what is certified comes first
    distances: tuple[Distance, ...]  # to each limit
    facts: dict[str, Float[np.ndarray, "axes members"]]  # inertia, torque_gain, lag, delay, told
    nominal: Float[np.ndarray, " axes"] | None  # inertia, kg m^2; None if it is not known
    provenance: dict[str, Any]  # key, members, sampling, versions
    remarks: tuple[str, ...]

    @property
    def name(self) -> str:
        """Of the design that is certified."""
        return next(iter(self.designs))

    @property
    def design(self) -> Judged:
        """The numbers of the design that is certified, of each member."""
        return self.designs[self.name]

    @property
    def members(self) -> int:
        return self.design.members

    @property
    def stable(self) -> bool:
        """No member is linearly unstable, none diverged, and no observer is unstable by itself."""
        design = self.design
        return design.unstable_count == 0 and not design.diverged.any() and not design.runaway

    @property
    def holds(self) -> bool:
        return self.stable and all(distance.met for distance in self.distances)

    @property
    def independent(self) -> bool:
        """Whether the members were drawn independently, as a confidence bound presumes."""
        return self.provenance["sampling"] == "random"

    @property
    def rows(self) -> dict[str, Row]:
        """Statistics of each design over the members."""
        known = self.independent
        return {name: row_of(x, independent=known) for name, x in self.designs.items()}

    def member(self, index: int) -> dict[str, Float[np.ndarray, " axes"]]:
        """The parameters of one member, per axis, in SI units."""
        return {name: values[:, index] for name, values in self.facts.items()}

    def content(self) -> dict[str, Any]:
        """Everything, arrays per member included, for `jaxquad.report.write_json`."""
        return {
            "certificate": verdict(self),
            "holds": self.holds,
            "provenance": self.provenance,
            "limits": [distance._asdict() | {"met": distance.met} for distance in self.distances],
            "designs": {name: row.content() for name, row in self.rows.items()},
            "remarks": self.remarks,
            "members": self.facts | {"nominal_inertia": self.nominal},
            "per_member": {name: _arrays(design) for name, design in self.designs.items()},
        }

    def __str__(self) -> str:
        return described(self)


def _arrays(design: Judged) -> dict[str, Any]:
    flags = {"unstable": design.unstable, "diverged": design.diverged}
    return flags | {name: design.of(name) for name in design.by_axis}
