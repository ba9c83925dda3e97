from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from jaxquad.spectra import FrequencyResponse

from ._cost import Band, Cost, MaximumLikelihood
from ._fit import check_options, fit_with, require_responses
from ._fit_content import counted
from ._half_bands import model_to_start_from
from ._origin import free_again, Options
from ._parameters import Free, Parameters, Positive, Real, select_parameters, Tie
from ._result import Fit


class Step(NamedTuple):
    """A fit without one parameter, and the decision."""

    parameter: str
    reason: str
    average_cost: float  # without it
    rise: float  # of the average cost
    information: float  # without it
    change: float  # of the information criterion
    dropped: bool
    verdict: str


class Reduction(eqx.Module):
    """The smallest structure that explains the responses, and the steps that led to it."""

    fit: Fit
    first: Fit
    steps: tuple[Step, ...] = eqx.field(static=True)

    @property
    def dropped(self) -> tuple[str, ...]:
        """Parameters left out, in order."""
        return tuple(step.parameter for step in self.steps if step.dropped)

    def __str__(self) -> str:
        width = max(9, *(len(step.parameter) for step in self.steps)) if self.steps else 9
        lines = [
            f"start: {len(self.first.names)} parameters, J_ave {self.first.average_cost:.4g}, "
            f"information criterion {self.first.information:.5g}",
            f"{'parameter':<{width}}  {'why':<16}{'J_ave':>9}{'rise':>10}{'change':>12}  verdict",
        ]
        for step in self.steps:
            numbers = f"{step.average_cost:9.4g}{step.rise:+10.3g}{step.change:+12.4g}"
            lines.append(f"{step.parameter:<{width}}  {step.reason:<16}{numbers}  {step.verdict}")
        return "\n".join(
            [*lines, f"{counted(len(self.fit.names), 'parameter')} left:", str(self.fit)]
        )


class _Options(NamedTuple):
    tied: Mapping[str, Tie] | None
    cost: Cost
    band: Band
    min_coherence: float | None
    null: Mapping[str, float]


def reduce_structure(
    model: PyTree,
    frf: FrequencyResponse | Sequence[FrequencyResponse],
    *,
    free: Free = None,
    tied: Mapping[str, Tie] | None = None,
    cost: Cost = MaximumLikelihood(),
    band: Band = None,
    min_coherence: float | None = None,
    null: Mapping[str, float] | None = None,
    insensitivity: float = 10.0,
    cramer_rao: float = 20.0,
    rise: float | None = None,
) -> Reduction:
    """Leave out, one after the other, the parameters that the responses do not need.

    Tried first is the parameter with the largest insensitivity above `insensitivity`, then the one
    with the largest Cramer-Rao bound above `cramer_rao`. It is set to its `null` value and the rest
    is fitted again. It stays out if Takeuchi's information criterion does not rise.

    **Arguments:**

    - `model`, `frf`, `free`, `tied`, `cost`, `band`, `min_coherence`: as in `jq.fit`.
    - `null`: values of parameters that are left out, by name; 0 by default.
    - `insensitivity`, `cramer_rao`: limits in per cent.
    - `rise`: leave out by the rise of the average cost instead, which is to be no more than this;
        1 to 2 is usual with CIFER.

    **Returns:**

    `jq.identify.Reduction`: the smallest structure, and what was tried.

    **Raises:**

    - `ValueError`: a name in `null` that is not free, and what `jq.fit` refuses.

    Source: Tischler & Remple, ch. 13, model structure determination.
    """
    check_options(cost, band, min_coherence, 1)
    options = _Options(tied, cost, band, min_coherence, null or {})
    parameters = select_parameters(model, free, tied)
    kinds = {each.name: each for each in free_again(parameters)}
    frfs = require_responses(frf)
    unknown = set(options.null) - set(parameters.names)
    if unknown:
        raise ValueError(
            f"null names {', '.join(sorted(unknown))}, which is not free; free are: "
            f"{', '.join(parameters.names)}"
        )
    first = best = _fit_free(model, frfs, kinds, options)
    steps, needed = [], set()
    while len(best.names) > 1 and best.verdict.fitted:
        worst = _least_needed(best, needed, insensitivity, cramer_rao)
        if worst is None:
            break
        name, reason = worst
        trial = _fit_without(best, frfs, kinds, name, options)
        step = _decide(best, trial, name, reason, rise)
        steps.append(step)
        needed.add(name)
        best = trial if step.dropped and trial is not None else best
    if best.verdict.fitted:
        rest = {each: kinds[each] for each in best.names}
        best = _fit_free(model_to_start_from(best), frfs, rest, options, rounds=3)
    return Reduction(best, first, tuple(steps))


def _fit_free(
    model: PyTree, frfs, kinds: Mapping[str, Positive | Real], options: _Options, rounds: int = 0
) -> Fit:
    """Under the noise alone by default: a floor of each structure's own would hide its misfit."""
    chosen = Options(
        list(kinds.values()), options.tied, options.cost, None, (), options.band,
        options.min_coherence, 1, None, 256,
    )  # fmt: skip
    return fit_with(model, frfs, chosen, rounds=rounds)


def _least_needed(
    best: Fit, needed: set[str], insensitivity: float, cramer_rao: float
) -> tuple[str, str] | None:
    """The parameter to try without, and why: insensitivity comes first."""
    for label, values, limit in (
        ("I", best.insensitivity, insensitivity),
        ("CR", np.where(best.determined, best.cramer_rao, np.inf), cramer_rao),
    ):
        open_ = [k for k, name in enumerate(best.names) if name not in needed]
        if open_ and (k := max(open_, key=lambda k: values[k])) is not None and values[k] > limit:
            shown = f"{values[k]:.3g} %" if np.isfinite(values[k]) else "unbounded"
            return best.names[k], f"{label} {shown}"
    return None


def _fit_without(
    best: Fit, frfs, kinds: Mapping[str, Positive | Real], name: str, options: _Options
) -> Fit | None:
    """The fit without one parameter, or None where the model has no response then."""
    place = best.parameters.places[best.names.index(name)]
    alone = Parameters((place,), (), (False,), 1, jnp.ones(1), jnp.zeros(1))
    model = alone.replace(best.model, jnp.asarray([options.null.get(name, 0.0)]))
    rest = {each: kinds[each] for each in best.names if each != name}
    try:
        return _fit_free(model, frfs, rest, options)
    except ValueError:
        return None


def _decide(best: Fit, trial: Fit | None, name: str, reason: str, rise: float | None) -> Step:
    if trial is None or not np.isfinite(trial.cost):
        return Step(name, reason, np.inf, np.inf, np.inf, np.inf, False, "kept: no fit without it")
    higher = trial.average_cost - best.average_cost
    change = trial.information - best.information
    dropped = change <= 0 if rise is None else higher <= rise
    verdict = "dropped" if dropped else "kept: needed"
    return Step(
        name, reason, trial.average_cost, higher, trial.information, change, dropped, verdict
    )
