from collections.abc import Sequence
from typing import NamedTuple

from ._allocation import Allocation
from ._attitude import Attitude
from ._motor import MotorLag
from ._plant import Multirotor


class HoverDataSheet(NamedTuple):
    """What the maker says about the Quanser 3 DOF Hover.

    Source: user manual, Table 2.2, and `config_hover.m`. The inertias are computed there, from
    point masses at the arm tips; they are no measurement.
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
    convention: str = "frd-frbl",
) -> Multirotor:
    """The rig of the paper's section 5, the Quanser 3 DOF Hover, driven by four voltages.

    The data sheet gives no propeller `lag`: 0.02 s is an assumption, and None leaves it out.
    `damping` (N m s/rad) and `stiffness` (N m/rad) are not in it either.
    """
    sheet = QUANSER_HOVER
    return Multirotor(
        Attitude(sheet.inertia, damping=damping, stiffness=stiffness),
        Allocation(
            sheet.arm, sheet.thrust_coefficient, sheet.torque_coefficient, convention=convention
        ),
        None if lag is None else MotorLag(lag),
    )
