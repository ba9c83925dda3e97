from typing import Any, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from ._certificate import Certificate
from ._objective import Limit
from ._progress import Evaluation


_COST, _PLACE = 2e-3, 0.1  # within which two ends are one: of the cost, and in nepers


class Optimum(NamedTuple):
    """A point at which some of the starts ended; those that did not stabilise cost nan."""

    cost: float
    z: Float[np.ndarray, " n"]
    values: dict[str, float]  # of the tuned numbers
    starts: tuple[int, ...]  # which of them led here; 0 is the controller as given
    converged: bool


def scattered(
    start: Float[np.ndarray, " n"], count: int, scatter: float, seed: int
) -> Float[np.ndarray, "starts n"]:
    """The start itself, and others about it: normal by `scatter` (nepers), a Latin hypercube."""
    from scipy.special import ndtri

    if not isinstance(count, int) or count < 1 or not 0 < scatter < np.inf:
        raise ValueError(
            f"starts is {count} with a scatter of {scatter}: give 1 for the controller as it is, "
            "or more, and a scatter above 0"
        )
    if count == 1:
        return start[None]
    rng = np.random.default_rng(seed)
    cells = np.stack([rng.permutation(count - 1) for _ in range(start.size)], axis=1)
    deviates = ndtri((cells + rng.uniform(0.01, 0.99, cells.shape)) / (count - 1))
    return np.concatenate([start[None], start + scatter * deviates])


def optima(
    cost: Float[np.ndarray, " starts"],
    z: Float[np.ndarray, "starts n"],
    converged: np.ndarray,
    named,
) -> tuple[Optimum, ...]:
    """Distinct ends, the best first; `named(z)` tells the tuned numbers."""
    found: list[Optimum] = []
    for k in np.argsort(np.where(np.isnan(cost), np.inf, cost), kind="stable"):
        same = [
            i for i, o in enumerate(found)
            if abs(o.cost - cost[k]) < _COST and np.max(np.abs(o.z - z[k])) < _PLACE
        ]  # fmt: skip
        if same:
            old = found[same[0]]
            found[same[0]] = old._replace(starts=(*old.starts, int(k)))
        else:
            found.append(Optimum(float(cost[k]), z[k], named(z[k]), (int(k),), bool(converged[k])))
    return tuple(found)


class Kept(NamedTuple):
    """A limit on the members that were tuned on."""

    limit: Limit
    found: float  # in the limit's unit
    met: bool
    active: bool  # it holds the optimum back


class Tuned(eqx.Module):
    """A tuned controller, and what is known of it. The first line of `str()` is the verdict.

    `certificate` judges it on fresh members; None if that was not asked for. What `limits` and
    `minima` tell is of the members that were tuned on. `evaluations` counts gradients through the
    flights of all members, `stabilising` those of the linear loops alone that came before.
    """

    controller: Any
    certificate: Certificate | None
    stabilised: bool  # every member that was tuned on
    converged: bool
    cost: float
    values: dict[str, float]  # of the tuned numbers
    limits: tuple[Kept, ...]
    minima: tuple[Optimum, ...]  # distinct ends of the starts, the best first
    evaluations: int
    stabilising: int
    history: tuple[Evaluation, ...]
    seconds: float  # of the descent, compilation included, without the certificate
    remarks: tuple[str, ...]

    @property
    def active(self) -> tuple[Limit, ...]:
        """The limits that hold the optimum back."""
        return tuple(kept.limit for kept in self.limits if kept.active)

    @property
    def holds(self) -> bool:
        """Whether there is a certificate, and it holds."""
        return self.certificate is not None and self.certificate.holds

    def __str__(self) -> str:
        first, *rest = ["NOT CERTIFIED: no fresh members were asked for"]
        missed = [_kept(kept) for kept in self.limits if not kept.met]
        if missed:
            first = f"{first}; {'; '.join(missed)}"
        if self.certificate is not None:
            first, *rest = str(self.certificate).splitlines()
        numbers = ", ".join(f"{name} {value:.4g}" for name, value in self.values.items())
        lines = [first, f"tuned: {numbers}", f"  {_effort(self)}"]
        lines += [f"  {_kept(kept)}" for kept in self.limits]
        lines += _ends(self.minima) if len(self.minima) > 1 else []
        lines += [f"  ! {remark}" for remark in self.remarks]
        return "\n".join(lines + rest)


def _effort(tuned: Tuned) -> str:
    ends = "converged" if tuned.converged else "not converged"
    return (
        f"cost {tuned.cost:.5g}, {ends} after {tuned.evaluations} gradients"
        f" ({tuned.stabilising} more of the linear loops, to stabilise) in {tuned.seconds:.1f} s"
    )


def _kept(kept: Kept) -> str:
    state = "holds the optimum back" if kept.active else "does not act" if kept.met else "MISSED"
    state = state if kept.met else "MISSED: it cannot be met with the others"
    beyond = abs(kept.found - float(kept.limit.bound))
    by = "" if kept.met else f" (by {beyond:.3g})"
    return f"limit on {kept.limit}: {kept.found:.4g}{by} on the members tuned on, {state}"


def _ends(minima: tuple[Optimum, ...]) -> list[str]:
    total = sum(len(o.starts) for o in minima)
    lines = [f"  {total} starts, {len(minima)} different ends:"]
    for o in minima:
        cost = "not stabilised" if np.isnan(o.cost) else f"cost {o.cost:.5g}"
        lines.append(f"    {cost}, from {len(o.starts)} of the starts ({_listed(o.starts)})")
    return lines


def _listed(starts: tuple[int, ...]) -> str:
    shown = ", ".join(str(k) for k in starts[:8])
    return shown if len(starts) <= 8 else f"{shown}, ..."
