"""What a record determines of a model's parameters: by its Fisher information, and in words."""

import dataclasses
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Literal, NamedTuple, TYPE_CHECKING

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxquad._core import as_messages, Message, pytree_node

from ..frequency_domain._parameters import Place
from ._error_budget import Matrix
from ._response_term import PriorRows


if TYPE_CHECKING:
    from ._profiles import Profile


Kind = Literal["identifiable", "not identifiable", "no minimum", "no model", "too few points"]
NO_MINIMUM: Kind = "no minimum"  # of a remark, too
LIMIT = 0.5  # standard error, relative, above which a parameter counts as undetermined
USUAL, REACH = 0.95, 1.96  # level of an interval, and standard errors to its ends
_VAGUE = 0.3  # as LIMIT, of a combination
_MEMBER = 0.05  # share of a null direction from which a parameter takes part in it
_MOVE = 0.4  # finite relative change along a null direction, to test products against sums
_FLOOR = 1e-8  # of the largest singular value: below it lies rounding
_KINDS = ("product", "sum")

Vector = Float[np.ndarray, " parameters"]
Directions = Float[np.ndarray, "_ parameters"]


class UndeterminedError(ValueError):
    """A number was asked for that the record does not determine; a ValueError."""

    def __init__(self, reason: str):
        super().__init__(Message(reason))


def reach_of_interval(degrees_of_freedom: float, level: float | int = USUAL) -> float:
    """How many standard errors reach from the middle of an interval to its end: Student's t."""
    # Imported here: scipy.special takes a tenth of the time of `import jaxquad`.
    from scipy.special import ndtri, stdtrit

    _require_level(level)
    if not np.isinf(degrees_of_freedom):
        return float(stdtrit(degrees_of_freedom, 0.5 + level / 2))
    return REACH if level == USUAL else float(ndtri(0.5 + level / 2))


def _require_level(level: float | int) -> None:
    is_number = isinstance(level, float | int | np.number) and not isinstance(level, bool)
    if not (is_number and 0 < level < 1):
        raise ValueError(f"level is {level!r}: give a share between 0 and 1, 0.9 for 90 %")


def pooled_freedom(freedom: Vector, shares: Vector) -> float:
    """Degrees of freedom of a quantity whose variance has these `shares` of the parameters'."""
    doubt = float(np.sum(shares / freedom))
    return float(np.sum(shares)) / doubt if doubt > 0 else np.inf


