"""Models against measurements: over time, after a step, and what they leave unexplained."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, PyTree
from matplotlib.ticker import MaxNLocator

import jaxquad.identify as identify
from jaxquad.identify import Comparison, Fit, linear_model, Verification
from jaxquad.models import Model
from jaxquad.records import clock_start, Record
from jaxquad.spectra import estimate_step, FrequencyResponse, StepResponse

from . import _panels as lay
from ._flights import plot_over_time, Samples
from ._panels import AxesLike, COHERENT, Panels, Style
from ._shown import analysed, Channels, Measured, named, named_models, Shown, Thing


def compare(
    models: PyTree | Mapping[str, PyTree] | Sequence[PyTree], record: Record | None = None, *,
    band: tuple[float, float] | None = None, hold: str | None = None, ax: AxesLike = None,
    title: str = "",
) -> Panels:  # fmt: skip
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

    **Raises:** what `jq.compare` raises; ValueError for models without a record.
    """
    if isinstance(models, Verification):
        checks = {models.method: models}
    elif isinstance(models, Comparison):
        checks = models.checks
    elif record is None:
        raise ValueError(
            "compare needs a record beside the models: give compare(models, record), or what "
            "jq.compare or jq.verify returned"
        )
    else:
        checks = identify.compare(models, record, band=band, hold=hold).checks
    first, single = next(iter(checks.values())), len(checks) == 1
    count = len(first.outputs)
    panels = lay.stacked(2 * count, ax)
    for k, one in enumerate(first.outputs):
        top, bottom = panels[2 * k], panels[2 * k + 1]
        scale, unit = lay.unit_label(one.unit)
        measured = scale * first.measured.reshape(-1, count)[:, k]
        ink = {"color": "0.15", "lw": 1.0} if single else {"color": "0.7", "lw": 3.0}
        plot_over_time(top, first.time, measured, ink | {"label": "measured"})
        for m, (name, check) in enumerate(checks.items()):
            simulated = scale * check.simulated.reshape(-1, count)[:, k]
            text = name if single else f"{name}: {check.outputs[k].fit_percent:.1f} %"
            look = lay.look_of(m, text) | ({"ls": "--"} if single else {})
            thin: Style = {"lw": 0.9} | ({"color": "tab:red", "ls": "-"} if single else {})
            plot_over_time(top, check.time, simulated, look)
            plot_over_time(bottom, check.time, measured - simulated, look | thin)
        top.legend(loc="upper right", fontsize=9 if single else 8, ncols=2)
        top.set_ylabel(f"{one.name}{unit}")
        bottom.set_ylabel(f"difference{unit}")
        lay.few_ticks(bottom.yaxis, 4)
        for axis in (top, bottom):
            axis.grid(True, color="0.9", lw=0.5)
            axis.margins(x=0)
        low, high = top.get_ylim()
        top.set_ylim(low, high + (0.15 + 0.1 * (not single)) * (high - low))
    panels[-1].set_xlabel("time, s")
    lines = [title]
    if single:
        where = f", {first.band[0]:.3g}..{first.band[1]:.3g} rad/s" if first.band else ""
        lines += [
            f"fit {first.fit_percent:.1f} %, variance accounted for {first.variance_percent:.1f} %,"
            f" TIC {first.tic:.3f}{where}"
        ]
    heights = [2.4, 1.0] if count == 1 else [1.8, 0.9] * count
    return lay.arrange(panels, heights, title="\n".join(filter(None, lines)))


class _Answer(NamedTuple):
    """What a step makes of one model or loop."""

    time: Samples
    value: Float[np.ndarray, "samples outputs inputs"]
    reach: Float[np.ndarray, "samples outputs inputs"] | None = None


_SAMPLES = 601
_TIME_CONSTANTS = 6.0  # that a step response lasts
_LONGEST = 60.0  # s, where nothing says how long it lasts


