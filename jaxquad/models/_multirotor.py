"""A multirotor with its motors, and two vehicles whose numbers are published."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Bool, Float

from jaxquad._core import (
    align,
    as_float,
    ensemble_shape,
    is_concrete,
    is_zero,
    per_member,
    require_positive,
)

from ._attitude import (
    add_inertia,
    Attitude,
    DecoupledAxes,
    euler_from_quaternion,
    Four,
    LinearAxis,
    quaternion_derivative,
    quaternion_from_euler,
    Vector,
)


Motors = Float[Array, " motors *ensemble"]


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

    **Raises:** `ValueError`: convention or input is unknown, or a value is not positive.
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

    def torque(self, inputs: Four) -> Vector:
        """Body torque in N m of the four motor `inputs`: Eq. (9)."""
        return align(self.torque_per_difference, inputs) * self.differences(inputs)

    def differences(self, inputs: Four) -> Vector:
        """The differences of inputs that Eq. (9) multiplies by lever K_t and K_l: V4 - V2 etc."""
        return _product(self._signs, inputs)

    def inputs(self, torque: Vector, collective: Float[Array, "*ensemble"] | float) -> Four:
        """The four motor inputs that give a body `torque` in N m about a mean input `collective`.

        Eq. (10) has no row for the thrust, so `collective` (the bias voltage of the Hover) makes
        the answer unique. The rows are orthogonal, hence the inverse is a scaled transpose.
        """
        return self.from_differences(torque / align(self.torque_per_difference, torque), collective)

    def from_differences(
        self, wanted: Vector, collective: Float[Array, "*ensemble"] | float
    ) -> Four:
        """The four motor inputs with these `differences` about a mean input `collective`."""
        squares = np.sum(self._signs**2, axis=1, keepdims=True)
        common = align(jnp.asarray(collective, dtype=wanted.dtype)[None], wanted)
        return common + _product((self._signs / squares).T, wanted)

    def spin(self, inputs: Four) -> Float[Array, "*ensemble"]:
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
    def torque_per_difference(self) -> Vector:
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


class MotorLag(eqx.Module):
    """Motor and propeller as a first-order lag from the commanded to the effective input.

    **Arguments:** `time_constant`: in s, one value or `[*ensemble]`.

    **Raises:** `ValueError`: the time constant is not positive. A motor without lag has no state.
    """

    time_constant: Float[Array, "*ensemble"] = per_member(rank=0, converter=as_float)  # s

    def __check_init__(self):
        remedy = "to model a motor without lag, leave the lag out (motor=None, lag=None)"
        require_positive("time_constant", self.time_constant, remedy)

    def derivative(self, state: Motors, command: Motors) -> Motors:
        """Rate of change of the effective input, in units of `command` per s."""
        return (command - state) / align(self.time_constant[None], state)

    def step(self, state: Motors, command: Motors, dt: float | Float[Array, ""]) -> Motors:
        """The effective input after `dt` seconds of a held `command`, exactly."""
        return command + (state - command) * jnp.exp(-dt / align(self.time_constant[None], state))


class MultirotorState(eqx.Module):
    """The state of a `Multirotor`, or its time derivative."""

    quaternion: Four  # body to earth, scalar first; any length but 0
    rate: Vector  # body axes, rad/s
    motor: Four | None  # effective motor inputs; None without a lag


class Multirotor(eqx.Module):
    """A multirotor's attitude from motor inputs to Euler angles.

    Every parameter may have a trailing ensemble axis; then states, inputs and outputs have it too.
    Source: Eq. (1)-(10) of the paper, corrected as docs/equations.md lists.

    **Arguments:**

    - `attitude`: the rigid body; `allocation`: from inputs to torques.
    - `motor`: the lag of the motors, or None for none.

    **Raises:** `ValueError`: the attitude has a rotor inertia, but the inputs are voltages, which
    do not determine the rotor speeds.
    """

    attitude: Attitude
    allocation: Allocation
    motor: MotorLag | None = None

    def __check_init__(self):
        rotor_inertia = self.attitude.rotor_inertia
        spins = is_concrete(rotor_inertia) and not is_zero(rotor_inertia)
        if spins and self.allocation.input == "voltage":
            raise ValueError(
                f"rotor_inertia is {rotor_inertia}, but voltages do not determine the rotor "
                'speeds: set it to 0, or use an Allocation with input="omega2".'
            )

    @property
    def ensemble(self) -> tuple[int, ...]:
        """The trailing shape of the parameters, () for one vehicle."""
        return ensemble_shape(self)

    @property
    def torque_gain(self) -> Vector:
        """N m per unit of the command of an axis, see `Allocation.torque_per_difference`."""
        return self.allocation.torque_per_difference

    def init(
        self, euler: ArrayLike | Sequence | None = None, *, ensemble: tuple[int, ...] = ()
    ) -> MultirotorState:
        """At rest at the Euler angles `euler` in rad (level if None), with the motors stopped.

        The state is as wide as `ensemble`, the parameters and `euler` ask for together.
        """
        dtype = self.attitude.inertia.dtype
        euler = jnp.zeros(3, dtype) if euler is None else jnp.asarray(euler, dtype)
        shape = jnp.broadcast_shapes(self.ensemble, ensemble, euler.shape[1:])
        rate = jnp.zeros((3, *shape), euler.dtype)
        quaternion = quaternion_from_euler(jnp.broadcast_to(align(euler, rate), rate.shape))
        motor = None if self.motor is None else jnp.zeros((4, *shape), euler.dtype)
        return MultirotorState(quaternion, rate, motor)

    def derivative(
        self, state: MultirotorState, inputs: Four, disturbance: Vector
    ) -> MultirotorState:
        """Time derivative of `state` under motor `inputs` and a `disturbance` torque in N m."""
        motor = inputs if state.motor is None else state.motor
        torque = self.allocation.torque(motor) + disturbance
        if self.attitude.stiffness is not None:
            torque = torque + self.attitude.restoring_torque(self.measure(state))
        return MultirotorState(
            quaternion_derivative(state.quaternion, state.rate),
            self.attitude.acceleration(state.rate, torque, self.allocation.spin(motor)),
            None if self.motor is None else self.motor.derivative(motor, inputs),
        )

    def measure(self, state: MultirotorState) -> Vector:
        """Euler angles in rad: what encoders or an attitude filter report."""
        length = jnp.linalg.norm(state.quaternion, axis=0, keepdims=True)
        return euler_from_quaternion(state.quaternion / length)

    def is_resolved(self, state: MultirotorState) -> Bool[Array, "*ensemble"]:
        """Whether the quaternion still has about unit length.

        It loses it where a vehicle turns through more than about a radian in an integration step.
        """
        w, x, y, z = state.quaternion
        square = w * w + x * x + y * y + z * z
        return (square > 0.25) & (square < 4)

    def with_added_inertia(self, inertia: Float[ArrayLike, "..."]) -> "Multirotor":
        """The same vehicle carrying a known extra `inertia` in kg m^2, such as a payload."""
        return eqx.tree_at(
            lambda p: p.attitude.inertia, self, add_inertia(self.attitude.inertia, inertia)
        )

    def linearise(self, axis: int) -> LinearAxis:
        """One axis near level flight, driven by the allocation's differences, see `decoupled`."""
        return self.decoupled().linearise(axis)

    def decoupled(self) -> DecoupledAxes:
        """The three axes near level flight, driven by the allocation's differences.

        A `jq.simulation.MotorDrive` turns these, such as V4 - V2, into voltages. Gyroscopic terms
        and the coupling of the axes are of second order and left out.
        """
        attitude, allocation = self.attitude, self.allocation
        return DecoupledAxes(
            allocation.torque_per_difference,
            attitude.inertia,
            lag=None if self.motor is None else self.motor.time_constant[None],
            damping=attitude.damping,
            stiffness=0.0 if attitude.stiffness is None else attitude.stiffness,
            coulomb=attitude.coulomb,
        )


