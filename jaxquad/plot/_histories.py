from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import ArrayLike, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ._labels import Style


_LINES = [
    {"color": "black", "ls": "-", "lw": 1.3},
    {"color": "tab:blue", "ls": "--", "lw": 1.6},
    {"color": "tab:red", "ls": "-.", "lw": 1.4},
    {"color": "tab:green", "ls": (0, (1, 1.2)), "lw": 1.8},
    {"color": "0.45", "ls": (0, (6, 1, 1, 1, 1, 1)), "lw": 1.4},
]
_TARGET = {"color": "0.75", "ls": "-", "lw": 4.0, "zorder": 1}


def histories(
    time: Float[ArrayLike, " samples"],
    panels: Mapping[str, Mapping[str, Float[ArrayLike, " samples"]]],
    *,
    target: str | None = None,
    limits: Mapping[str, tuple[float, float]] | None = None,
    title: str = "",
) -> Figure:
    """Draw curves over time in stacked panels; they differ in their lines as well as in colour.

    **Arguments:**

    - `time`: in s.
    - `panels`: the curves by name for each panel, by the text of its vertical axis, such as
      "roll, deg". A name has the same line in all panels. Values that are not finite are left out.
    - `target`: the name of a set-point or a truth, drawn behind the others as a wide grey line.
    - `limits`: of vertical axes, by their text.
    - `title`: above the figure.

    **Raises:** ValueError for more curves than there are lines, and for limits of an unknown panel.
    """
    style = _styles(panels, target)
    unknown = [text for text in limits or {} if text not in panels]
    if unknown:
        raise ValueError(f"limits for {unknown}, but the panels are {list(panels)}")
    height = 0.9 + 2.3 * len(panels)
    figure = Figure(figsize=(6.5, max(height, 3.6)), layout="constrained")
    axes = list(figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0])
    for axis, (text, curves) in zip(axes, panels.items(), strict=True):
        for name, values in curves.items():
            shown = np.asarray(values, float)
            axis.plot(time, np.where(np.isfinite(shown), shown, np.nan), label=name, **style[name])
        axis.set_ylabel(text)
        axis.grid(True, color="0.92", lw=0.5)
        axis.margins(x=0)
        axis.set_ylim((limits or {}).get(text, axis.get_ylim()))
    axes[-1].set_xlabel("time, s")
    _legend(figure, axes)
    if title:
        figure.suptitle(title, fontsize=10)
    return figure


def _styles(
    panels: Mapping[str, Mapping[str, Float[ArrayLike, " samples"]]], target: str | None
) -> dict[str, Style]:
    names = list(dict.fromkeys(name for curves in panels.values() for name in curves))
    others = [name for name in names if name != target]
    if len(others) > len(_LINES):
        raise ValueError(
            f"{len(others)} curves are too many to be distinguished, {len(_LINES)} is the most: "
            f"split {others} over several figures"
        )
    return dict(zip(others, _LINES, strict=False)) | ({target: _TARGET} if target else {})


def _legend(figure: Figure, axes: Sequence[Axes]) -> None:
    named = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    columns = min(len(named), 3)
    figure.legend(
        named.values(), named.keys(), loc="outside lower center", ncols=columns, fontsize=9,
        handlelength=3.5,
    )  # fmt: skip
