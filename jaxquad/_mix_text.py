"""Weighted sums of channels as a user types them: `roll=-m1-m2+0.5*m[4]`, `thrust=0.1*m1^2`."""

import re


Mix = dict[str, dict[str, float]]  # name -> channel, or its power `m1^2`, -> weight

_NAME = r"(?![\d.])(?:\[[^\]]*\]|[^\s+*\[\]^-])+"  # a channel; within brackets anything goes
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TERM = re.compile(rf"\s*([+-]?)\s*(?:({_NUMBER})\s*\*\s*)?({_NAME})\s*(\^\s*[2-9](?![\d.]))?\s*")


def parse_mix(text: str) -> Mix:
    """`M`, or a sum of weighted channels and of their powers: name -> channel -> weight.

    `roll=-m1-m2+0.5*m[4]`, `thrust=0.02*m1+0.1*m1^2`. Raises ValueError for what is neither.
    """
    name, sign, terms = (part.strip() for part in text.partition("="))
    weights: dict[str, float] = {} if sign or not name else {name: 1.0}
    place = 0
    while place < len(terms):
        term = _TERM.match(terms, place)
        if not term or (place and not term[1]):
            raise ValueError(
                f"{text!r}: cannot read {terms[place:]!r}; write NAME=-a+b+0.5*c, or 0.1*c^2"
            )
        power = f"^{term[4][1:].strip()}" if term[4] else ""
        weight, channel = float(f"{term[1]}{term[2] or 1}"), f"{term[3]}{power}"
        weights[channel] = weights.get(channel, 0.0) + weight
        place = term.end()
    if not name or not weights:
        raise ValueError(f"{text!r} names no channel; write NAME=-a+b+0.5*c")
    return {name: weights}


def power_of(term: str) -> tuple[str, int]:
    """The channel and the power of a term of a mix: `m1^2` is `m1` and 2."""
    channel, sign, power = term.rpartition("^")
    return (channel, int(power)) if sign and channel and power in set("23456789") else (term, 1)
