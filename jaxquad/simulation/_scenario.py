import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float


class Scenario(eqx.Module):
    """What happens to a loop, sample by sample; a trailing axis makes an ensemble.

    A part that is the same for all members need not have that axis. With `rate` or `acceleration`
    of the reference the controller gets a `jq.control.Setpoint` and can feed them forward; one that is None
    counts as zero. `payload` is inertia that the plant carries in addition to its own.
    `jq.scenario(...)` builds a scenario from signals of single axes. Raises ValueError for arrays
    of different numbers of samples, axes or members.
    """

    reference: Float[Array, "samples axes ..."]  # attitude set-point, rad
    injection: Float[Array, "samples axes ..."]  # added to the command, V
    disturbance: Float[Array, "samples axes ..."]  # torque, N m
    noise: Float[Array, "samples axes ..."]  # on the measured angle, rad
    rate: Float[Array, "samples axes ..."] | None = None  # of the reference, rad/s
    acceleration: Float[Array, "samples axes ..."] | None = None  # of the reference, rad/s^2
    payload: Float[Array, "samples axes ..."] | None = None  # added inertia, kg m^2

    def __check_init__(self):
        parts = {name: part for name, part in vars(self).items() if part is not None}
        if not all(isinstance(part, jax.Array | np.ndarray) for part in parts.values()):
            return
        try:
            np.broadcast_shapes(*(part.shape[2:] for part in parts.values()))
            fit = len({part.shape[:2] for part in parts.values()}) == 1
        except ValueError:
            fit = False
        if not fit:
            shapes = ", ".join(f"{name} {part.shape}" for name, part in parts.items())
            raise ValueError(
                f"a scenario's arrays have different shapes: {shapes}; give all of them the same "
                "samples and axes, and one ensemble or none"
            )

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of all parts together, () for one loop."""
        parts = [part for part in vars(self).values() if part is not None]
        return np.broadcast_shapes(*(part.shape[2:] for part in parts))
