from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ._judged import Judged, LINEAR, sign_of
from ._quantities import SHOWN


class Distance(NamedTuple):
    """How far a design is from one limit; SI units, as the limit's own."""

    quantity: str
    over: str  # which number of the members' is bounded
    sense: str  # "at most" or "at least"
    bound: float
    found: float  # nan if it cannot be judged, inf or -inf with members that are unstable
    slack: float  # met by this much; below 0, missed
    percent: float  # slack over the bound
    beyond: int  # members that are beyond the bound themselves
    without: int  # members that are unstable and have no such number
    of_others: float  # what is found without those
    members: int
    member: int | None  # the worst one

    @property
    def met(self) -> bool:
        return bool(self.slack >= 0)  # nan is not

    def __str__(self) -> str:
        shown = SHOWN[self.quantity]
        demand = f"{shown.title}, {self.over}, {self.sense} {shown.text(self.bound)}"
        if np.isnan(self.found):
            return f"{demand}: cannot be judged, the scenario or the controller do not have it"
        several = self.beyond > 0 and self.over == "worst"
        beyond = f", {self.beyond} of {self.members} members beyond" if several else ""
        if self.without:
            known = np.isfinite(self.of_others)
            others = f"; of the others {shown.text(self.of_others)}" if known else ""
            return f"{demand}: missed, {self.without} members are unstable{others}{beyond}"
        if not np.isfinite(self.found):
            return f"{demand}: {shown.text(self.found)}, {'met' if self.met else 'missed'}{beyond}"
        apart = abs(shown.number(self.found) - shown.number(self.bound))
        by = f"{'met' if self.met else 'missed'} by {apart:.3g} {shown.unit}".rstrip()
        share = f" ({abs(self.percent):.2g} %)" if np.isfinite(self.percent) else ""
        return f"{demand}: {shown.text(self.found)}, {by}{share}{beyond}"


def distances(design: Judged, limits: Sequence[Any]) -> tuple[Distance, ...]:
    """Of one design to each of the limits. Raises ValueError for quantities not judged."""
    return tuple(_distance(design, limit) for limit in limits)


def _distance(design: Judged, limit: Any) -> Distance:
    sense = "at least" if limit.at_most is None else "at most"
    bound = float(np.asarray(limit.at_least if limit.at_most is None else limit.at_most))
    sign = -1.0 if limit.at_most is None else 1.0
    values = sign * _counted(design, limit.quantity)  # larger is worse
    found = sign * _risk(limit.over, values)
    slack = sign * (bound - found)
    return Distance(
        quantity=limit.quantity,
        over=_name(limit.over),
        sense=sense,
        bound=bound,
        found=found,
        slack=slack,
        percent=100 * slack / abs(bound) if bound else np.copysign(np.inf, slack),
        beyond=int(np.sum(~(values <= sign * bound))),
        without=int(np.sum(np.isposinf(values))),
        of_others=sign * _risk(limit.over, values[~np.isposinf(values)]),
        members=values.size,
        member=None if np.isnan(values).any() else int(np.argmax(values)),
    )


def _counted(design: Judged, quantity: str) -> Float[np.ndarray, " members"]:
    """The numbers of the members; an unstable one has the worst that there is."""
    values = design.of(quantity, worst_axis=True)
    if quantity in LINEAR and design.unstable is not None:
        return np.where(design.unstable & np.isnan(values), sign_of(quantity) * np.inf, values)
    return values


def _risk(over: Any, values: Float[np.ndarray, " members"]) -> float:
    if not values.size or np.isnan(values).any():
        return np.nan
    if np.isposinf(values).any():
        return np.inf  # whatever its weight: 0 times it would be nan
    return float(over(jnp.asarray(values)))


def _name(over: Any) -> str:
    return str(getattr(over, "text", type(over).__name__.lower()))
