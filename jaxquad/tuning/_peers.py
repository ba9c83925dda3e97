"""Designs that a tuned one is compared with."""

import numpy as np
from jaxtyping import Float, PyTree

from jaxquad.control import certainty_equivalence, LADRC, ScheduledLADRC
from jaxquad.models import DecoupledAxes, Multirotor, QUANSER_HOVER

from ._problem import decouple, Plant


WC, WO = 10.0, 30.0  # rad/s, the paper's
KNOWN_INERTIA = "b0 = KT/J"  # the name of the design that knows the inertia
PAPER_B0 = (3.0, 1.6)  # before and after the paper's adaptation, rad/s^2 per V
# +u and -u on two motors: the one convention in which the paper's gains are stable
HOVER_GAIN = 2 * QUANSER_HOVER.arm * QUANSER_HOVER.thrust_coefficient / QUANSER_HOVER.inertia[0]


def paper_designs(plant: Plant, *, dt: float = 0.002) -> dict[str, LADRC]:
    """The paper's two LADRCs for a plant: 10 and 30 rad/s with b0 = 3, and with b0 = 1.6.

    On the roll axis of the Quanser Hover (b = 0.848 rad/s^2 per V) b0 is exactly that. On another
    plant or axis it has the same ratio to b: 3.54 and 1.89. Source: section 5 of the paper,
    docs/equations.md.

    **Arguments:**

    - `plant`: the nominal `jq.DecoupledAxes` or `jq.models.Multirotor`, without an ensemble.
    - `dt`: the sample interval in s.

    **Returns:**

    The designs by name, for `peers=` of a tune or certificate.

    **Raises:**

    - `ValueError`: the plant is an ensemble, or of another kind.
    """
    KT, J = _nominal_numbers(plant)
    b = KT / J
    designs = {}
    for b0 in PAPER_B0:
        given = b0 * b / HOVER_GAIN
        on_hover = np.allclose(given, b0, rtol=2e-3)
        name = f"paper b0 = {b0:g}" if on_hover else f"paper b0 = {b0 / HOVER_GAIN:.3g} b"
        designs[name] = LADRC(WC, WO, b0 * np.ones_like(b) if on_hover else given, dt=dt)
    return designs


def peers(plant: Plant, *, pid: PyTree | None = None, dt: float = 0.002) -> dict[str, PyTree]:
    """Designs to stand beside a tuned one in its certificate, by name.

    The paper's two, and "b0 = KT/J": the LADRC with the paper's bandwidths, 10 and 30 rad/s, whose
    b0 is exact for the inertia that the controller is given (certainty equivalence).

    **Arguments:**

    - `plant`, `dt`: as for `jq.tuning.paper_designs`.
    - `pid`: a PID tuned on the same ensemble, to add as "tuned PID".

    **Returns:**

    The designs by name.

    **Raises:**

    - `ValueError`: as `jq.tuning.paper_designs` does.
    """
    KT, J = _nominal_numbers(plant)
    # As a map of ln J, b0 = KT / J is straight: two knots, far apart, hold it everywhere.
    map = certainty_equivalence(KT, J, span=(1e-3, 1e3), knots=2)
    designs: dict[str, PyTree] = dict(paper_designs(plant, dt=dt))
    designs[KNOWN_INERTIA] = ScheduledLADRC(LADRC(WC, WO, KT / J, dt=dt), map)
    return designs if pid is None else designs | {"tuned PID": pid}


def _nominal_numbers(
    plant: Plant,
) -> tuple[Float[np.ndarray, " axes"], Float[np.ndarray, " axes"]]:
    """KT in N m per unit of command and J in kg m^2, in NumPy: nothing is compiled."""
    axes = _nominal(plant)
    KT, J = np.broadcast_arrays(np.asarray(axes.torque_gain, float), np.asarray(axes.inertia))
    return KT, J


def _nominal(plant: Plant) -> DecoupledAxes:
    if not isinstance(plant, DecoupledAxes | Multirotor):
        raise ValueError(
            f"the plant is a {type(plant).__name__}: give the nominal jq.DecoupledAxes or "
            "jq.models.Multirotor, such as loop.plant"
        )
    axes = decouple(plant)
    if len(axes.shape) > 1:
        raise ValueError(
            f"the plant is an ensemble of {axes.shape[1:]}: give the nominal one, for whose "
            "gain the designs are made"
        )
    return axes
