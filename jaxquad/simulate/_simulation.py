import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxquad.models._parameters import align
from jaxquad.records import Record

from ._authority import Authority
from ._scenario import AXES, Scenario


class Simulation(eqx.Module):
    """What a simulated loop did, sample by sample.

    A member that left the angles that count as flown is held where it was, with command 0, and
    `diverged` tells it apart: its numbers are finite, but they describe no flight.
    """

    time: Float[Array, " samples"]  # s
    angle: Float[Array, " samples axes *ensemble"]  # true, rad
    measurement: Float[Array, " samples axes *ensemble"]  # rad
    command: Float[Array, " samples axes *ensemble"]  # achieved, V
    saturated: Bool[Array, " samples axes *ensemble"]  # the drive gave less than was asked
    signals: dict[str, Array]  # of the controller, [samples, axes, *ensemble]
    diverged: Bool[Array, "*ensemble"]
    scenario: Scenario  # as it was given
    dt: float = eqx.field(static=True, default=0.002)  # s
    authority: Authority | None = None  # None: of a plant that does not tell it

    @property
    def reference(self) -> Float[Array, " samples axes *ensemble"]:
        """The set-point in rad."""
        return self._wide(self.scenario.reference)

    @property
    def injection(self) -> Float[Array, " samples axes *ensemble"]:
        """What was added to the controller's command, V."""
        return self._wide(self.scenario.injection)

    @property
    def disturbance(self) -> Float[Array, " samples axes *ensemble"]:
        """Torque in N m."""
        return self._wide(self.scenario.disturbance)

    def record(self, axis: str = "roll", *, member: int | None = None) -> Record:
        """The axis as it would be logged: achieved command, measured angle, injected sweep.

        `member` picks one of an ensemble. Raises `ValueError` for an axis that does not exist, and
        for a member that diverged.
        """
        k = self._index(axis)
        if member is None and self.angle.ndim > 2:
            raise ValueError(
                f"an ensemble of shape {self.angle.shape[2:]} has many records: pick one, member=0"
            )
        if np.asarray(self.diverged)[() if member is None else member]:
            raise ValueError("the loop diverged, and what is not flown is no record: stabilise it")
        place = (slice(None), k) if member is None else (slice(None), k, member)
        command, angle, sweep = (
            np.asarray(x[place]) for x in (self.command, self.measurement, self.injection)
        )
        excited = np.ptp(sweep) > 0
        return Record(
            np.asarray(self.time), command, angle, sweep if excited else None,
            input_names=f"{axis}_command", output_names=f"{axis}_angle",
            reference_names="sweep" if excited else None,
            input_units="V", output_units="rad", reference_units="V" if excited else None,
            source="simulation",
        )  # fmt: skip

    def _index(self, axis: str) -> int:
        names = AXES[: self.angle.shape[1]]
        if axis not in names:
            raise ValueError(f"axis {axis!r}: choose one of {', '.join(names)}")
        return names.index(axis)

    def _wide(self, x: Float[Array, "samples axes ..."]) -> Array:
        return jnp.broadcast_to(align(x, self.angle), self.angle.shape)
