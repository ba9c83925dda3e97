"""What a fit was made from, and fits made again: in half of the band, or with a further term."""

import functools as ft
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, PyTree

from jaxquad._core import pytree_node
from jaxquad.spectra import FrequencyResponse

from ._cost import Band, Cost, MaximumLikelihood, Points, Range
from ._parameters import (
    Condition,
    Free,
    Numbers,
    Parameters,
    Positive,
    Real,
    require_conditions,
    Tie,
    with_values,
)
from ._problem import on_device, Prior


_MISFIT = 1.5  # ratio of misfit to random error from which the model's structure is in doubt
_FAR = 20.0  # times the edges of the band
_GAIN = 6.0  # of BIC, from which one structure is strongly preferred (Kass & Raftery, 1995)
_ROUNDING = 1e-9  # of BIC's fall: without noise, structures that differ by less are equal


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


def require_responses(frf: object) -> list[FrequencyResponse]:
    """One response or several, as a list. Raise ValueError for anything else, and for repeats."""
    items = list(frf) if isinstance(frf, Sequence) else [frf]
    frfs = [one for one in items if isinstance(one, FrequencyResponse)]
    if not items or len(frfs) < len(items):
        kinds = ", ".join(sorted({type(one).__name__ for one in items})) or "nothing"
        raise ValueError(
            f"a fit needs a jq.spectra.FrequencyResponse or a list of them, not {kinds}: make one "
            "with jq.frequency_response(record), and call jq.fit(model, response)"
        )
    for k, one in enumerate(frfs):
        for other in frfs[:k]:
            if np.array_equal(np.asarray(one.response), np.asarray(other.response)):
                raise ValueError(f"response {k} of {len(frfs)} is given twice: leave it out once")
    return frfs


def check_options(cost: PyTree, band: PyTree, min_coherence: float | None, max_steps: int) -> None:
    """Check `cost`, `band`, `min_coherence` and `max_steps`; raise ValueError."""
    if isinstance(cost, type) or not isinstance(cost, Cost):
        raise ValueError(
            f"cost={cost!r}: pass an object, jq.identify.MaximumLikelihood() or "
            "jq.identify.CoherenceWeighted()"
        )
    for limits in band.values() if isinstance(band, Mapping) else [band]:
        if limits is not None and np.shape(limits) != (2,):
            raise ValueError(f"band={limits!r}: give two frequencies in rad/s, (low, high)")
    if min_coherence is not None and not 0 < min_coherence < 1:
        raise ValueError(
            f"min_coherence is {min_coherence}: give a number between 0 and 1, or None for what "
            "goes with the cost"
        )
    if max_steps < 1:
        raise ValueError(f"max_steps is {max_steps}: give at least 1")


@pytree_node
class Origin:
    """The responses and options of a fit. `run(model, responses, options, rounds=...)` fits as
    `jq.fit` does; with 0 rounds, costs compare structures, and `by_slopes=True` is enough."""

    run: Callable[..., PyTree] = eqx.field(static=True)
    points: tuple[Points, ...]
    options: Options

    @property
    def frfs(self) -> tuple[FrequencyResponse, ...]:
        """The responses."""
        return tuple(points.frf for points in self.points)

    @property
    def band(self) -> tuple[float, float]:
        """The lowest and the highest frequency in use, over all responses, in rad/s."""
        used = [np.asarray(p.frf.omega)[np.any(p.used, axis=(1, 2))] for p in self.points]
        omega = np.concatenate(used)
        return float(omega.min()), float(omega.max())

    @property
    def independent_points(self) -> float:
        """How many points in use there would be if none shared their noise."""
        return sum(float(np.sum(1 / points.shared[points.used])) for points in self.points)

    def fit_again(
        self, model: PyTree, options: Options, rounds: int = 3, *, by_slopes: bool = False
    ) -> PyTree:
        """A `jq.identify.Fit`; None where the solver diverged."""
        try:
            return self.run(model, self.frfs, options, rounds=rounds, by_slopes=by_slopes)
        except ValueError:
            return None


def free_again(parameters: Parameters) -> list[Positive | Real]:
    """The same free parameters, fitted in the same way, with the sizes they had at the start."""
    sizes = np.abs(np.asarray(parameters.scale))
    rows = zip(parameters.names, parameters.logarithmic, sizes, strict=False)
    return [Positive(name) if log else Real(name, float(size)) for name, log, size in rows]


