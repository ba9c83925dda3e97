from collections.abc import Sequence
from typing import NamedTuple

from ._allocation import Allocation
from ._attitude import Attitude
from ._multirotor import MotorLag, Multirotor


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
    *,
    lag: float | None = 0.02,
    damping: Sequence[float] = (0.0, 0.0, 0.0),
    stiffness: Sequence[float] | None = None,
    coulomb: Sequence[float] | None = None,
    convention: str = "frd-frbl",
) -> Multirotor:
    """The test stand of the paper's section 5, the Quanser 3 DOF Hover, driven by four voltages.

    Source: the data sheet, `QUANSER_HOVER`, which gives none of the arguments.

    **Arguments:**

    - `lag`: of the propellers in s; 0.02 s is an assumption. None leaves it out.
    - `damping`: in N m s/rad; `stiffness`: in N m/rad; `coulomb`: dry friction in N m; per axis.
    - `convention`: of `Allocation`.

    **Returns:**

    A `Multirotor`.
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

    **Returns:**

    A `Multirotor`.
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