def step(
    *shown: Thing, duration: float | None = None, pair: tuple[str, str] | None = None,
    ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
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

    **Raises:** ValueError for what has no step response, such as a frequency response or a record
    without a reference, and for an unknown `pair`.
    """
    named_things = named(shown)
    records = [thing for thing in named_things.values() if isinstance(thing, Record)]
    things = {
        name: estimate_step(thing, length=duration) if isinstance(thing, Record) else thing
        for name, thing in named_things.items()
    }
    named_models(things, "step")
    end = max(map(_duration, things.values())) if duration is None else float(duration)
    time = np.linspace(0.0, end, _SAMPLES)
    answers = {name: _answer(thing, time) for name, thing in things.items()}
    shapes = {name: answer.value.shape[1:] for name, answer in answers.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(
            f"models of different channels (outputs, inputs): {shapes}; draw them one by one"
        )
    origins = [x.origin for x in things.values() if isinstance(x, Fit) and x.origin is not None]
    flown = [thing.names for thing in things.values() if isinstance(thing, StepResponse)]
    if origins:  # names and units of the first fit or record that has them; else numbers
        channels = Shown([Measured("", origins[0].frfs[0])], []).channels
    elif flown:
        reference, output = flown[0]
        units = [records[0].unit(name) for name in (output, reference)] if records else ["", ""]
        channels = Channels((output,), (reference,), (units[0],), (units[1],), True)
    else:
        channels = Channels.numbered(*next(iter(shapes.values())))
    places = channels.places(pair)
    columns = len({i for _, i in places})
    panels = lay.stacked(len(places), ax, columns=columns)
    for panel, (o, i) in zip(panels, places, strict=True):
        above, unit = lay.unit_label(channels.output_units[o])
        below, other = lay.unit_label(channels.input_units[i])
        if unit == other:
            unit = ""
        elif unit and other:
            unit += f" per {other.removeprefix(', ')}"
        for k, (name, answer) in enumerate(answers.items()):
            look, value = lay.look_of(k, name), above / below * answer.value[:, o, i]
            if answer.reach is not None:
                reach = above / below * answer.reach[:, o, i]
                panel.fill_between(answer.time, value - reach, value + reach, alpha=0.3, lw=0,
                                   color=look["color"], label=f"{name}, 95 %")  # fmt: skip
            panel.plot(answer.time, value, **look)
        panel.set_ylabel(f"{channels.ratio(o, i) or 'answer to a unit step'}{unit}")
        panel.grid(True, color="0.92", lw=0.5)
        panel.margins(x=0)
    for panel in panels[-columns:]:
        panel.set_xlabel("time, s")
    width = lay.WIDTH if columns == 1 else 4.2 * columns
    bands = any(answer.reach is not None for answer in answers.values())
    legend = lay.legend_of(panels[:1]) if len(answers) > 1 or bands else None
    return lay.arrange(panels, [2.6] * (len(places) // columns), columns=columns, width=width,
                   title=title, legend=legend, handle_length=3.0)  # fmt: skip


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
    """Of a loop the first axis after a step of 1 deg, per deg. Raises ValueError for no loop."""
    if isinstance(thing, StepResponse):
        reach = 1.96 * thing.standard_error
        return _Answer(thing.time, thing.mean[:, None, None], reach[:, None, None])
    if isinstance(thing, Fit):
        band = thing.step_response(time)
        return _Answer(band.time, band.value, band.reach)
    if isinstance(thing, Model):
        return _Answer(time, identify.step_response(thing, time))
    from jaxquad.loops import Loop
    from jaxquad.simulation import scenario, simulate, Step  # here: most figures show no loop

    if not isinstance(thing, Loop):
        raise ValueError(f"step cannot draw a {type(thing).__name__}: give its jq.Loop")
    axes = np.shape(thing.plant.measure(thing.plant.init()))[0]
    size, dt = float(np.radians(1.0)), thing.dt
    duration = dt * max(round(float(time[-1]) / dt), 2)
    flown = simulate(
        thing, scenario(duration=duration, dt=dt, axes=axes, reference={0: Step(size)})
    )
    angle = np.asarray(flown.angle)[:, 0] / size
    return _Answer(np.asarray(flown.time), angle[:, None, None])


_SIGMAS = 1.96  # of a normal error, that hold 95 %
_OUTSIDE = 6.0  # standard errors, where the picture ends at least


class Residuals(NamedTuple):
    """Measured minus model, of one response, in units of its random error."""

    omega: Float[np.ndarray, " frequencies"]  # rad/s
    magnitude: Float[np.ndarray, " frequencies"]
    phase: Float[np.ndarray, " frequencies"]
    decibels: Float[np.ndarray, " frequencies"]  # the same in dB
    degrees: Float[np.ndarray, " frequencies"]  # and in deg
    coherent: Bool[np.ndarray, " frequencies"]

    @property
    def outside(self) -> float:
        """Share of the coherent points beyond 1.96 errors: 5 % if the model explains them."""
        return float(np.mean(np.abs(self._both) > _SIGMAS)) if self.coherent.any() else np.nan

    @property
    def rms(self) -> float:
        """Of the coherent points: 1 if the model explains them."""
        return float(np.sqrt(np.mean(self._both**2))) if self.coherent.any() else np.nan

    @property
    def _both(self) -> Float[np.ndarray, " points"]:
        return np.concatenate([self.magnitude[self.coherent], self.phase[self.coherent]])


def residuals_of(frf: FrequencyResponse, model: Model, output: int, source: int) -> Residuals:
    """The logarithm of measured over modelled response, whose parts are magnitude and phase.

    **Arguments:**

    - `frf`, `model`: the measured response, and a model with `frequency_response(omega)`.
    - `output`, `source`: places of output and input.
    """
    omega = np.asarray(frf.omega)
    modelled = identify.model_response(identify.as_sampled(model, frf), omega)[:, output, source]
    pair = (slice(None), output, source)
    with np.errstate(all="ignore"):
        difference = np.log(np.asarray(frf.response)[pair] / modelled)
        error = np.maximum(np.asarray(frf.random_error)[pair], 1e-7)
        size, angle = np.real(difference), np.imag(difference)
        finite = np.isfinite(difference) & np.isfinite(error)
        coherent = finite & (np.asarray(frf.coherence)[pair] >= COHERENT)
        decibels, degrees = 20 / np.log(10) * size, np.degrees(angle)
        return Residuals(omega, size / error, angle / error, decibels, degrees, coherent)


def resid(
    model: PyTree, data: FrequencyResponse | Record | None = None, *,
    pair: tuple[str, str] | None = None, ax: AxesLike = None, title: str = "",
) -> Panels:  # fmt: skip
    """Draw what a model leaves unexplained: of a response over frequency, of a record over time.

    Over frequency, measured minus model is in units of its random error, with the band that holds
    95 % of white ones; points whose coherence is below 0.6 are faint. Over time, each output has
    two panels: measured minus simulated, and its autocorrelation with the bound within which 95 %
    of the lags of white noise lie.

    !!! example

        ```python
        jq.plot.resid(fit)  # on the response that was fitted
        jq.plot.resid(fit, second_flight)
        ```

    **Arguments:**

    - `model`: a fit, or a model as `jq.verify` or `jq.fit` take it; or what is drawn already, a
        `jq.plot.Residuals` or a `jq.identify.Verification`.
    - `data`: a measured response or a record; by default the response of the fit.
    - `pair`: names of output and input of a measured response; by default the first of each.
    - `ax`: axes to draw into: two, of a record two for each output.

    **Raises:** ValueError for a model without data, and for an unknown `pair`.
    """
    if isinstance(model, Residuals):
        return _over_frequency(model, ax, title)
    if isinstance(model, Verification):
        return _over_time(model, ax, title)
    fitted = model.model if isinstance(model, Fit) else model
    if data is None and isinstance(model, Fit) and model.origin is not None:
        data = model.origin.frfs[0]
    if isinstance(data, Record):
        return _over_time(identify.verify(fitted, data), ax, title)
    if data is None:
        raise ValueError(
            "resid needs what was measured: give a response or a record as the second argument"
        )
    [(o, i), *_] = Shown([Measured("", data)], []).channels.places(pair)
    return _over_frequency(residuals_of(data, fitted, o, i), ax, title)


def _over_frequency(residuals: Residuals, ax: AxesLike, title: str) -> Panels:
    panels = lay.stacked(2, ax)
    for panel, values, text in (
        (panels[0], residuals.magnitude, "magnitude"),
        (panels[1], residuals.phase, "phase"),
    ):
        panel.axhspan(-_SIGMAS, _SIGMAS, color="0.87", lw=0)
        panel.axhline(0, color="0.4", lw=0.8)
        good, faint = residuals.coherent, ~residuals.coherent & np.isfinite(values)
        panel.plot(residuals.omega[faint], values[faint], "o", ms=3, mfc="none", mec="0.7")
        panel.plot(residuals.omega[good], values[good], "o", ms=3.5, color="0.15")
        reach = max(_OUTSIDE, 1.1 * np.max(np.abs(values[good]), initial=0.0))
        panel.set_ylim(-reach, reach)
        panel.yaxis.set_major_locator(MaxNLocator(5, integer=True))
        panel.set_ylabel(f"{text} / error")
        panel.grid(True, color="0.93", lw=0.5)
        panel.set_xscale("log")
        lay.plain_ticks(panel.xaxis)
    panels[1].set_xlabel("frequency, rad/s")
    panels[1].set_xlim(residuals.omega[0] / 1.05, residuals.omega[-1] * 1.05)
    lay.add_hertz(panels[0])
    return lay.arrange(panels, (1.6, 1.6), above=0.45, title=title)


def autocorrelation(values: Float[np.ndarray, " samples"]) -> Float[np.ndarray, " lags"]:
    """The autocorrelation of a signal about its mean, at lags of 0 to a quarter of its samples."""
    centred = values - np.mean(values)
    spectrum = np.abs(np.fft.rfft(centred, 2 * values.size)) ** 2
    lags = np.fft.irfft(spectrum)[: max(values.size // 4, 2)]
    return lags / lags[0] if lags[0] > 0 else lags


_LAGS = 400  # that are drawn


def _over_time(check: Verification, ax: AxesLike, title: str) -> Panels:
    count, samples = len(check.outputs), check.time.size
    panels = lay.stacked(2 * count, ax, shared=False)
    left = (check.measured - check.simulated).reshape(samples, count)
    dt = float(check.time[-1] - check.time[0]) / (samples - 1)
    for k, one in enumerate(check.outputs):
        scale, unit = lay.unit_label(one.unit)
        top, bottom = panels[2 * k], panels[2 * k + 1]
        top.plot(check.time - clock_start(check.time), scale * left[:, k], color="tab:red", lw=0.8)
        top.set(ylabel=f"{one.name}, measured\nminus model{unit}", xlabel="time, s")
        correlation, bound = autocorrelation(left[:, k])[:_LAGS], _SIGMAS / np.sqrt(samples)
        bottom.axhspan(-bound, bound, color="0.85", lw=0)
        bottom.axhline(0, color="0.4", lw=0.8)
        bottom.plot(dt * np.arange(correlation.size), correlation, color="0.15", lw=1.0)
        outside = 100 * float(np.mean(np.abs(correlation[1:]) > bound))
        bottom.text(0.99, 0.93, f"{outside:.0f} % of the lags outside (5 % if white)", fontsize=8,
                    ha="right", va="top", transform=bottom.transAxes)  # fmt: skip
        bottom.set(xlabel="lag, s", ylabel="autocorrelation")
        for panel in (top, bottom):
            panel.grid(True, color="0.92", lw=0.5)
            lay.few_ticks(panel.yaxis, 5)
            panel.margins(x=0)
    return lay.arrange(panels, [1.7, 1.5] * count, gap=0.55, title=title)
