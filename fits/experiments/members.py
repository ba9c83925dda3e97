"""The linear loop of every member of a flown ensemble."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from jaxquad.simulation import Simulation

from .data import Case, Members, Numbers
from .designs import Belief, controller, Design
from .linear import analysed
from .nominal import WIDTH
from .rigs import lateness, linear_axis


def linear_numbers(
    case: Case,
    chunk: Members,
    suite: dict[str, Any],
    design: Design,
    belief: Belief,
    done: Simulation,
) -> Numbers:
    """Ms and stability of each member with its true inertia and torque gain.

    An adaptive controller is evaluated with the b0 that it had reached at the end.
    """
    level = suite["plants"][case.data["plant"]]
    changes = {name: chunk.of(x) for name, x in case.data.get("overrides", {}).items()}
    law = controller(plain(design), belief, dt=suite["dt"])
    if "b0" in done.signals:
        law = eqx.tree_at(lambda x: x.b0, law, jnp.asarray(done.signals["b0"][-1]))
    loops = analysed(linear_axis(level, WIDTH, changes), law, lateness(level, WIDTH))
    unstable = ~np.asarray(loops.stable) | np.asarray(done.diverged)
    return {"sensitivity": np.asarray(loops.sensitivity_peak), "unstable": 100.0 * unstable}


def plain(design: Design) -> Design:
    """Without what has no linear form: an adaptive LADRC with its b0 held."""
    law = "pid" if design.law == "pid" else "ladrc"
    return design._replace(data=design.data | {"law": law})
