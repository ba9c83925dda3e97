"""Models over time: beside what was measured, and after a step."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, PyTree
from matplotlib.axes import Axes

from jaxquad.identify import (
    compare as compare_models,
    Comparison,
    Fit,
    linear_model,
    step_response,
    Verification,
)
from jaxquad.models import Model
from jaxquad.records import clock_start, Record
from jaxquad.spectra import estimate_step, StepResponse

from ._histories import extremes
from ._labels import few_ticks, look_of, Style
from ._names import unit_label
from ._panels import arrange, Given, legend_of, Panels, stacked, WIDTH
from ._shown import analysed, Channels, channels_shown, Measured, named, named_models, Thing


Samples = Float[np.ndarray, " samples"]


def compare(
    models: PyTree | Mapping[str, PyTree] | Sequence[PyTree],
    record: Record | None = None,
    *,
    band: tuple[float, float] | None = None,
    hold: str | None = None,
    ax: Given = None,
    title: str = "",
) -> Panels:
    """Draw measured outputs and what models predict over time, with their differences below.

    The legend has the fit in per cent of each model. Angles are in degrees. A long curve is drawn
    through its extremes, so that no peak is lost.

    !!! example

        ```python
        jq.plot.compare({"with lag": one, "without": other}, second_flight)
        ```

    **Arguments:**

    - `models`, `record`, `band`, `hold`: as in `jq.compare`; or instead of the models what it or
        `jq.verify` returned.
    - `ax`: axes to draw into, two for each output.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.

    **Raises:** what `jq.compare` raises; ValueError for models without a record.
    """
    checks = _checks(models, record, band, hold)
    first = next(iter(checks.values()))
    count = len(first.outputs)
    panels = stacked(2 * count, ax)
    for k in range(count):
        _draw_output(panels[2 * k], panels[2 * k + 1], checks, k)
    panels[-1].set_xlabel("time, s")
    heights = [2.4, 1.0] if count == 1 else [1.8, 0.9] * count
    lines = [title, *([_measures(first)] if len(checks) == 1 else [])]
    return arrange(panels, heights, title="\n".join(filter(None, lines)))


def _checks(
    models: PyTree,
    record: Record | None,
    band: tuple[float, float] | None,
    hold: str | None,
) -> dict[str, Verification]:
    if isinstance(models, Verification):
        return {"simulated, open loop": models}
    if isinstance(models, Comparison):
        return models.checks
    if record is None:
        raise ValueError(
            "compare needs a record beside the models: give compare(models, record), or what "
            "jq.compare or jq.verify returned"
        )
    return compare_models(models, record, band=band, hold=hold).checks


def _measures(check: Verification) -> str:
    where = f", {check.band[0]:.3g}..{check.band[1]:.3g} rad/s" if check.band else ""
    return (
        f"fit {check.fit_percent:.1f} %, variance accounted for {check.variance_percent:.1f} %, "
        f"TIC {check.tic:.3f}{where}"
    )


def _draw_output(top: Axes, bottom: Axes, checks: Mapping[str, Verification], k: int) -> None:
    first = next(iter(checks.values()))
    one, shape = first.outputs[k], (first.time.size, len(first.outputs))
    scale, unit = unit_label(one.unit)
    measured = scale * first.measured.reshape(shape)[:, k]
    ink = {"color": "0.15", "lw": 1.0} if len(checks) == 1 else {"color": "0.7", "lw": 3.0}
    _plot(top, _shown(first.time), measured, ink | {"label": "measured"})
    for m, (name, check) in enumerate(checks.items()):
        simulated = scale * check.simulated.reshape(shape)[:, k]
        text = name if len(checks) == 1 else f"{name}: {check.outputs[k].fit_percent:.1f} %"
        look = look_of(m, text) | ({"ls": "--"} if len(checks) == 1 else {})
        alone: Style = {"color": "tab:red", "ls": "-"} if len(checks) == 1 else {}
        _plot(top, _shown(check.time), simulated, look)
        _plot(bottom, _shown(check.time), measured - simulated, look | {"lw": 0.9} | alone)
    top.legend(loc="upper right", fontsize=8 if len(checks) > 1 else 9, ncols=2)
    top.set_ylabel(f"{one.name}{unit}")
    bottom.set_ylabel(f"difference{unit}")
    few_ticks(bottom.yaxis, 4)
    for axis in (top, bottom):
        axis.grid(True, color="0.9", lw=0.5)
        axis.margins(x=0)
    low, high = top.get_ylim()
    top.set_ylim(low, high + (0.15 + 0.1 * (len(checks) > 1)) * (high - low))


def _shown(time: np.ndarray) -> np.ndarray:
    """Time stamps that are dates count from the first of them."""
    return time - clock_start(time)


def _plot(panel: Axes, time: Samples, values: Samples, style: Style) -> None:
    kept = extremes(values)
    panel.plot(time[kept], values[kept], **style)


class _Answer(NamedTuple):
    """What a step makes of one model or loop."""

    time: Samples
    value: Float[np.ndarray, "samples outputs inputs"]
    reach: Float[np.ndarray, "samples outputs inputs"] | None = None


_SAMPLES = 601
_TIME_CONSTANTS = 6.0  # that a step response lasts
_LONGEST = 60.0  # s, where nothing says how long it lasts


def step(
    *shown: Thing,
    duration: float | None = None,
    pair: tuple[str, str] | None = None,
    ax: Given = None,
    title: str = "",
) -> Panels:
    """Draw the answers of models, fits, closed loops and flown loops to a unit step.

    A fit has its 95 % band, model error included. Of a loop its first axis is simulated: the angle,
    per step of 1 deg of the reference. Of a record with a reference it is what was flown, from its
    reference to its first output, with the 95 % band by the scatter between windows, see
    `jq.spectra.estimate_step`.

    !!! example

        ```python
        jq.plot.step({"identified": fit, "data sheet": model}, duration=1.0)
        jq.plot.step(loop)
        ```

    **Arguments:**

    - `shown`: models that `jq.verify` takes, fits, `jq.Loop`s, records, measured step responses;
        one by one, in lists, or in mappings from the texts of the legend.
    - `duration`: in s; by default six times the slowest time constant.
    - `pair`: names of output and input of a fit (`y1`, `u1` of a model); by default all, an input
        for each column.
    - `ax`: axes to draw into, one for each pair.
    - `title`: above the figure.

    **Returns:** `jq.plot.Panels`.

    **Raises:** ValueError for what has no step response, such as a frequency response or a record
    without a reference, and for an unknown `pair`.
    """
    given = named(shown)
    records = [each for each in given.values() if isinstance(each, Record)]
    things = {
        name: estimate_step(thing, length=duration) if isinstance(thing, Record) else thing
        for name, thing in given.items()
    }
    named_models(things, "step")
    end = max(map(_duration, things.values())) if duration is None else float(duration)
    time = np.linspace(0.0, end, _SAMPLES)
    answers = {name: _answer(thing, time) for name, thing in things.items()}
    channels = _channels(things, answers, records)
    places = channels.places(pair)
    columns = len({i for _, i in places})
    panels = stacked(len(places), ax, columns=columns)
    for panel, (o, i) in zip(panels, places, strict=True):
        scale, unit = _unit_of_ratio(channels.output_units[o], channels.input_units[i])
        for k, (name, found) in enumerate(answers.items()):
            _draw_answer(panel, found, (o, i), scale, look_of(k, name))
        panel.set_ylabel(f"{channels.ratio(o, i) or 'answer to a unit step'}{unit}")
        panel.grid(True, color="0.92", lw=0.5)
        panel.margins(x=0)
    for panel in panels[-columns:]:
        panel.set_xlabel("time, s")
    width = WIDTH if columns == 1 else 4.2 * columns
    legend = legend_of(panels[:1]) if len(answers) > 1 or _has_band(answers) else None
    return arrange(panels, [2.6] * (len(places) // columns), columns=columns, width=width,
                   title=title, legend=legend, handle_length=3.0)  # fmt: skip


def _unit_of_ratio(output: str, source: str) -> tuple[float, str]:
    """Factor and label of an output per input, with angles in degrees."""
    (above, one), (below, other) = unit_label(output), unit_label(source)
    if one == other:
        return above / below, ""
    per = f" per {other.removeprefix(', ')}" if one and other else ""
    return above / below, f"{one}{per}"


def _has_band(answers: Mapping[str, _Answer]) -> bool:
    return any(found.reach is not None for found in answers.values())


def _duration(thing: Thing) -> float:
    if isinstance(thing, StepResponse):
        return float(thing.time[-1])
    if not isinstance(thing, Fit | Model):
        poles = analysed("the loop", thing, "step").poles
    else:
        poles = linear_model(thing.model if isinstance(thing, Fit) else thing).poles
    rates = np.abs(np.real(poles[np.isfinite(poles)]))
    rates = rates[rates > _TIME_CONSTANTS / _LONGEST]
    return float(_TIME_CONSTANTS / rates.min()) if rates.size else _LONGEST


def _answer(thing: Thing, time: Samples) -> _Answer:
    if isinstance(thing, StepResponse):
        reach = 1.96 * thing.standard_error
        return _Answer(thing.time, thing.mean[:, None, None], reach[:, None, None])
    if isinstance(thing, Fit):
        found = thing.step_response(time)
        return _Answer(found.time, found.value, found.reach)
    if isinstance(thing, Model):
        return _Answer(time, step_response(thing, time))
    return _closed_loop(thing, float(time[-1]))


def _closed_loop(loop: Thing, duration: float) -> _Answer:
    """A step of 1 deg of the first axis, per deg. Raises ValueError for what is no single loop."""
    from jaxquad.loops import Loop
    from jaxquad.simulation import scenario, simulate, Step  # here: most figures show no loop

    if not isinstance(loop, Loop):
        raise ValueError(f"step cannot draw a {type(loop).__name__}: give its jq.Loop")
    axes = np.shape(loop.plant.measure(loop.plant.init()))[0]
    size = float(np.radians(1.0))
    whole = loop.dt * max(round(duration / loop.dt), 2)
    flown = simulate(
        loop, scenario(duration=whole, dt=loop.dt, axes=axes, reference={0: Step(size)})
    )
    angle = np.asarray(flown.angle)[:, 0] / size
    return _Answer(np.asarray(flown.time), angle[:, None, None])


def _channels(
    things: Mapping[str, Thing], answers: Mapping[str, _Answer], records: Sequence[Record]
) -> Channels:
    """Names and units of the first fit or record that has them; else numbers."""
    shapes = {name: found.value.shape[1:] for name, found in answers.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(
            f"models of different channels (outputs, inputs): {shapes}; draw them one by one"
        )
    origins = [x.origin for x in things.values() if isinstance(x, Fit) and x.origin is not None]
    if origins:
        return channels_shown([Measured("", origins[0].frfs[0])], [])
    flown = [thing.names for thing in things.values() if isinstance(thing, StepResponse)]
    if flown:
        reference, output = flown[0]
        units = [records[0].unit(name) for name in (output, reference)] if records else ["", ""]
        return Channels((output,), (reference,), (units[0],), (units[1],), True)
    outputs, inputs = next(iter(shapes.values()))
    return Channels.numbered(outputs, inputs)


def _draw_answer(
    panel: Axes, found: _Answer, place: tuple[int, int], scale: float, look: Style
) -> None:
    value = scale * found.value[:, *place]
    if found.reach is not None:
        reach = scale * found.reach[:, *place]
        panel.fill_between(found.time, value - reach, value + reach, alpha=0.3, lw=0,
                           color=look["color"], label=f"{look['label']}, 95 %")  # fmt: skip
    panel.plot(found.time, value, **look)
