"""Figures of the page: Plotly's dictionaries, and traces with zoom and the range that is used."""

import html
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from nicegui import events, ui

from jaxquad.records import Channel, envelope

from ._shown import Step


PLOT = ui.plotly  # named here: what a page may import is in its head before it is made
Figure = dict[str, Any]
Span = tuple[float | None, float | None]
_POINTS = 2000  # of a trace: more than a screen has
_GREY = "#8a8f98"  # of letters and lines, on white and on black
_LINES = {  # told apart in grey, too
    "set-point": {"color": "#8a8f98", "width": 2.2},
    "rate": {"color": "#d1495b", "width": 1.1},
    "command": {"color": "#2f6fb4", "width": 1.1},
    "throttle": {"color": "#3a8f5c", "width": 1.3},
}
_ROWS = (("set-point", "rate"), ("command",), ("throttle",))
_STEPS = {
    "measured": {"color": "#c27c0e", "width": 1.4, "dash": "dot"},
    "flown": {"color": "#8a8f98", "width": 2.2, "dash": "dash"},
    "proposed": {"color": "#2f6fb4", "width": 2.2},
}
_WHAT = {
    "measured": "with feed-forward", "flown": "without feed-forward",
    "proposed": "without feed-forward",
}  # fmt: skip
_CONFIG = {
    "displayModeBar": False, "scrollZoom": False,  # the wheel moves the page
}  # fmt: skip


def trace_figure(
    channels: Mapping[str, Channel], shown: tuple[float, float], taken: Span
) -> Figure:
    """Set-point and rate, command, and throttle over the time.

    **Arguments:**

    - `channels`: by what they are; others stand below, each by itself.
    - `shown`: from when to when, in s; of more samples than a screen has, the extremes are drawn.
    - `taken`: start and stop of what is analysed; None: the log's.
    """
    rows = [[name for name in row if name in channels] for row in _ROWS]
    rows = [row for row in rows if row] + [[name] for name in channels if name not in _LINES]
    data, layout = [], _layout(height=150 + 110 * len(rows))
    for k, row in enumerate(rows):
        axis = "y" if k == 0 else f"y{k + 1}"
        unit = channels[row[-1]].unit
        title = html.escape(f"{row[-1]}, {unit}" if unit else row[-1])  # Plotly draws links
        layout["yaxis" + axis[1:]] = _axis() | {
            "title": {"text": title, "standoff": 6},
            "domain": [1 - (k + 0.94) / len(rows), 1 - k / len(rows)], "fixedrange": True,
        }  # fmt: skip
        for name in row:
            time, values = envelope(channels[name], *shown, _POINTS)
            line = _LINES.get(name, _LINES["command"])
            data.append({
                "type": "scatter", "mode": "lines", "name": html.escape(name), "line": line,
                "xaxis": "x", "x": _numbers(time), "y": _numbers(values), "yaxis": axis,
                "hovertemplate": f"%{{y:.4g}} {html.escape(channels[name].unit)}",
            })  # fmt: skip
    last = "y" if len(rows) == 1 else f"y{len(rows)}"
    layout |= {
        "xaxis": _axis() | {
            "title": {"text": "time, s"}, "anchor": last, "range": list(shown),
            "hoverformat": ".3f",
        },
        "dragmode": "zoom", "uirevision": "log",
        "shapes": [
            {
                "type": "rect", "xref": "x", "yref": "paper", "x0": a, "x1": b, "y0": 0, "y1": 1,
                "fillcolor": _GREY, "opacity": 0.28, "line": {"width": 0},
            }
            for a, b in _left_out(channels, taken)
        ],
    }  # fmt: skip
    return {"data": data, "layout": layout, "config": _CONFIG}


def _left_out(channels: Mapping[str, Channel], taken: Span) -> list[tuple[float, float]]:
    low, high = extent(channels)
    start, stop = taken
    before = [] if start is None or start <= low else [(low, start)]
    return before + ([] if stop is None or stop >= high else [(stop, high)])


def extent(channels: Mapping[str, Channel]) -> tuple[float, float]:
    """First and last time of the channels, in s."""
    times = [channel.time for channel in channels.values()]
    return min(float(t[0]) for t in times), max(float(t[-1]) for t in times)


