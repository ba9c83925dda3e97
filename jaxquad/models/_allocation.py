from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import align, as_float, per_member, require_positive


class _Frame(NamedTuple):
    signs: np.ndarray  # of roll, pitch and yaw torque (rows) under more of each motor's input
    lever: float  # of a rotor about the roll and pitch axes, in arms


_DIAGONAL = 0.5**0.5
_FRAMES = {
    "frd-frbl": _Frame(np.array([[0, -1, 0, 1], [1, 0, -1, 0], [1, -1, 1, -1]]), 1.0),
    "quanser": _Frame(np.array([[0, 0, 1, -1], [1, -1, 0, 0], [-1, -1, 1, 1]]), 1.0),
    "px4-x": _Frame(np.array([[-1, 1, 1, -1], [1, -1, 1, -1], [1, 1, -1, -1]]), _DIAGONAL),
    "crazyflie": _Frame(np.array([[-1, -1, 1, 1], [-1, 1, 1, -1], [-1, 1, -1, 1]]), _DIAGONAL),
}
_INPUTS = ("voltage", "omega2")


class Allocation(eqx.Module):
    """From four motor inputs to three body torques, for "+" and "x" frames.

    Seen from above, the front and back rotors turn anticlockwise, or those at front right and back
    left. In an "x" the lever is arm / sqrt(2).
    Source: Eq. (9), (10) of the paper.

    **Arguments:**

    - `arm`: from centre to rotor in m.
    - `thrust_coefficient`: in N/V or N s^2; `torque_coefficient`: in N m/V or N m s^2.
    - `convention`: the body axes and the order of the rotors.
        "frd-frbl", the paper's "+": forward, right, down; front, right, back, left.
        "quanser", a "+" of the maker of the Hover: back, right, up; front, back, right, left.
        "px4-x", ArduPilot's too: forward, right, down; front right, back left, front left, back
        right.
        "crazyflie", an "x": forward, left, up; front right, back right, back left, front left.
    - `input`: the "voltage" of a motor, or its squared speed "omega2".

    **Raises:**

    - `ValueError`: convention or input is unknown, or a value is not positive.
    """

    arm: Float[Array, "..."] = per_member(rank=0, converter=as_float)  # L
    thrust_coefficient: Float[Array, "..."] = per_member(rank=0, converter=as_float)  # K_t
    torque_coefficient: Float[Array, "..."] = per_member(rank=0, converter=as_float)  # K_l
    convention: str = eqx.field(static=True, default="frd-frbl")
    input: str = eqx.field(static=True, default="voltage")

    def __check_init__(self):
        for name, names in {"convention": tuple(_FRAMES), "input": _INPUTS}.items():
            if getattr(self, name) not in names:
                raise ValueError(
                    f"{name} is {getattr(self, name)!r}, but it must be one of {names}."
                )
        require_positive("arm", self.arm, "give the distance from centre to rotor in m")
        remedy = "give its magnitude; the convention says which way each rotor turns"
        require_positive("thrust_coefficient", self.thrust_coefficient, remedy)
        require_positive("torque_coefficient", self.torque_coefficient, remedy)

    @property
    def matrix(self) -> Float[Array, " 3 4 *ensemble"]:
        """U of Eq. (10), N m per unit of motor input."""
        signs = jnp.asarray(self._signs, dtype=self.arm.dtype)
        effect = self.torque_per_difference[:, None]
        return align(signs, effect) * effect

    def torque(self, inputs: Float[Array, " 4 *ensemble"]) -> Float[Array, " 3 *ensemble"]:
        """Body torque in N m of the four motor `inputs`: Eq. (9)."""
        return align(self.torque_per_difference, inputs) * self.differences(inputs)

    def differences(self, inputs: Float[Array, " 4 *ensemble"]) -> Float[Array, " 3 *ensemble"]:
        """The differences of inputs that Eq. (9) multiplies by lever K_t and K_l: V4 - V2 etc."""
        return _product(self._signs, inputs)

    def inputs(
        self, torque: Float[Array, " 3 *ensemble"], collective: Float[Array, "*ensemble"] | float
    ) -> Float[Array, " 4 *ensemble"]:
        """The four motor inputs that give a body `torque` in N m about a mean input `collective`.

        Eq. (10) has no row for the thrust, so `collective` (the bias voltage of the Hover) makes
        the answer unique. The rows are orthogonal, hence the inverse is a scaled transpose.
        """
        return self.from_differences(torque / align(self.torque_per_difference, torque), collective)

    def from_differences(
        self, wanted: Float[Array, " 3 *ensemble"], collective: Float[Array, "*ensemble"] | float
    ) -> Float[Array, " 4 *ensemble"]:
        """The four motor inputs with these `differences` about a mean input `collective`."""
        squares = np.sum(self._signs**2, axis=1, keepdims=True)
        common = align(jnp.asarray(collective, dtype=wanted.dtype)[None], wanted)
        return common + _product((self._signs / squares).T, wanted)

    def spin(self, inputs: Float[Array, " 4 *ensemble"]) -> Float[Array, "*ensemble"]:
        """Spin in rad/s for `Attitude.acceleration`; 0 where voltages leave the speeds unknown.

        Its signs are those of the yaw torque, since both come from the rotors' sense of turning.
        """
        if self.input == "voltage":
            return jnp.zeros(inputs.shape[1:], inputs.dtype)
        turning = inputs > 0
        speed = jnp.where(turning, jnp.sqrt(jnp.where(turning, inputs, 1)), 0)  # finite gradient
        return _product(self._signs[2:], speed)[0]

    @property
    def _signs(self) -> np.ndarray:
        return _FRAMES[self.convention].signs

    @property
    def torque_per_difference(self) -> Float[Array, " 3 *ensemble"]:
        """Torque in N m per unit of `differences`, axis by axis."""
        lever = _FRAMES[self.convention].lever * self.arm * self.thrust_coefficient
        return jnp.stack(jnp.broadcast_arrays(lever, lever, self.torque_coefficient))


def _product(matrix: np.ndarray, vectors: Float[Array, " n *ensemble"]) -> Array:
    # Plain sums: a matrix product would end the one kernel that a time loop is compiled to.
    rows = [
        sum(float(weight) * x for weight, x in zip(row, vectors, strict=True) if weight)
        for row in matrix
    ]
    return jnp.stack(rows)