class HoverDataSheet(NamedTuple):
    """The data sheet of the Quanser 3 DOF Hover.

    Source: user manual, Table 2.2, and `config_hover.m`. The inertias are computed there from point
    masses at the arm tips; they are no measurement.
    """

    arm: float = 0.197  # m, 7.75 in
    thrust_coefficient: float = 0.1188  # N/V
    torque_coefficient: float = 0.0036  # N m/V
    inertia: tuple[float, float, float] = (0.0552, 0.0552, 0.110)  # kg m^2
    mass: float = 2.85  # kg
    encoder_counts: int = 8192  # per revolution
    voltage_limit: float = 24.0  # V, either sign
    bias_voltage: float = 2.0  # V on each motor


QUANSER_HOVER = HoverDataSheet()


def quanser_hover(
    *, lag: float | None = 0.02, damping: Sequence[float] = (0.0, 0.0, 0.0),
    stiffness: Sequence[float] | None = None, coulomb: Sequence[float] | None = None,
    convention: str = "frd-frbl",
) -> Multirotor:  # fmt: skip
    """The test stand of the paper's section 5, the Quanser 3 DOF Hover, driven by four voltages.

    Source: the data sheet, `QUANSER_HOVER`, which gives none of the arguments.

    **Arguments:**

    - `lag`: of the propellers in s; 0.02 s is an assumption. None leaves it out.
    - `damping`: in N m s/rad; `stiffness`: in N m/rad; `coulomb`: dry friction in N m; per axis.
    - `convention`: of `Allocation`.
    """
    sheet = QUANSER_HOVER
    return Multirotor(
        Attitude(sheet.inertia, damping=damping, stiffness=stiffness, coulomb=coulomb),
        Allocation(
            sheet.arm, sheet.thrust_coefficient, sheet.torque_coefficient, convention=convention
        ),
        None if lag is None else MotorLag(lag),
    )