def require_origin(fit: PyTree) -> Origin:
    """The origin of a fit of `jq.fit`. Raise ValueError for any other."""
    if fit.origin is None or not fit.verdict.fitted:
        raise ValueError(
            "this fit cannot be made again: it is none of jq.fit, or nothing was fitted; fit the "
            "response with jq.fit first"
        )
    return fit.origin


def model_to_start_from(fit: PyTree) -> PyTree:
    """The fitted model; a parameter that came out as 0 starts at a small part of its size."""
    parameters, values = fit.parameters, np.asarray(fit.values)
    small = 0.05 * np.asarray(parameters.scale)[: values.size]
    places = parameters.places[: values.size]
    return on_device(with_values(fit.model, places, np.where(values == 0, small, values)))


def _table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Rows of cells in columns."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(f"{c:<{w}}" for c, w in zip(row, widths, strict=True)) for row in rows)
    return [line.rstrip() for line in lines]


class Bands(NamedTuple):
    """One model fitted to the lower and to the upper half of the band; prints as a table."""

    full: PyTree  # `jq.identify.Fit`
    lower: PyTree  # likewise, or None where the solver diverged
    upper: PyTree
    split: float  # frequency between them, rad/s

    def overlap(self, name: str) -> bool | None:
        """Whether the 95 % intervals of both halves overlap; None where one determines nothing."""
        both = (self.lower, self.upper)
        halves = [fit for fit in both if fit is not None and _determines(fit, name)]
        if len(halves) < 2:
            return None
        (low, high), (other_low, other_high) = (half.interval(name) for half in halves)
        return low <= other_high and other_low <= high

    def __str__(self) -> str:
        low, high = self.full.origin.band
        heads = ("parameter", "whole band", f"{low:.3g} .. {self.split:.3g} rad/s")
        rows = [(*heads, f"{self.split:.3g} .. {high:.3g} rad/s", "overlap")]
        words = {True: "yes", False: "NO", None: "-"}
        for name in self.full.names:
            cells = []
            for fit in (self.full, self.lower, self.upper):
                text = "the fit diverged" if fit is None else "not determined"
                if fit is not None and _determines(fit, name):
                    text = "{:.4g} .. {:.4g}".format(*fit.interval(name))
                cells.append(text)
            rows.append((name, *cells, words[self.overlap(name)]))
        hertz = self.split / (2 * np.pi)
        halves = f"the halves meet at {self.split:.3g} rad/s, {hertz:.3g} Hz"
        return "\n".join([*_table(rows), f"(95 % intervals, with model error; {halves})"])


def _determines(fit: PyTree, name: str) -> bool:
    return bool(fit.verdict.fitted and fit.determined[fit.names.index(name)])


def fit_bands(fit: PyTree) -> Bands:
    """Fit both halves of the band, as `Fit.bands` says."""
    origin = require_origin(fit)
    low, high = origin.band
    split = float(np.sqrt(low * high))

    def fit_within(half: Range) -> PyTree:
        band: Band = half
        if isinstance(origin.options.band, Mapping):  # what of each pair's band lies within it
            frf, band = origin.frfs[0], {}
            for pair in ((o, i) for o in frf.output_names for i in frf.input_names):
                limits = origin.options.band.get(pair, half)
                if limits is not None:
                    limits = max(limits[0], half[0]), min(limits[1], half[1])
                band[pair] = limits if limits is not None and limits[0] < limits[1] else None
        free = free_again(fit.parameters)
        options = origin.options._replace(free=free, starts=1, band=band)
        return origin.fit_again(model_to_start_from(fit), options)

    return Bands(fit, fit_within((low, split)), fit_within((split, high)), split)


class _Term(NamedTuple):
    """A factor of the response, by s, and of what drifts by when a sweep has s; `starts` are by the
    band's edges and middle (rad/s)."""

    title: str
    formula: str
    factor: Callable[..., Array]
    names: tuple[str, ...]
    starts: Callable[[float, float, float], list[list[float]]]


def _pair(s, omega, damping):
    return s * s + 2 * damping * omega * s + omega**2


