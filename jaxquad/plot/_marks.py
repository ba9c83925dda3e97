"""Marks that tell designs apart without colour."""

import re
from collections.abc import Iterable
from typing import Any


_MARKS = (
    {"marker": "o", "color": "black", "mfc": "black", "ms": 4.0, "mew": 0.8},
    {"marker": "s", "color": "tab:red", "mfc": "none", "ms": 4.0, "mew": 0.8},
    {"marker": "^", "color": "tab:orange", "mfc": "none", "ms": 4.5, "mew": 0.8},
    {"marker": "D", "color": "tab:blue", "mfc": "none", "ms": 3.5, "mew": 0.8},
    {"marker": "+", "color": "tab:green", "mfc": "none", "ms": 5.5, "mew": 1.0},
    {"marker": "v", "color": "tab:purple", "mfc": "none", "ms": 4.5, "mew": 0.8},
    {"marker": "*", "color": "0.4", "mfc": "0.7", "ms": 6.0, "mew": 0.6},
)


def marks(names: Iterable[str]) -> dict[str, dict[str, Any]]:
    """A mark for each design, by its place. Raises ValueError for more than there are."""
    names = list(names)
    if len(names) > len(_MARKS):
        raise ValueError(
            f"{len(names)} designs cannot be told apart, {len(_MARKS)} can: leave some of {names} "
            "out"
        )
    return {name: dict(mark) for name, mark in zip(names, _MARKS, strict=False)}


def limit_line(panel: Any, bound: float, text: str) -> None:
    """A dashed line that says what it is, at its right end."""
    panel.axhline(bound, color="black", lw=1.0, ls="--", zorder=3.5)
    box = {"boxstyle": "square,pad=0.15", "fc": "white", "ec": "none", "alpha": 0.85}
    panel.annotate(
        text, (1.0, bound), xycoords=("axes fraction", "data"), xytext=(-3, 2),
        textcoords="offset points", ha="right", va="bottom", fontsize=8, bbox=box, zorder=5,
    )  # fmt: skip


def pretty(text: str) -> str:
    """Powers raised."""
    return re.sub(r"\^(\d+)", r"$^{\1}$", text)
