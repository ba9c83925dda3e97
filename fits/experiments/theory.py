"""What linear theory expects of a disturbed nominal loop."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad.loops import LoopAnalysis, LoopResponse

from .data import Case, Group, Members
from .designs import Design
from .nominal import nominal_loops


def theory_rms(
    case: Case, members: Members, group: Group, design: Design, suite: dict[str, Any]
) -> float:
    """Rms of the angle in deg under the signal that `theory` names; infinite if unstable."""
    spec = case.data["theory"]
    loops = nominal_loops(design, suite["plants"][case.data["plant"]], suite["dt"]).member(0)
    if not bool(loops.stable):
        return float("inf")
    first = lambda value: float(members.of(value)[group.place[0]])
    if spec["signal"] == "sine":
        omega = jnp.array([2 * np.pi / spec["period"]])
        gain = float(_gain(loops.disturbance, omega)[0])
        return float(np.degrees(first(spec["amplitude"]) * gain / np.sqrt(2)))
    if spec["signal"] == "gust":
        corner, deviation = spec["corner"], first(spec["deviation"])
        omega = np.geomspace(1e-3, 0.99 * np.pi / suite["dt"], 2000)
        gain = np.asarray(_gain(loops.disturbance, jnp.asarray(omega)))
        density = 2 * deviation**2 * corner / (omega**2 + corner**2)
        return float(np.degrees(np.sqrt(np.trapezoid(gain**2 * density, omega) / np.pi)))
    raise ValueError(f"no theory of a {spec['signal']!r}: there are sine and gust")


def integral_gain(loop: LoopAnalysis, inertia: float) -> float:
    """ki of b u in 1/s^3: under a step of `load` in N m the angle integrates to load/(J ki)."""
    omega = 1e-4  # rad/s
    return omega / (inertia * float(_gain(loop.disturbance, jnp.array([omega]))[0]))


@eqx.filter_jit
def _gain(
    response: LoopResponse, omega: Float[Array, " frequencies"]
) -> Float[Array, " frequencies"]:
    return jnp.abs(response.frequency_response(omega)[:, 0, 0])