_TERMS = (
    _Term(
        "a further lag (real pole)", "1 / (T s + 1)", lambda s, x: 1 / (x[0] * s + 1), ("T",),
        lambda low, mid, high: [[0.3 / high], [1 / mid]],
    ),
    _Term(
        "a zero", "T s + 1", lambda s, x: x[0] * s + 1, ("T",),
        lambda low, mid, high: [[0.3 / high], [-0.3 / high], [1 / mid]],
    ),
    _Term(
        "rate damping", "s / (s + d)", lambda s, x: s / (s + x[0]), ("d",),
        lambda low, mid, high: [[0.3 * low], [mid]],
    ),
    _Term(
        "a hovering vehicle's slow pair", "s^2 / (s^2 + 2 z w s + w^2)",
        lambda s, x: s * s / _pair(s, x[0], x[1]), ("w", "z"),
        lambda low, mid, high: [[0.5 * low, 0.3], [low, 0.5]],
    ),
    _Term(
        "a pole pair", "w^2 / (s^2 + 2 z w s + w^2)",
        lambda s, x: x[0] ** 2 / _pair(s, x[0], x[1]), ("w", "z"),
        lambda low, mid, high: [[2 * high, 0.3], [mid, 0.5]],
    ),
    _Term(
        "a flexible mode (pole and zero pair)",
        "(s^2 + 2 z r w s + (r w)^2) / (s^2 + 2 z w s + w^2) / r^2",
        lambda s, x: (s * s + 2 * x[1] * x[0] * x[2] * s + (x[0] * x[2]) ** 2)
        / _pair(s, x[0], x[1]) / x[2] ** 2, ("w", "z", "r"),
        lambda low, mid, high: [[np.sqrt(low * mid), 0.1, 1.1], [mid, 0.1, 0.9],
                                [mid, 0.1, 1.1], [np.sqrt(mid * high), 0.1, 1.1]],
    ),
    _Term(
        "a notch", "(s^2 + 2 n w s + w^2) / (s^2 + 2 z w s + w^2)",
        lambda s, x: _pair(s, x[0], x[1]) / _pair(s, x[0], x[2]), ("w", "n", "z"),
        lambda low, mid, high: [
            [w, 0.1, 0.4] for w in (np.sqrt(low * mid), mid, np.sqrt(mid * high), 0.7 * high)
        ],
    ),
)  # fmt: skip
_DRIFT = _Term(
    "a gain that drifts", "1 + change t / T (t from mid-record, T the length of the sweep)",
    lambda s, x, time: 1 + x[0] * time, ("change",), lambda low, mid, high: [[-0.01]],
)  # fmt: skip
_CLOCK = _Term(
    "a clock that drifts", "e^(-late s t / T) (t from mid-record, T the length of the sweep)",
    lambda s, x, time: jnp.exp(-x[0] * s[:, None] * time), ("late",),
    lambda low, mid, high: [[0.01 / high]],
)  # fmt: skip
_REAL = ("T", "change", "late")  # of either sign
_OF_SWEEPS = (_DRIFT, _CLOCK)


class Extended(eqx.Module):
    """A model whose responses are all multiplied by one further factor. What drifts has it in the
    response to a sweep alone (`swept`: omega, and when each input has it)."""

    model: PyTree
    extra: Float[Array, " extra"]
    term: _Term = eqx.field(static=True)
    swept: tuple[Numbers, Numbers] | None = None

    def frequency_response(self, omega: Float[Array, " f"]) -> Complex[Array, "f ..."]:
        """Of the model, times the factor."""
        response = self.model.frequency_response(omega)
        s = jax.lax.complex(jnp.zeros_like(omega), omega)
        extra = self.extra.astype(s.dtype)
        if self.term in _OF_SWEEPS:
            if self.swept is None:
                return response
            time = ft.partial(jnp.interp, jnp.abs(omega), self.swept[0])
            times = jax.vmap(time, in_axes=1, out_axes=1)(self.swept[1])
            factor = self.term.factor(s, extra, times.astype(s.dtype))
            return response * jnp.expand_dims(factor, range(1, response.ndim - 1))
        factor = self.term.factor(s, extra)
        return response * factor.reshape(-1, *(1,) * (response.ndim - 1))


