"""Which further term a response wants where the model does not explain it."""

import functools as ft
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

from ._condition import Condition
from ._cost import MaximumLikelihood
from ._half_bands import model_to_start_from, require_origin
from ._origin import free_again, Options, Origin
from ._parameters import Positive, Real, Tie
from ._problem import Prior


MISFIT = 1.5  # ratio of misfit to random error from which the model's structure is in doubt
_FAR = 20.0  # times the edges of the band
_GAIN = 6.0  # of BIC, from which one structure is strongly preferred (Kass & Raftery, 1995)


class _Term(NamedTuple):
    """A factor of the response; `starts` are in units of the band's edges and middle (rad/s)."""

    title: str
    formula: str
    factor: Callable[[Complex[Array, " f"], Float[Array, " extra"]], Complex[Array, " f"]]
    names: tuple[str, ...]
    starts: Callable[[float, float, float], list[list[float]]]


def _lag(s, x):
    return 1 / (x[0] * s + 1)


def _lead(s, x):
    return x[0] * s + 1


def _damped(s, x):
    return s / (s + x[0])


def _pair(s, x):
    return x[0] ** 2 / (s * s + 2 * x[1] * x[0] * s + x[0] ** 2)


def _slow_pair(s, x):
    return s * s / (s * s + 2 * x[1] * x[0] * s + x[0] ** 2)


def _mode(s, x):
    below = s * s + 2 * x[1] * x[0] * s + x[0] ** 2
    above = s * s + 2 * x[1] * x[0] * x[2] * s + (x[0] * x[2]) ** 2
    return above / below / x[2] ** 2


_TERMS = (
    _Term(
        "a further lag (real pole)", "1 / (T s + 1)", _lag, ("T",),
        lambda low, mid, high: [[0.3 / high], [1 / mid]],
    ),
    _Term(
        "a zero", "T s + 1", _lead, ("T",),
        lambda low, mid, high: [[0.3 / high], [-0.3 / high], [1 / mid]],
    ),
    _Term(
        "rate damping", "s / (s + d)", _damped, ("d",), lambda low, mid, high: [[0.3 * low], [mid]],
    ),
    _Term(
        "a hovering vehicle's slow pair", "s^2 / (s^2 + 2 z w s + w^2)", _slow_pair, ("w", "z"),
        lambda low, mid, high: [[0.5 * low, 0.3], [low, 0.5]],
    ),
    _Term(
        "a pole pair", "w^2 / (s^2 + 2 z w s + w^2)", _pair, ("w", "z"),
        lambda low, mid, high: [[2 * high, 0.3], [mid, 0.5]],
    ),
    _Term(
        "a flexible mode (pole and zero pair)",
        "(s^2 + 2 z r w s + (r w)^2) / (s^2 + 2 z w s + w^2) / r^2", _mode, ("w", "z", "r"),
        lambda low, mid, high: [[np.sqrt(low * mid), 0.1, 1.1], [mid, 0.1, 0.9],
                                [mid, 0.1, 1.1], [np.sqrt(mid * high), 0.1, 1.1]],
    ),
)  # fmt: skip


class Extended(eqx.Module):
    """A model whose responses are all multiplied by one further factor."""

    model: PyTree
    extra: Float[Array, " extra"]
    term: _Term = eqx.field(static=True)

    def frequency_response(self, omega: Float[Array, " f"]) -> Complex[Array, "f ..."]:
        """Of the model, times the factor."""
        s = jax.lax.complex(jnp.zeros_like(omega), omega)
        response = self.model.frequency_response(omega)
        factor = self.term.factor(s, self.extra.astype(s.dtype))
        return response * factor.reshape(-1, *(1,) * (response.ndim - 1))


class Candidate(NamedTuple):
    """A structure that was tried; `gain` is by how much it lowers BIC."""

    title: str
    formula: str
    fit: PyTree  # `jq.identify.Fit`; None where the solver diverged
    gain: float


class Explanation(eqx.Module):
    """Structures that were tried on a misfit, and the one that the responses want, if any.

    **Attributes:**

    - `whole`: the fit that was to be explained.
    - `candidates`: what was tried, the best first.
    - `best`: a `jq.identify.Fit` of the preferred structure, whose model is an `Extended` one; None
      where no term lowers BIC by 6 or more.
    """

    whole: PyTree
    candidates: tuple[Candidate, ...]
    best: PyTree

    @property
    def summary(self) -> str:
        """Which term the model lacks, in a sentence or two."""
        before = float(np.sqrt(self.whole.chi_squared))
        if self.best is None:
            return (
                f"None of {len(self.candidates)} further terms explains the misfit of "
                f"{before:.1f} random errors: rely on the intervals with model error, or fit the "
                "part of the band where the model holds"
            )
        first = self.candidates[0]
        after = float(np.sqrt(first.fit.chi_squared))
        count = len(self.whole.names)
        extra = zip(self.best.names[count:], self.best.values[count:], strict=True)
        values = ", ".join(f"{name.split('.')[-1]} = {value:.4g}" for name, value in extra)
        named = _named_extra(first.formula, values)
        rest = "" if after < MISFIT else ", which is still more than noise"
        return (
            f"The model lacks {first.title}, {first.formula} with {named}: with it the misfit "
            f"falls from {before:.1f} to {after:.1f} random errors{rest}"
        )

    def __str__(self) -> str:
        names = self.whole.names
        rows = [("structure", "misfit / error", "BIC lower by", *names)]
        rows.append(("as fitted", f"{self.whole.chi_squared**0.5:.2f}", "-", *_values(self.whole)))
        for each in self.candidates:
            if each.fit is None:
                rows.append((each.title, "diverged", "-", *("-" for _ in names)))
                continue
            misfit = f"{each.fit.chi_squared**0.5:.2f}"
            numbers = _values(each.fit)[: len(names)]
            rows.append((each.title, misfit, f"{each.gain:.1f}", *numbers))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)) for row in rows]
        return "\n".join([*(line.rstrip() for line in lines), f"{self.summary}."])


