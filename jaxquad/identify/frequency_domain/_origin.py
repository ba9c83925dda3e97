"""What a fit was made from, so that it can be made again in another band or structure."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import PyTree

from jaxquad._core import pytree_node
from jaxquad.spectra import FrequencyResponse

from ._condition import Condition
from ._cost import Band, Cost, Points
from ._parameters import Free, Parameters, Positive, Real, Tie
from ._problem import Prior


class Options(NamedTuple):
    """Those of `jq.fit`."""

    free: Free
    tied: Mapping[str, Tie] | None
    cost: Cost
    conditions: Sequence[Condition | None] | None
    priors: Sequence[Prior]
    band: Band
    min_coherence: float | None
    starts: int
    solver: eqx.Module | None
    max_steps: int


@pytree_node
class Origin:
    """The responses and options of a fit.

    `run(model, responses, options, rounds=...)` fits as `jq.fit` does; 0 rounds leave out what the
    model does not explain, so that costs compare structures.
    """

    run: Callable[..., PyTree] = eqx.field(static=True)
    points: tuple[Points, ...]
    options: Options

    @property
    def frfs(self) -> tuple[FrequencyResponse, ...]:
        """The responses."""
        return tuple(each.frf for each in self.points)

    @property
    def band(self) -> tuple[float, float]:
        """The lowest and the highest frequency in use, over all responses, in rad/s."""
        used = [np.asarray(p.frf.omega)[np.any(p.used, axis=(1, 2))] for p in self.points]
        omega = np.concatenate(used)
        return float(omega.min()), float(omega.max())

    @property
    def own_points(self) -> float:
        """How many points in use there would be if none shared their noise."""
        return sum(float(np.sum(1 / each.shared[each.used])) for each in self.points)


def free_again(parameters: Parameters) -> list[Positive | Real]:
    """The same free parameters, fitted in the same way, with the sizes they had at the start."""
    sizes = np.abs(np.asarray(parameters.scale))
    rows = zip(parameters.names, parameters.logarithmic, sizes, strict=False)
    return [Positive(name) if log else Real(name, float(size)) for name, log, size in rows]