@pytree_node
class _During:
    """A condition: the model under `change`, during a sweep."""

    change: Condition
    swept: tuple[Numbers, Numbers]

    def __call__(self, model: Extended) -> Extended:
        model = self.change(model)
        return Extended(model.model, model.extra, model.term, self.swept)


def _sweeps(origin: Origin) -> list[tuple[np.ndarray, np.ndarray]] | None:
    """Of each response, in lengths of the sweep over the points in use; None without a sweep."""
    sweeps = []
    for frf, points in zip(origin.frfs, origin.points, strict=True):
        if frf.swept_at is None:
            return None
        omega, times = np.asarray(frf.omega), np.asarray(frf.swept_at)
        length = np.ptp(times[np.any(points.used, axis=1)])
        sweeps.append((omega, times / max(length, 1e-9)))
    return sweeps


class Candidate(NamedTuple):
    """A structure that was tried; `gain` is by how much it lowers BIC. Intervals are by slopes."""

    title: str
    formula: str
    fit: PyTree  # `jq.identify.Fit`; None where the solver diverged
    gain: float


class Explanation(eqx.Module):
    """Structures that were tried on a misfit, and the one that the responses want, if any.

    `best` is a `jq.identify.Fit` of it, whose model is an `Extended` one: of the simplest of those
    within 6 of the lowest BIC. None where no term lowers BIC by 6 and the misfit. Where a remark
    says that the actuator has two lags, all of this is behind such an actuator: `actuator` says
    which, the first candidate has no further term, and `best` is this one if none is wanted.
    """

    fit: PyTree  # the one that was to be explained
    candidates: tuple[Candidate, ...]  # what was tried, by gain, but `best` first
    best: PyTree
    actuator: str = eqx.field(static=True, default="")

    @property
    def summary(self) -> str:
        """Which term the model lacks, in a sentence or two."""
        before = float(np.sqrt(self.fit.chi_squared))
        if self.actuator and not isinstance(self.best.model, Extended):
            return self.actuator
        if self.best is None:
            return (
                f"None of {len(self.candidates)} further terms explains the misfit of "
                f"{before:.1f} random errors: rely on the intervals with model error, or fit the "
                "part of the band where the model holds"
            )
        first = self.candidates[1 if self.actuator else 0]
        after = float(np.sqrt(first.fit.chi_squared))
        names = self.best.model.term.names
        numbers = zip(names, self.best.values[len(self.fit.names) :], strict=True)
        values = ", ".join(f"{name} = {value:.4g}" for name, value in numbers)
        rest = "" if after < _MISFIT else ", which is still more than noise"
        actuator = f"{self.actuator}. " if self.actuator else ""
        return (
            f"{actuator}The model lacks {first.title}, {first.formula} with {values}: with it the "
            f"misfit falls from {before:.1f} to {after:.1f} random errors{rest}"
        )

    def __str__(self) -> str:
        names = self.fit.names
        values = lambda fit: [f"{value:.4g}" for value in fit.values[: len(names)]]
        misfit = lambda fit: f"{fit.chi_squared**0.5:.2f}"
        rows = [("structure", "misfit / error", "BIC lower by", *names)]
        rows.append(("as fitted", misfit(self.fit), "-", *values(self.fit)))
        for title, _, fit, gain in self.candidates:
            if fit is None:
                rows.append((title, "diverged", "-", *("-" for _ in names)))
            else:
                rows.append((title, misfit(fit), f"{gain:.1f}", *values(fit)))
        return "\n".join([*_table(rows), f"{self.summary}."])