def _named_extra(formula: str, values: str) -> str:
    """`extra[0] = 0.4` as `d = 0.4`."""
    [term] = [each for each in _TERMS if each.formula == formula]
    for k, name in enumerate(term.names):
        values = values.replace(f"extra[{k}]", name)
    return values


def _values(fit: PyTree) -> list[str]:
    return [f"{value:.4g}" for value in fit.values]


def explain_misfit(fit: PyTree) -> Explanation:
    """Fit again with one further term after the other, as `Fit.explain` says."""
    origin = require_origin(fit)
    plain = _run(origin, model_to_start_from(fit), _options(fit, origin, None), 0)
    tried = [(term, _try(fit, origin, term)) for term in _TERMS]
    # A misfit that is left in all of them counts as noise here.
    known = [each for _, each in tried if each is not None]
    left = max(1.0, min((each.chi_squared for each in known), default=1.0))
    count, start = np.log(2 * origin.own_points), fit if plain is None else plain
    candidates = []
    for term, each in tried:
        gain = -np.inf
        if each is not None:
            gain = (start.cost - each.cost) / left - len(term.names) * count
        candidates.append(Candidate(term.title, term.formula, each, float(gain)))
    candidates.sort(key=lambda each: -each.gain)
    if not candidates[0].gain > _GAIN:
        return Explanation(fit, tuple(candidates), None)
    [term] = [each for each in _TERMS if each.title == candidates[0].title]
    best = candidates[0].fit
    again = _run(origin, best.model, _options(fit, origin, term), 3)
    return Explanation(fit, tuple(candidates), best if again is None else again)


def _try(fit: PyTree, origin: Origin, term: _Term) -> PyTree:
    """The best fit with one further term, under the noise alone."""
    low, high = origin.band
    model, options = model_to_start_from(fit), _options(fit, origin, term)
    starts = term.starts(low, float(np.sqrt(low * high)), high)
    models = [Extended(model, jnp.asarray(start), term) for start in starts]
    found = [_run(origin, each, options, 0) for each in models]
    known = [each for each in found if each is not None and np.isfinite(each.cost)]
    known = [each for each in known if _is_near(each, term, origin)]
    return min(known, key=lambda each: each.cost, default=None)


def _is_near(fit: PyTree, term: _Term, origin: Origin) -> bool:
    """Whether the term's frequency lies near the band: far from it, it is a gain or nothing."""
    low, high = origin.band
    if term.names[0] == "T":
        return True
    return low / _FAR < float(np.asarray(fit.model.extra)[0]) < high * _FAR


def _run(origin: Origin, model: PyTree, options: Options, rounds: int) -> PyTree:
    try:
        return origin.run(model, origin.frfs, options, rounds=rounds)
    except ValueError:
        return None


def _options(fit: PyTree, origin: Origin, term: _Term | None) -> Options:
    """Those of the fit by maximum likelihood, for a model that is one part of an `Extended`."""
    options = origin.options
    free = free_again(fit.parameters)
    options = options._replace(cost=MaximumLikelihood(), starts=1, free=free)
    if term is None:
        return options
    extra = [
        Real(f"extra[{k}]", 1 / origin.band[1]) if name == "T" else Positive(f"extra[{k}]")
        for k, name in enumerate(term.names)
    ]
    return options._replace(
        free=[*(each._replace(name=f"model.{each.name}") for each in free), *extra],
        tied=_inside(options.tied),
        conditions=_conditioned(options.conditions),
        priors=[_of_part(prior) for prior in options.priors],
    )


def _inside(tied: Mapping[str, Tie] | None) -> Mapping[str, Tie] | None:
    if tied is None:
        return None
    return {f"model.{name}": ft.partial(_of_model, tie) for name, tie in tied.items()}


def _of_model(quantity: Callable[[PyTree], Float[Array, ""]], whole: Extended) -> Float[Array, ""]:
    return quantity(whole.model)


def _conditioned(conditions: Sequence[Condition | None] | None) -> list[Condition | None] | None:
    if conditions is None:
        return None
    return [None if each is None else ft.partial(_with_part, each) for each in conditions]


def _with_part(condition: Condition, whole: Extended) -> Extended:
    return Extended(condition(whole.model), whole.extra, whole.term)


def _of_part(prior: Prior) -> Prior:
    quantity = prior.quantity
    named = isinstance(quantity, str)
    inner = f"model.{quantity}" if named else ft.partial(_of_model, quantity)
    return Prior(inner, prior.value, prior.standard_error)
