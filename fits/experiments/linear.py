"""Linear loops of an ensemble, with one structure for all laws: they share what is compiled."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxquad.control import LinearController
from jaxquad.loops import analyse, gain_window, Loop, LoopAnalysis, per_member
from jaxquad.models import DecoupledAxes


_STATES = 4  # of a PID behind a filter; a LADRC has three


class LinearLaws(eqx.Module):
    """The linear forms of an ensemble of controllers of one axis, stacked along the first axis."""

    stacked: LinearController
    index: Int[Array, " members"] = per_member(rank=0)  # in the stack

    @property
    def dt(self) -> float:
        return self.stacked.dt

    def linear(self, axis: int = 0, member: Any = None) -> LinearController:
        return jax.tree.map(lambda x: x[self.index[member]], self.stacked)


class Late(NamedTuple):
    """The delay of each member; `longest` is the same for all plants that have one."""

    delay: np.ndarray | float = 0.0  # s
    longest: float | None = None  # s


def analysed(axis: DecoupledAxes, law: Any, late: Late) -> LoopAnalysis:
    """`jq.analyse` of a law [1, members]."""
    laws = LinearLaws(_stack(law), jnp.arange(law.ensemble[0]))
    return analyse(Loop(axis, laws, delay=late.delay, longest_delay=late.longest))


def stable_gains(axis: DecoupledAxes, law: Any, late: Late) -> tuple[np.ndarray, np.ndarray]:
    """The gains b in rad/s^2 per unit of command between which each loop is stable; nan if none."""
    laws = LinearLaws(_stack(law), jnp.arange(law.ensemble[0]))
    found = gain_window(Loop(axis, laws, delay=late.delay, longest_delay=late.longest))
    return np.asarray(found.low), np.asarray(found.high)


@eqx.filter_jit
def _stack(law: Any) -> LinearController:
    return jax.vmap(lambda k: _padded(law.linear(0, (k,))))(jnp.arange(law.ensemble[0]))


def _padded(law: LinearController) -> LinearController:
    """With states that remain 0, up to `_STATES`."""
    more = _STATES - len(law.C)
    vectors = {
        name: jnp.pad(getattr(law, name), (0, more))
        for name in ("reference_in", "measurement_in", "C")
    }
    through = (law.reference_through, law.measurement_through)
    matrix = jnp.pad(law.A, ((0, more), (0, more)))
    return LinearController(
        matrix, vectors["reference_in"], vectors["measurement_in"], vectors["C"], *through, law.dt
    )