def explain_misfit(fit: PyTree) -> Explanation:
    """Fit again with one further term after the other, as `Fit.explain` says."""
    from ._structure import fit_behind_lags

    origin = require_origin(fit)
    behind = fit_behind_lags(fit, origin)
    if behind is not None:
        candidate, actuator = behind
        if candidate.fit.chi_squared <= _MISFIT**2:
            return Explanation(fit, (candidate,), candidate.fit, actuator)
        inner = explain_misfit(candidate.fit)
        best = candidate.fit if inner.best is None else inner.best
        return Explanation(fit, (candidate, *inner.candidates), best, actuator)
    low, high = origin.band
    model, middle = model_to_start_from(fit), float(np.sqrt(low * high))
    plain = origin.fit_again(model, _options(fit, origin, None), 0, by_slopes=True) or fit
    tried = []
    for term in (*_TERMS, *(_OF_SWEEPS if _sweeps(origin) else ())):
        options, fits = _options(fit, origin, term), []
        for start in term.starts(low, middle, high):
            with np.errstate(all="ignore"):  # of a term that runs away, dropped below
                extended = Extended(model, jnp.asarray(start), term)
                other = origin.fit_again(extended, options, 0, by_slopes=True)
            if other is None or not np.isfinite(other.cost):
                continue
            # A frequency far from the band makes the term a gain, or nothing.
            place = float(np.asarray(other.model.extra)[0])
            if term.names[0] in _REAL or low / _FAR < place < high * _FAR:
                fits.append(other)
        tried.append((term, min(fits, key=lambda other: other.cost, default=None)))
    # A misfit that is left in all of them counts as noise here. The refit may end in a poorer
    # minimum than the fit did.
    before = plain.cost
    if isinstance(origin.options.cost, MaximumLikelihood):
        before = min(before, fit.cost)
    left = min((other.chi_squared for _, other in tried if other is not None), default=1.0)
    left, price, candidates = max(1.0, left), np.log(2 * origin.independent_points), []
    for term, other in tried:
        gain = -np.inf
        if other is not None:
            gain = (before - other.cost) / left - len(term.names) * price
        candidates.append(Candidate(term.title, term.formula, other, float(gain)))
    candidates.sort(key=lambda candidate: -candidate.gain)
    better = [
        candidate
        for candidate in candidates
        if candidate.gain > _GAIN and candidate.fit.chi_squared < fit.chi_squared
    ]
    if not better:
        return Explanation(fit, tuple(candidates), None)
    # The simplest of those that explain it equally well is named first.
    least = better[0].gain - max(_GAIN, _ROUNDING * better[0].gain)
    equal = [candidate for candidate in better if candidate.gain >= least]
    first = min(equal, key=lambda candidate: len(candidate.fit.model.term.names))
    candidates.sort(key=lambda candidate: candidate is not first)
    best, options = first.fit, _options(fit, origin, first.fit.model.term)
    again = origin.fit_again(best.model, options)
    if again is None or again.chi_squared >= fit.chi_squared:
        again = origin.fit_again(best.model, options, 0)
    return Explanation(fit, tuple(candidates), best if again is None else again)


def _options(fit: PyTree, origin: Origin, term: _Term | None) -> Options:
    """Those of the fit by maximum likelihood, for a model that is one part of an `Extended`."""
    free, options = free_again(fit.parameters), origin.options
    options = options._replace(cost=MaximumLikelihood(), starts=1, free=free)
    if term is None:
        return options
    sizes = dict(zip(_REAL, (1 / origin.band[1], 1.0, 1 / origin.band[1]), strict=True))
    extra = [
        Real(f"extra[{k}]", sizes[name]) if name in sizes else Positive(f"extra[{k}]")
        for k, name in enumerate(term.names)
    ]
    tied, conditions, priors = options.tied, options.conditions, []
    if tied is not None:
        tied = {f"model.{name}": ft.partial(_of_model, tie) for name, tie in tied.items()}
    if conditions is not None:
        conditions = [c if c is None else ft.partial(_change_model, c) for c in conditions]
    if term in _OF_SWEEPS:
        changes = require_conditions(fit.model, conditions, len(origin.frfs))
        conditions = list(map(_During, changes, _sweeps(origin) or []))
    for prior in options.priors:
        quantity = prior.quantity
        named = isinstance(quantity, str)
        inner = f"model.{quantity}" if named else ft.partial(_of_model, quantity)
        priors.append(Prior(inner, prior.value, prior.standard_error))
    free = [*(parameter._replace(name=f"model.{parameter.name}") for parameter in free), *extra]
    return options._replace(free=free, tied=tied, conditions=conditions, priors=priors)


def _of_model(quantity: Callable[[PyTree], Float[Array, ""]], model: Extended) -> Float[Array, ""]:
    return quantity(model.model)


def _change_model(condition: Condition, model: Extended) -> Extended:
    return Extended(condition(model.model), model.extra, model.term)
