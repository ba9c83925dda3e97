"""Weighted sums of channels as a user types them: `roll=-m1-m2+0.5*m[4]`."""

import re


Mix = dict[str, dict[str, float]]  # name -> channel -> weight

_NAME = r"(?![\d.])(?:\[[^\]]*\]|[^\s+*\[\]-])+"  # a channel; within brackets anything goes
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TERM = re.compile(rf"\s*([+-]?)\s*(?:({_NUMBER})\s*\*\s*)?({_NAME})\s*")


def parse_mix(text: str) -> Mix:
    """`M`, or `roll=-m1-m2+0.5*m[4]` as a weighted sum: name -> channel -> weight."""
    name, sign, terms = (part.strip() for part in text.partition("="))
    weights: dict[str, float] = {} if sign or not name else {name: 1.0}
    place = 0
    while place < len(terms):
        term = _TERM.match(terms, place)
        if not term or (place and not term[1]):
            raise ValueError(f"{text!r}: cannot read {terms[place:]!r}; write NAME=-a+b+0.5*c")
        weight = float(f"{term[1]}{term[2] or 1}")
        weights[term[3]] = weights.get(term[3], 0.0) + weight
        place = term.end()
    if not name or not weights:
        raise ValueError(f"{text!r} names no channel; write NAME=-a+b+0.5*c")
    return {name: weights}
