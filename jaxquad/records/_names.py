import difflib
from collections.abc import Iterable, Sequence

from ._errors import RecordError


Names = str | Sequence[str] | None
_MOST = 40


def unknown_name(name: str, known: Iterable[str]) -> str:
    """What an error says of a `name` that is not among the `known` ones, with the nearest."""
    known = list(known)
    plain = {each.lower(): each for each in known}
    near = difflib.get_close_matches(name.lower(), plain, n=1)
    guess = f" Did you mean {plain[near[0]]!r}?" if near else ""
    return f"there is no channel {name!r}.{guess} The channels are: {listed(known)}."


def listed(names: Iterable[str]) -> str:
    """The names, separated by commas; of many, the first 40."""
    names = list(names)
    more = f", and {len(names) - _MOST} more" if len(names) > _MOST else ""
    return f"{', '.join(names[:_MOST]) or 'none'}{more}"


def as_names(names: Names, letter: str, count: int) -> tuple[str, ...]:
    """Names of `count` channels; by default `letter`, or `letter` with a number from 1."""
    if names is None:
        return (letter,) if count == 1 else tuple(f"{letter}{i + 1}" for i in range(count))
    names = as_tuple(names)
    if len(names) != count:
        raise RecordError(
            f"{len(names)} names {names} for {count} channels: give one name for each channel."
        )
    return names


def as_units(units: Names, names: Sequence[str]) -> tuple[str, ...]:
    """One unit for each of the `names`; by default none is known (an empty string)."""
    if units is None:
        return ("",) * len(names)
    units = as_tuple(units)
    if len(units) != len(names):
        raise RecordError(
            f"{len(units)} units {units} for the channels {tuple(names)}: give one unit for each."
        )
    return units


def as_tuple(names: str | Iterable[str]) -> tuple[str, ...]:
    """A single string is one name, not a sequence of letters."""
    return (names,) if isinstance(names, str) else tuple(names)


def check_distinct(names: Sequence[str]) -> None:
    """Raise RecordError for a name that stands for two channels."""
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise RecordError(
            f"the channel name {twice[0]!r} occurs {names.count(twice[0])} times among "
            f"{', '.join(names)}: give each channel of the record a different name."
        )


def printable(text: str) -> str:
    """Text from a file without terminal control characters, cut to 500 characters."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text[:500])