class CrazyflieDataSheet(NamedTuple):
    """Bitcraze's Crazyflie 2.0, as identified on the bench.

    Source: J. Foerster, System identification of the Crazyflie 2.0 nano quadrocopter, bachelor
    thesis, ETH Zurich, 2015, doi 10.3929/ethz-b-000214143, as quoted by Bitcraze's firmware and
    several simulators: diagonal of the inertia (products of inertia reach 11 % of it and are left
    out), ratio of torque to thrust, and the polynomials that give thrust and rotor speed over the
    16-bit command, whose ratio is the thrust coefficient. The arm is the firmware's; others quote
    0.040 m.
    """

    arm: float = 0.046  # m, centre to rotor
    thrust_coefficient: float = 1.28192e-8  # N s^2: 2.130295e-11 / 0.04076521^2
    torque_coefficient: float = 7.6461e-11  # N m s^2: 0.005964552 of the thrust
    inertia: tuple[float, float, float] = (16.571710e-6, 16.655602e-6, 29.261652e-6)  # kg m^2
    mass: float = 0.028  # kg
    lag: float = 0.0647  # s, 1 / 15.4666 rad/s from command to thrust
    top_speed: float = 3052.0  # rad/s, at a command of 65535

    @property
    def hover_input(self) -> float:
        """Squared speed in rad^2/s^2 at which four rotors carry the mass."""
        return self.mass * 9.81 / (4 * self.thrust_coefficient)


CRAZYFLIE = CrazyflieDataSheet()


def crazyflie(
    *, lag: float | None = CRAZYFLIE.lag, damping: Sequence[float] = (0.0, 0.0, 0.0)
) -> Multirotor:
    """A Crazyflie 2.0, driven by four squared rotor speeds in rad^2/s^2.

    An "x" frame in the axes of the firmware (forward, left, up), without the spin of the rotors.
    Source: the data sheet, `CRAZYFLIE`.

    **Arguments:**

    - `lag`: of the thrust in s; None leaves it out.
    - `damping`: in N m s/rad per axis, which the data sheet does not give.
    """
    sheet = CRAZYFLIE
    return Multirotor(
        Attitude(sheet.inertia, damping=damping),
        Allocation(
            sheet.arm,
            sheet.thrust_coefficient,
            sheet.torque_coefficient,
            convention="crazyflie",
            input="omega2",
        ),
        None if lag is None else MotorLag(lag),
    )
