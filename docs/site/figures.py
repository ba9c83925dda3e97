"""The picture of the README: a log, its response with a model and bands, the tuned gains in flight.

    python docs/site/figures.py

writes `docs/images/log_to_gains.png` from the measured flight of `jaxquad demo --flight`, which is
found through `JAXQUAD_DATA`, or downloaded. It takes about three minutes.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure, SubFigure
from PIL import Image

import jaxquad as jq
from jaxquad.tuning import worst_flights
from jaxquad.workflows import find_demo_flight, identify, tune, TuneSettings


PICTURE = Path(__file__).parents[1] / "images" / "log_to_gains.png"
# The inertia is assumed: an axis is tuned for it, and for half and twice of it.
SETTINGS = TuneSettings(
    inertia=0.02, spread=(0.5, 2.0), limit=0.75, wo=70.0, step=10.0, disturbance=0.1
)
_STYLE = {"font.size": 9, "axes.labelsize": 9, "legend.fontsize": 8}


def main() -> None:
    jq.enable_x64()
    jq.enable_compile_cache()
    found = identify(*find_demo_flight())
    done = tune(found, SETTINGS, progress=False)
    print(found.fit, done, sep="\n\n")
    flights = worst_flights(done.tuned, done.loop, done.ensemble, done.flight)
    PICTURE.parent.mkdir(exist_ok=True)
    with plt.rc_context(_STYLE):  # pyright: ignore[reportArgumentType]
        figure = draw(found.records[0], found.frf, found.fit, flights)
        figure.savefig(PICTURE, dpi=100, pil_kwargs={"optimize": True})
    _fewer_colours(PICTURE)
    print(f"{PICTURE}: {PICTURE.stat().st_size / 1000:.0f} kB")


def draw(
    record: jq.Record,
    frf: jq.spectra.FrequencyResponse,
    fit: jq.identify.Fit,
    flights: Mapping[str, jq.simulation.Simulation],
) -> Figure:
    """Three pictures side by side, 12 by 4 inches."""
    figure = Figure(figsize=(12.0, 4.0), layout="constrained")
    parts: Any = figure.subfigures(1, 3, width_ratios=(1, 1.05, 1))
    log, response, flown = parts
    axes = log.subplots(2, sharex=True)
    jq.plot.record_figure(jq.records.select(record, inputs="M", outputs="q"), ax=axes)
    _finish(log, axes, "1   flight log")
    axes = response.subplots(2, sharex=True)
    spare = Figure().subplots()  # of the coherence, for which there is no room
    jq.plot.bode({"measured": frf, "model": fit}, ax=[*axes, spare])
    axes[1].set_xlabel("frequency, rad/s")
    _finish(response, axes, "2   model with error bars")
    axes = flown.subplots(2, sharex=True)
    jq.plot.histories(next(iter(flights.values())).time, _panels(flights), target=_TARGET, ax=axes)
    _finish(flown, axes, "3   certified gains")
    return figure


def _fewer_colours(path: Path) -> None:
    """A third of the bytes."""
    with Image.open(path) as image:
        small = image.convert("RGB").quantize(96)
    small.save(path, optimize=True)


_TARGET = "set-point"


def _panels(
    flights: Mapping[str, jq.simulation.Simulation],
) -> dict[str, dict[str, np.ndarray]]:
    """Angle and command; the disturbance is a pulse in the middle."""
    degrees = lambda x: np.degrees(np.asarray(x)[:, 0])
    target = {_TARGET: degrees(next(iter(flights.values())).reference)}
    short = {name.partition(" (")[0]: one for name, one in flights.items()}
    angles = {name: degrees(one.angle) for name, one in short.items()}
    commands = {name: np.asarray(one.command)[:, 0] for name, one in short.items()}
    return {"pitch, deg": target | angles, "command M": commands}


def _finish(part: SubFigure, axes: np.ndarray, title: str) -> None:
    """A title above, and the legend below instead of on the curves."""
    part.suptitle(title, fontsize=10.5, fontweight="bold")
    panels: list[Axes] = list(axes)
    if (legend := panels[0].get_legend()) is not None:
        handles, labels = panels[0].get_legend_handles_labels()
        legend.remove()
        part.legend(handles, labels, loc="outside lower center", ncols=2, handlelength=2.6,
                    frameon=False)  # fmt: skip
    part.align_ylabels(panels)


if __name__ == "__main__":
    main()