class Traces:
    """Channels over the time, and below a slider with two ends.

    **Arguments:**

    - `channels`: by what they are, such as "rate", or by their names.
    - `taken`: start and stop of what is used, in s; None: the ends of the log.
    - `word`: of the button, which calls `use` with what is chosen.
    """

    def __init__(
        self, channels: Mapping[str, Channel], taken: Span, word: str, use: Callable[[Span], None]
    ):
        self.channels, self.ends = channels, extent(channels)
        low, high = self.ends
        self.shown = self.ends
        self.taken = low if taken[0] is None else taken[0], high if taken[1] is None else taken[1]
        self.plot = PLOT(self._figure()).classes("plot")
        self.plot.on("plotly_relayout", self._zoom)
        with ui.element("div").classes("range"):
            values = {"min": round(self.taken[0], 2), "max": round(self.taken[1], 2)}
            slider = ui.range(min=round(low, 2), max=round(high, 2), step=0.01, value=values)
            slider.props('drag-range aria-label="range of time that is used, s"')
            slider.on_value_change(self._move)
            slider.on("change", self._draw)  # when it is let go
            self.said = ui.label(self._words()).classes("soft")
            ui.button(word, on_click=lambda: use(self.taken)).props("outline no-caps")

    def _words(self) -> str:
        return f"used: {self.taken[0]:.2f} to {self.taken[1]:.2f} s"

    def _figure(self) -> dict[str, Any]:
        return trace_figure(self.channels, self.shown, self.taken)

    def _draw(self) -> None:
        self.plot.update_figure(self._figure())

    def _move(self, event: events.ValueChangeEventArguments) -> None:
        self.taken = float(event.value["min"]), float(event.value["max"])
        self.said.text = self._words()

    def _zoom(self, event: events.GenericEventArguments) -> None:
        """Draw the part that is shown with as many points as a screen has."""
        changed = event.args or {}
        if "xaxis.range[0]" in changed:
            self.shown = float(changed["xaxis.range[0]"]), float(changed["xaxis.range[1]"])
        elif "xaxis.range" in changed:
            low, high = changed["xaxis.range"]
            self.shown = float(low), float(high)
        elif changed.get("xaxis.autorange"):
            self.shown = self.ends
        else:
            return
        self._draw()


def step_figure(steps: Mapping[str, Step]) -> Figure:
    """The rate after a step of the set-point, median and 95 % of the plants.

    That of "measured" is the log's own, with its random error.
    """
    data = []
    for name, band in steps.items():
        line = _STEPS[name]
        common = {"type": "scatter", "mode": "lines", "x": _numbers(band.time)}
        fill = _faint(line["color"])
        edge = common | {"line": {"width": 0}, "showlegend": False, "hoverinfo": "skip"}
        data += [
            edge | {"y": _numbers(band.low)},
            edge | {"y": _numbers(band.high), "fill": "tonexty", "fillcolor": fill},
            common | {
                "y": _numbers(band.middle), "name": f"{name}, {_WHAT[name]}", "line": line,
                "customdata": np.stack([band.low, band.high], 1).round(3).tolist(),
                "hovertemplate": "%{y:.3f} (%{customdata[0]:.2f} to %{customdata[1]:.2f})",
            },
        ]  # fmt: skip
    computed = {name: x for name, x in steps.items() if name != "measured"} or steps
    layout = _layout(height=300) | {
        "xaxis": _axis() | {
            "title": {"text": "time after the step, s"},
            "range": [0, max(band.settled for band in computed.values())],
        },
        "yaxis": _axis() | {"title": {"text": "rate after a step of 1"}},
    }  # fmt: skip
    return {"data": data, "layout": layout, "config": _CONFIG}


def _layout(height: int) -> dict[str, Any]:
    return {
        "height": height, "autosize": True, "hovermode": "x unified", "font": {"color": _GREY},
        "margin": {"l": 62, "r": 12, "t": 8, "b": 44}, "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "legend": {"orientation": "h", "y": 1.0, "yanchor": "bottom", "x": 0},
        "hoverlabel": {"font": {"color": "#1c1f23"}, "bgcolor": "#f6f8fa"},
    }  # fmt: skip


def _axis() -> dict[str, Any]:
    return {"gridcolor": "rgba(138,143,152,0.25)", "zerolinecolor": "rgba(138,143,152,0.5)"}


def _faint(color: str) -> str:
    red, green, blue = (int(color[k : k + 2], 16) for k in (1, 3, 5))
    return f"rgba({red},{green},{blue},0.22)"


def _numbers(values: Sequence[float] | np.ndarray) -> list[float | None]:
    """With None for what is not finite, as JSON wants it."""
    return [float(f"{x:.7g}") if np.isfinite(x) else None for x in np.asarray(values).tolist()]
