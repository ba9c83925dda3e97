"""What a record determines of a model's parameters, in numbers and in words."""

from typing import Literal, NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxquad._core import as_messages, Message, pytree_node


Kind = Literal["identifiable", "not identifiable", "no minimum", "no model", "too few points"]
NO_MINIMUM: Kind = "no minimum"  # of a remark, too


class UndeterminedError(ValueError):
    """A number was asked for that the record does not determine; a ValueError."""

    def __init__(self, reason: str):
        super().__init__(Message(reason))


USUAL = 0.95  # level of an interval


def reach_of_interval(degrees_of_freedom: float, level: float | int = USUAL) -> float:
    """How many standard errors reach from the middle of an interval to its end.

    **Arguments:**

    - `degrees_of_freedom`: of the noise estimate behind the standard errors; infinite where the
        noise is known.
    - `level`: the share of intervals that hold the truth.

    **Returns:** the point of Student's t with half of 1 - `level` above it, 97.5 % by default.
    """
    # Imported here: scipy.special takes a tenth of the time of `import jaxquad`.
    from scipy.special import ndtri, stdtrit

    _require_level(level)
    if not np.isinf(degrees_of_freedom):
        return float(stdtrit(degrees_of_freedom, 0.5 + level / 2))
    return 1.96 if level == USUAL else float(ndtri(0.5 + level / 2))


def _require_level(level: float | int) -> None:
    is_number = isinstance(level, float | int | np.number) and not isinstance(level, bool)
    if not (is_number and 0 < level < 1):
        raise ValueError(f"level is {level!r}: give a share between 0 and 1, 0.9 for 90 %")


def pooled_freedom(
    freedom: Float[np.ndarray, " parameters"], shares: Float[np.ndarray, " parameters"]
) -> float:
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

    def content(self) -> dict[str, object]:
        """Its numbers and its unit, for JSON."""
        return {name: value for name, value in self._asdict().items() if name != "sum_of"}

    @property
    def interval(self) -> tuple[float, float]:
        """The 95 % interval."""
        return self.interval_at(USUAL)

    def interval_at(self, level: float | int) -> tuple[float, float]:
        """The interval that holds the truth in this share of all flights, 0.9 for 90 %."""
        reach = reach_of_interval(self.degrees_of_freedom, level) * self.standard_error
        return self.value - reach, self.value + reach

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
            lines = [
                "NOT IDENTIFIABLE from this record, individually: " + ", ".join(self.undetermined),
                *self._determined(),
                *(f"  {reason}" for reason in self.reasons),
                *(f"  {bound}" for bound in self.bounds),
            ]
        if self.remedies:
            first, *others = self.remedies
            lines += [f"  to resolve it: {first}", *(f"  or {other}" for other in others)]
        return "\n".join(lines)

    def _determined(self) -> list[str]:
        it = "it" if len(self.undetermined) == 1 else "them"
        lines = [f"  nothing about {it} is determined by this record"]
        if self.combinations:
            names = " and ".join(combination.name for combination in self.combinations)
            rows = self.null_directions
            every = all(name in self.undetermined for row in rows for name in row)
            only = "only " if every else ""  # else one in it is determined, too
            lines = [f"  {only}{names} is determined by this record"]
        elif self.curved and not self.reasons:
            curved = ", ".join(self.curved)
            lines = [f"  what it determines of {curved} is neither a product nor a sum of them"]
        lines += [f"    {combination}" for combination in self.combinations]
        for direction in self.null_directions:
            parts = ", ".join(f"{share:+.3f} {name}" for name, share in direction.items())
            lines.append(
                f"  null direction (relative changes that leave the responses unchanged): {parts}"
            )
        return lines


def remedies_for(lost: tuple[str, ...]) -> tuple[Message, ...]:
    """What determines parameters that one record leaves open."""
    names = " or ".join(lost)
    texts = (
        f"fix {names} at a measured value« (leave it out of free=)»",
        "give a known value: priors=[jq.identify.Prior(name or function, value, standard error)]",
        f"fit a second record under a known change of {names}: "
        "conditions=(None, jq.identify.Changed(name, change))",
    )
    return as_messages(texts)


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