class Combination(NamedTuple):
    """A product of powers, or a weighted sum, of parameters, with its standard error."""

    name: str
    value: float
    standard_error: float
    degrees_of_freedom: float = np.inf  # of the noise estimate behind the standard error
    unit: str = ""  # where it is known
    sum_of: tuple[str, ...] = ()  # the parameters of a sum
    sides: tuple[float, float] = (1.0, 1.0)  # of its interval, over what the error gives

    def content(self) -> dict[str, object]:
        """Its numbers and its unit, for JSON."""
        return {name: x for name, x in self._asdict().items() if not isinstance(x, tuple)}

    def widened(self, sides: tuple[float, float]) -> "Combination":
        """With an interval whose sides are these at least."""
        return self._replace(sides=tuple(map(max, self.sides, sides)))

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval."""
        return self.interval_at(USUAL)

    def interval_at(self, level: float | int) -> tuple[float, float]:
        """The interval that holds the truth in this share of all flights, 0.9 for 90 %."""
        reach = reach_of_interval(self.degrees_of_freedom, level) * self.standard_error
        return self.value - self.sides[0] * reach, self.value + self.sides[1] * reach

    def __str__(self) -> str:
        low, high = self.interval
        unit = f" {self.unit}" if self.unit else ""
        return (
            f"{self.name} = {self.value:.5g} +- {self.standard_error:.2g}{unit} "
            f"(std. error; 95 %: {low:.5g} .. {high:.5g})"
        )


class Bound(NamedTuple):
    """A parameter that keeps its sign and may be zero, and how far from it the record allows."""

    name: str
    value: float
    limit: float  # of the one-sided 95 % interval, with what the model leaves unexplained
    noise_limit: float  # likewise, by the measured noise alone
    beyond: float  # how far on the other side of zero the cost would be lowest

    def limit_at(self, level: float | int, *, model_error: bool = True) -> float:
        """The limit of a one-sided interval of another level, for instance 0.9.

        The cost rises as the square of the distance from its minimum, which may lie beyond zero;
        how steeply is known from the 95 % limit.
        """
        from scipy.special import ndtri

        _require_level(level)
        limit = self.limit if model_error else self.noise_limit
        if level == USUAL:
            return limit
        reach, minimum = abs(limit - self.value), self.beyond
        rise = (max(ndtri(level), 0.0) / ndtri(USUAL)) ** 2 * reach * (reach + 2 * minimum)
        return float(self.value + np.copysign(np.sqrt(minimum**2 + rise) - minimum, limit))

    def __str__(self) -> str:
        side = "below" if self.limit >= 0 else "above"
        return f"{self.name}: {self.value:.3g}, {side} {self.limit:.3g} (95 %)"


@pytree_node
class Verdict:
    """Which free parameters a record determines; true if it determines each of them individually.

    `kind` is "identifiable", "not identifiable" (the numbers are those of the best fit, but some
    could be changed together without changing the responses), "no minimum" (the solver stopped
    before one), "no model" (the structure leaves more than half of the response unexplained) or
    "too few points" (nothing was fitted). `str(verdict)` says what to do.
    """

    kind: Kind = eqx.field(static=True)
    undetermined: tuple[str, ...] = eqx.field(static=True)  # parameters
    combinations: tuple[Combination, ...]  # what is determined of the undetermined ones
    null_directions: tuple[dict[str, float], ...]  # unit vectors of relative changes
    reasons: tuple[Message, ...] = eqx.field(static=True)
    remedies: tuple[Message, ...] = eqx.field(static=True)
    exact: Float[np.ndarray, "null parameters"]  # null directions that no noise explains
    alternatives: tuple[Float[np.ndarray, " parameters"], ...]  # other values, equal responses
    curved: tuple[str, ...] = eqx.field(static=True)  # determined as neither a product nor a sum
    bounds: tuple[Bound, ...] = ()  # parameters that may be zero: determined, by a limit

    @property
    def identifiable(self) -> bool:
        """Whether the record determines every free parameter individually."""
        return self.kind == "identifiable"

    @property
    def fitted(self) -> bool:
        """Whether there was anything to fit; if not, the numbers are the starting values."""
        return self.kind != "too few points"

    @property
    def summary(self) -> str:
        """The verdict in one line."""
        if self.identifiable:
            text = "identifiable: the record determines every free parameter individually"
            return "; ".join([text, *map(str, self.bounds)])
        if self.kind != "not identifiable":
            return " ".join(self._refusal())
        determined = ", ".join(str(combination) for combination in self.combinations)
        it = "it" if len(self.undetermined) == 1 else "them"
        rest = f"only {determined}" if determined else f"nothing about {it} is determined"
        lost = " and ".join(self.undetermined)
        return f"not identifiable from this record, individually: {lost}; {rest}"

    def _refusal(self) -> tuple[str, str]:
        """Where there are no numbers: what is the matter, and why."""
        reasons = "; ".join(self.reasons)
        if not self.fitted:
            return "not identifiable", f"from this record: {reasons}"
        what = "of this structure holds" if self.kind == "no model" else "was found"
        return self.kind, f"{what}, so no parameter is determined: {reasons}"

    def __bool__(self) -> bool:
        return self.identifiable

    def __str__(self) -> str:
        if self.identifiable:
            return self.summary
        if self.kind != "not identifiable":
            kind, why = self._refusal()
            lines = [f"{kind.upper()} {why}"]
        else:
            it = "it" if len(self.undetermined) == 1 else "them"
            determined = f"nothing about {it} is determined by this record"
            if self.combinations:
                names = " and ".join(combination.name for combination in self.combinations)
                rows = self.null_directions
                every = all(name in self.undetermined for row in rows for name in row)
                only = "only " if every else ""  # else one in it is determined, too
                verb = "is" if len(self.combinations) == 1 else "are"
                determined = f"{only}{names} {verb} determined by this record"
            elif self.curved and not self.reasons:
                curved = ", ".join(self.curved)
                determined = (
                    f"what it determines of {curved} is neither a product nor a sum of them"
                )
            lines = [
                "NOT IDENTIFIABLE from this record, individually: " + ", ".join(self.undetermined),
                f"  {determined}",
                *(f"    {combination}" for combination in self.combinations),
            ]
            for direction in self.null_directions:
                parts = ", ".join(f"{share:+.3f} {name}" for name, share in direction.items())
                lines.append(
                    "  null direction (relative changes that leave the responses unchanged): "
                    f"{parts}"
                )
            lines += [f"  {line}" for line in (*self.reasons, *self.bounds)]
        if self.remedies:
            first, *others = self.remedies
            lines += [f"  to resolve it: {first}", *(f"  or {other}" for other in others)]
        return "\n".join(lines)


def without_numbers(kind: Kind, names: tuple[str, ...], reason: str, *remedies: str) -> Verdict:
    """A verdict under which no parameter, and no combination of them, is determined."""
    return Verdict(
        kind=kind,
        undetermined=names,
        combinations=(),
        null_directions=(),
        reasons=as_messages([reason]),
        remedies=as_messages(remedies),
        exact=np.eye(len(names)),
        alternatives=(),
        curved=(),
    )


class Information(NamedTuple):
    """All that the decision rests on: free parameters first, then the fixed ones.

    The fixed ones take part in names only: the arm L in L K_t / J_x. `root` holds derivatives of
    ln-magnitudes and phases (alternate rows), in units of their random error, by relative changes;
    `covariance` is that of the free ones, `without` a resonance, or `by_noise`; other values of the
    free ones may give the `same` responses.
    """

    root: Float[np.ndarray, "rows all"]
    covariance: Matrix
    without: Matrix
    by_noise: Matrix
    places: Sequence[Place]
    values: Float[np.ndarray, " all"]
    units: Float[np.ndarray, " all"]
    same: Callable[[Vector], bool]
    profiles: Sequence["Profile"] = ()


def identifiability_of(
    information: Information, prior: PriorRows, bounds: tuple[Bound, ...] = ()
) -> tuple[Verdict, Verdict]:
    """What data and priors determine together, and the data alone. Parameters with a bound are
    determined by it, and take part in no direction."""
    by_data = _determine(information, bounds)
    if not len(prior.misfit):
        return by_data, by_data
    # Rows come in pairs of magnitude and phase; a prior's row counts once.
    priors = np.repeat(prior.slopes, 2, axis=0) / np.sqrt(2)
    together = information._replace(root=np.concatenate([information.root, priors]))
    return _determine(together, bounds), by_data


def _determine(information: Information, bounds: tuple[Bound, ...]) -> Verdict:
    """Null directions of the Fisher information, and the combinations outside them."""
    count, places = len(information.covariance), information.places
    if bounds:
        at_zero = {bound.name for bound in bounds}
        kept = np.array([k for k, place in enumerate(places) if place.name not in at_zero], int)
        free = kept[kept < count]

        def completed(values: np.ndarray) -> np.ndarray:
            """With the bounded ones where they are."""
            complete = information.values[:count].copy()
            complete[free] = values
            return complete

        some = Information(
            root=information.root[:, kept],
            covariance=information.covariance[np.ix_(free, free)],
            without=information.without[np.ix_(free, free)],
            by_noise=information.by_noise[np.ix_(free, free)],
            places=[places[k] for k in kept],
            values=information.values[kept],
            units=information.units[kept],
            same=lambda values: information.same(completed(values)),
            profiles=[profile.among(free) for profile in information.profiles],
        )
        verdict = _determine(some, ())
        exact = np.zeros((len(verdict.exact), count))
        exact[:, free] = verdict.exact
        alternatives = tuple(completed(values) for values in verdict.alternatives)
        return dataclasses.replace(verdict, exact=exact, alternatives=alternatives, bounds=bounds)
    root = information.root[:, :count]
    # All rows of `right` are wanted, and of the other factor none.
    _, singular, right = np.linalg.svd(root, full_matrices=len(root) < count)
    singular = np.concatenate([singular, np.zeros(count - len(singular))])
    is_exact = singular <= _FLOOR * singular[0]
    null, exact = right[is_exact | (singular * LIMIT < 1)], right[is_exact]
    null = _sparse(null) if len(null) else null
    # What a record determines is a matter of its noise: a standard error beyond the limit. What is
    # unknown by all of its size, model error included, is of no use to anyone.
    parts = np.stack([information.without, information.by_noise])
    errors = np.sqrt(np.maximum(np.diagonal(parts, axis1=1, axis2=2), 0.0))
    imprecise = (errors[0] > 2 * LIMIT) | (errors[1] > LIMIT)
    values, units = information.values[:count], np.abs(information.units[:count])
    for profile in information.profiles:
        imprecise = profile.undetermined(values, errors[0] * units, imprecise)
    lost = np.any(null, axis=0) | imprecise
    left = imprecise & ~np.any(null, axis=0)
    if left.any():  # the direction of most variance of an imprecise parameter that is in none
        spread, directions = np.linalg.eigh(information.without)
        most = {int(np.argmax(spread * directions[k] ** 2)) for k in np.flatnonzero(left)}
        null = _sparse(np.concatenate([null, directions.T[sorted(most)]]))
    names, remedies = [place.name for place in places[:count]], []
    undetermined = tuple(name for name, one in zip(names, lost, strict=True) if one)
    combinations, alternatives, curved = _analyse_groups(null, exact, information)
    if undetermined:
        both = " or ".join(undetermined)
        remedies = [
            f"fix {both} at a measured value« (leave it out of free=)»",
            "give a known value: "
            "priors=[jq.identify.Prior(name or function, value, standard error)]",
            f"fit a second record under a known change of {both}: "
            "conditions=(None, jq.identify.Changed(name, change))",
        ]
    return Verdict(
        kind="not identifiable" if undetermined else "identifiable",
        undetermined=undetermined,
        combinations=tuple(combinations),
        null_directions=tuple(
            {name: float(x) for name, x in zip(names, row, strict=True) if x} for row in null
        ),
        reasons=(),
        remedies=as_messages(remedies),
        exact=exact,
        alternatives=tuple(alternatives),
        curved=tuple(curved),
    )


def _sparse(null: Directions) -> Directions:
    """Unit directions spanning the same space, with small shares left out."""
    rows = _echelon(null)
    rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    return np.where(np.abs(rows) > _MEMBER, rows, 0.0)


def _echelon(rows: Directions) -> Directions:
    """Reduced row echelon form with full pivoting: the same space, with many zeros."""
    rows, pivots = rows.copy(), []
    for k in range(len(rows)):
        rest = np.abs(rows[k:])
        rest[:, pivots] = 0
        i, j = np.unravel_index(np.argmax(rest), rest.shape)
        rows[[k, k + i]] = rows[[k + i, k]]
        rows[k] /= rows[k, j]
        others = [m for m in range(len(rows)) if m != k]
        rows[others] -= np.outer(rows[others, j], rows[k])
        pivots.append(j)
    return rows


def _analyse_groups(
    null: Directions, exact: Directions, information: Information
) -> tuple[list[Combination], list[Vector], list[str]]:
    """Of each group of parameters in null directions: combinations of the kind, product or sum,
    that holds over a finite change, values there, and names of which neither holds."""
    combinations, alternatives, curved = [], [], []
    if not len(null):
        return combinations, alternatives, curved
    # A pseudo-inverse shows no variance along exact null directions.
    keep = np.eye(null.shape[1]) - exact.T @ exact
    parts = np.stack([information.covariance, information.without])
    parts = keep @ parts @ keep + 1e4 * exact.T @ exact
    information = information._replace(covariance=parts[0], without=parts[1])
    groups: list[set[int]] = []
    for row in null:
        group = set(np.flatnonzero(row).tolist())
        for other in [other for other in groups if other & group]:
            groups.remove(other)
            group |= other
        groups.append(group)
    sparse = _sparse(exact) if len(exact) else exact
    for block in (np.array(sorted(group)) for group in groups):
        mine = sparse[np.any(sparse[:, block], axis=1)]
        moved = {}
        if len(mine):  # a finite way along null directions, at constant products and sums
            shares = np.arange(1, len(mine) + 1)[:, None] / len(mine)
            change = _MOVE * np.sum(mine * shares, axis=0)
            values, units = information.values[: null.shape[1]], information.units[: null.shape[1]]
            moved = {"product": values * np.exp(change), "sum": values + units * change}
            moved = {kind: x for kind, x in moved.items() if information.same(x)}
        kinds = tuple(moved) if len(mine) else _KINDS
        # Combinations of the members that no null direction moves.
        directions = null[:, block][np.any(null[:, block], axis=1)]
        _, singular, right = np.linalg.svd(directions, full_matrices=True)
        rows = _echelon(right[int(np.sum(singular > 1e-6)) :])
        effects = information.root[:, block] @ np.linalg.pinv(rows) if len(rows) else rows.T
        for k, row in enumerate(rows) if kinds else ():
            combination = _combination(row, block, effects[:, k], information, kinds)
            combinations += [] if combination is None else [combination]
        alternatives += moved.values()
        curved += [] if kinds or not len(rows) else [information.places[k].name for k in block]
    return combinations, alternatives, curved


def _combination(
    row: np.ndarray, block: np.ndarray, effect: np.ndarray, information: Information,
    kinds: tuple[str, ...],
) -> Combination | None:  # fmt: skip
    """The product or sum, as a person would write it, that is as sharp as `row` of the `block`.

    Exponents are whole numbers up to 2, coefficients 1 or -1, and cost no more than a quarter in
    standard error. None where nothing of the kind is as sharp, or where its error is beyond 30 %.
    """
    weights, count = np.zeros(len(information.values)), len(information.covariance)
    weights[block] = row
    if "product" in kinds:  # with fixed parameters that act just as the combination does
        for k in range(count, len(weights)):
            column = information.root[:, k]
            power = float(column @ effect) / max(float(effect @ effect), 1e-300)
            rest = np.linalg.norm(column - power * effect)
            if abs(power) > 0.1 and rest < 1e-6 * np.linalg.norm(column):
                weights[k] = power
        weights = -weights if np.sum(effect[::2]) < 0 else weights  # to raise the response
    order = lambda k: (information.places[k].leaf, information.places[k].index)
    used = np.array(sorted(np.flatnonzero(weights), key=order))  # as the model orders them
    relative = np.zeros((2, len(weights), len(weights)))
    relative[:, :count, :count] = information.covariance, information.without
    (relative, without), weights = relative[:, used[:, None], used], weights[used]
    names, values = [information.places[k].name for k in used], information.values[used]
    units = information.units[used]  # the value itself where its logarithm is fitted
    error = lambda w, by=relative: float(np.sqrt(max(w @ by @ w, 0.0)))

    def simplest(weights: Vector, largest: int) -> Vector | None:
        """The nearest vector of whole numbers up to `largest`, or None if there is none near."""
        unit = weights / np.max(np.abs(weights))
        parts = [Fraction(float(w)).limit_denominator(largest) for w in unit]
        exact = np.array([float(part) for part in parts])
        integers = exact * np.lcm.reduce([part.denominator for part in parts])
        near = np.max(np.abs(exact - unit)) < 0.25 and np.max(np.abs(integers)) <= largest
        return integers * np.sign(weights @ integers) if near else None

    def as_sharp(simple: Vector) -> bool:
        along = abs(float(simple @ weights)) / float(weights @ weights)
        return error(simple, without) <= 1.25 * error(weights, without) * along

    powers = simplest(weights, 2) if "product" in kinds and np.all(units == values) else None
    sums = simplest(weights / units, 1) if "sum" in kinds else None
    powers = powers if powers is not None and as_sharp(powers) else None
    sums = sums if sums is not None and as_sharp(sums * units) else None
    # Times that only lower the response add up.
    if sums is not None and (
        powers is None or np.abs(sums).max() < np.abs(powers).max() or np.all(powers <= 0)
    ):
        sums = sums * np.sign(sums[np.argmax(np.abs(sums * units))])
        name, terms = "", [(w, n) for w, n in zip(sums, names, strict=True) if w]
        for w, n in terms:
            sign = ("- " if w < 0 else "") if not name else (" - " if w < 0 else " + ")
            name += sign + (n if abs(w) == 1 else f"{abs(w):g} {n}")
        value, members = float(np.sum(sums * values)), tuple(n for _, n in terms)
        combination = Combination(name, value, error(sums * units), sum_of=members)
        slopes, of_places = sums, lambda numbers: numbers @ sums
    elif powers is not None:
        value, pairs = float(np.prod(np.abs(values) ** powers)), zip(names, powers, strict=True)
        texts = [(n if abs(p) == 1 else f"{n}^{abs(p):g}", p) for n, p in pairs]
        above, below = ([text for text, p in texts if p * sign > 0] for sign in (1, -1))
        name = " ".join(above) or "1"
        if below:
            name += " / " + (below[0] if len(below) == 1 else f"({' '.join(below)})")
        combination = Combination(name, value, value * error(powers))
        slopes = value * powers / values
        of_places = lambda numbers: np.prod(np.abs(numbers) ** powers, axis=1)
    else:
        return None
    slope = np.zeros(len(information.values))
    slope[used] = slopes
    for profile in information.profiles:
        places = np.tile(information.values, (len(profile.values), 1))
        places[:, :count] = profile.values
        numbers = value, combination.standard_error, slope[:count]
        combination = combination.widened(profile.sides_of(of_places(places[:, used]), *numbers))
    widest = combination.standard_error * max(combination.sides)
    return combination if widest <= _VAGUE * abs(value) else None
