"""The flown loop: its step response beside the model's, and the broken loop with its margins."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

import jaxquad.spectra as spectra
from jaxquad.identify import (
    as_sampled,
    behind_filters,
    Fit,
    KnownFilter,
    model_response,
    with_values,
)
from jaxquad.models import Model
from jaxquad.plot import add_hertz, plain_ticks, short_names, StepBand, steps_figure, unit_label
from jaxquad.records import Record
from jaxquad.spectra import BrokenLoop, Entry, FrequencyResponse, StepResponse

from ._page import embed_figure, Section, Table


Samples = Float[np.ndarray, " samples"]
_ROOM = 2  # times the flight, behind which its transients have ended
_BEFORE = 0.05  # share of a response's energy before its cause, from which the model is unstable
_GRID = 512  # frequencies at which a model is evaluated, the number of one program
_SMALL = 0.1  # of a standard error: a step of a derivative
_GREY = 20  # windows that are drawn
_POINTS = 300  # of a curve: as many as its figure has pixels


class Prediction(NamedTuple):
    """The model's output and its standard error, None where that is unbounded."""

    mean: Samples
    error: Samples | None


def step_section(
    fit: Fit, frf: FrequencyResponse, record: Record, filters: Sequence[KnownFilter] = (),
    computed: StepBand | None = None,
) -> Section | None:  # fmt: skip
    """Measured and predicted step response; None without a reference or room for one.

    What is `computed` from law and model is shown where the log does not show a step.
    """
    if not record.reference_names:
        return None
    try:
        step = spectra.estimate_step(record, output=frf.output_names[0])
    except ValueError:
        return None
    (reference, output), image = step.names, None
    head: Section = {"names": step.names, "doubts": step.doubts}
    if not step.is_conclusive:
        if computed is not None:
            over = 100 * max(float(np.max(computed.middle)) - 1, 0.0)
            caption = (
                "The logged rate after a step of 1 of the set-point, computed from the law of the "
                "log's parameters, with the integral as set, and the identified model: overshoot "
                f"{over:.0f} %; median and 95 % of the plants that the log leaves possible."
            )
            alt = (
                f"Rate after a step of 1 of the set-point by law and model: overshoot {over:.0f} %."
            )
            draw = lambda: steps_figure({"law and model": computed})
            image = embed_figure(draw, alt=alt, caption=caption)
        return head | {"image": None, "table": None, "notes": [], "computed": image}
    predicted = None
    if fit.verdict.fitted:
        predicted = predict_step(fit, frf, behind_filters(record, filters))
    image = embed_figure(
        lambda: _draw_step(record, step, predicted),
        alt=f"{output} after a step of 1 in {reference}: each window in grey, their mean with its "
        f"95 % band{', and the prediction of the model' if predicted else ''}. {step}",
        caption=f"{output} after a step of 1 in {reference}, deconvolved from "
        f"{len(step.windows)} windows (grey) of the log.",
    )
    error = 100 * float(step.standard_error[-1]) / abs(step.final)
    notes = [
        f"The data suffice: the reference moves in {len(step.windows)} of {step.total} windows, "
        f"and the standard error of the final value is {error:.2g} %."
    ]
    if not step.is_resolved:
        notes.append(
            f"The rise is blurred: a perfect step would rise in {1e3 * step.blur:.3g} ms here. "
            "The true rise is faster than the one that is shown, and its overshoot larger."
        )
    if predicted is not None:
        notes.append(
            "The model is driven by the flown inputs, so that no controller has to be known; in "
            "each window it may drift from the output. Its band counts its parameters, and gusts."
        )
    in_ms = lambda seconds: f"{1e3 * seconds:.3g}" if np.isfinite(seconds) else "not in the window"
    final = lambda value, error: f"{value:.3g} \u00b1 {1.96 * error[-1]:.1g}"
    heads, rows = ("", "measured"), [
        ["rise time (10 to 90 %), ms", in_ms(step.rise_time)],
        ["overshoot, %", f"{100 * step.overshoot:.2g}"],
        ["settling time (5 %), ms", in_ms(step.settling_time)],
        ["final value", final(step.final, step.standard_error)],
    ]  # fmt: skip
    if predicted is not None:
        model, error = step._replace(mean=predicted.mean), predicted.error
        # Over the measured final value, which is the sharper.
        over = max(0.0, float(np.max(model.mean)) / step.final - 1)
        last = f"{model.final:.3g}" if error is None else final(model.final, error)
        cells = [in_ms(model.rise_time), f"{100 * over:.2g}", "\u2013", last]
        heads += ("model",)
        rows = [[*row, cell] for row, cell in zip(rows, cells, strict=True)]
    table = Table("Step response (95 % intervals)", heads, rows)
    return head | {"image": image, "table": table, "notes": notes}


def predict_step(fit: Fit, frf: FrequencyResponse, record: Record) -> Prediction | None:
    """What the model makes of the flown inputs, through the filter of the measured step; None for
    an unstable one, whose output says nothing."""
    inputs = np.stack([record.channel(name) for name in frf.input_names], axis=1)
    inputs -= inputs.mean(0)

    def stepped(model: Model) -> tuple[Samples, Samples] | None:
        """The simulated step with its error by the scatter between windows."""
        driven, integrators = _driven(as_sampled(model, frf), inputs, record.dt)
        if driven is None:
            return None
        output = frf.output_names[0]
        step = spectra.estimate_step(record, output=output, simulated=driven, drift=integrators)
        if step.simulated is None or step.simulated_error is None:
            return None
        return step.simulated, step.simulated_error

    mean = stepped(fit.model)
    if mean is None or not np.all(np.isfinite(fit.covariance)) or not np.all(fit.standard_errors):
        return None if mean is None else Prediction(mean[0], None)
    places, slopes = fit.parameters.places[: len(fit.names)], []
    for k, error in enumerate(fit.standard_errors):
        values = np.array(fit.values, float)
        values[k] += _SMALL * error
        moved = stepped(with_values(fit.model, places, values))
        if moved is None:
            return Prediction(mean[0], None)
        slopes.append((moved[0] - mean[0]) / (_SMALL * error))
    spread = np.einsum("pt,pq,qt->t", np.array(slopes), fit.covariance, np.array(slopes))
    return Prediction(mean[0], np.sqrt(np.maximum(spread, 0.0) + mean[1] ** 2))


def _driven(
    model: Model, inputs: Float[np.ndarray, "flight inputs"], dt: float
) -> tuple[Float[np.ndarray, " flight"] | None, int]:
    """The first output of a model at rest, None if it is unstable; and its integrators, which are
    taken out of the spectrum, where they are infinite, and are done in time."""
    count = len(inputs)
    size = 2 ** int(np.ceil(np.log2(_ROOM * count)))  # quick to transform
    omega = 2 * np.pi * np.fft.rfftfreq(size, dt)
    omega[0], omega[-1] = 1e-3 * omega[1], 0.999 * omega[-1]
    grid = np.geomspace(omega[0], omega[-1], _GRID)
    response = model_response(model, grid)[:, 0]
    slope = np.diff(np.log(np.max(np.abs(response[:2]), axis=1)))[0] / np.log(grid[1] / grid[0])
    integrators = int(np.clip(np.round(-slope), 0, 2))
    response = response * (1j * grid[:, None]) ** integrators
    # Logarithm and phase are straight between frequencies, as a delay's are.
    size_of = np.log(np.maximum(np.abs(response), 1e-300))
    angle = np.unwrap(np.angle(response), axis=0)
    between = lambda values: np.stack([np.interp(omega, grid, one) for one in values.T], axis=1)
    finite = np.exp(between(size_of) + 1j * between(angle))
    impulse = np.fft.irfft(finite, size, axis=0)
    if np.sum(impulse[size // 2 :] ** 2) > _BEFORE * np.sum(impulse**2):
        return None, integrators
    output = np.fft.irfft(np.sum(np.fft.rfft(inputs, size, axis=0) * finite, axis=1), size)[:count]
    for _ in range(integrators):
        output = dt * np.concatenate([[0.0], np.cumsum((output[1:] + output[:-1]) / 2)])
    return output, integrators


def _draw_step(record: Record, step: StepResponse, predicted: Prediction | None) -> Figure:
    figure = Figure(figsize=(5.0, 3.4))
    panel = figure.add_axes((0.14, 0.14, 0.82, 0.72))
    (one, below), (other, above) = (unit_label(record.unit(name)[:12]) for name in step.names)
    below, above = below.removeprefix(", "), above.removeprefix(", ")
    scale, unit = other / one, "" if above == below else f", {above or '1'} / {below or '1'}"
    every = slice(None, None, -(-step.time.size // _POINTS))
    time = step.time[every]
    for window in step.windows[:_GREY]:
        panel.plot(time, scale * window[every], color="0.82", lw=0.6, label="_nolegend_")
    curves = [("measured", "0.15", "-", step.mean, step.standard_error)]
    if predicted is not None:
        curves += [("model", "tab:blue", "--", predicted.mean, predicted.error)]
    for name, colour, dash, mean, error in curves:
        mean = scale * mean[every]
        panel.plot(time, mean, color=colour, ls=dash, lw=1.6, label=name)
        if error is not None:
            reach = 1.96 * (scale * error[every])
            panel.fill_between(time, mean - reach, mean + reach, color=colour, alpha=0.2, lw=0,
                               label=f"{name}, 95 %")  # fmt: skip
    panel.axhline(scale * step.final, color="0.5", lw=0.7, ls=":", label="_nolegend_")
    low, high = np.min(scale * step.mean), np.max(scale * step.mean)
    reach = high - low
    panel.set(xlabel="time after the step, s", xlim=(step.time[0] / 2, step.time[-1]),
              ylim=(low - 0.35 * reach, high + 0.35 * reach))  # fmt: skip
    names = short_names(step.names)
    panel.set_ylabel(f"{names[1]} per {names[0]}{unit}")
    panel.grid(True, color="0.9", lw=0.5)
    figure.legend(*panel.get_legend_handles_labels(), loc="upper center", ncols=2, fontsize=9)
    return figure


_FEWEST = 8  # frequencies of a loop that is shown
_SIGMAS = 1.96
_ALONE = "Estimated from the record alone, without plant or controller. It holds if "
_ASSUMED: dict[Entry, str] = {
    "set-point": f"{_ALONE}the controller sees the reference only as its difference from the "
    "output.",
    "plant input": f"{_ALONE}the reference is added to the command, and nothing else answers it.",
}
_BY_LAW = (
    "The law of the log's parameters, with the integral as set, times the measured response from "
    "command to rate."
)


class LawLoop(NamedTuple):
    """The flown loop where the law is known."""

    measured: BrokenLoop  # law times measured response of the plant
    model: BrokenLoop | None  # law times the identified one
    step: StepBand | None  # from set-point to rate, of plants that the fit leaves possible
    unmodelled: Sequence[str] = ()


def loop_section(
    frf: FrequencyResponse, record: Record, law: LawLoop | None = None
) -> Section | None:
    """Bode diagram, crossover and margins, by the law where it is known; without it None where the
    units do not tell where the reference enters."""
    if law is not None and law.measured.omega.size >= _FEWEST:
        loop, model, missing = law.measured, law.model, "; ".join(law.unmodelled)
        note = f"{_BY_LAW} Not in the law: {missing}." if missing else _BY_LAW
        origin = "the law times the plant's response"
    else:
        entry = entry_of(record, frf)
        if entry is None:
            return None
        loop = spectra.estimate_broken_loop(
            record, entry=entry, output=frf.output_names[0], input=frf.input_names[0]
        )
        if loop.omega.size < _FEWEST:
            return None
        model, note = None, _ASSUMED[entry]
        origin = f"from {record.reference_names[0]} as {entry}"
    # Margins that are not seen are those of the model, where there is one.
    shown, crossover, by = loop, loop.crossover, ""
    if model is not None and np.isnan(crossover):
        shown, crossover, by = model, model.crossover, " by the identified model"
    if np.isnan(crossover):
        low, high = shown.omega[[0, -1]] / (2 * np.pi)
        where = f"|L| does not fall through 1 from {low:.3g} to {high:.3g} Hz"
        facts = {"crossover": f"not seen: {where}, where the loop can be estimated"}
    else:
        (margin, error), (gain, place), beyond = shown.phase_margin, shown.gain_margin, ""
        if model is not None and not np.isfinite(gain):
            (gain, place), beyond = model.gain_margin, " by the identified model"
        sure = f" \u00b1 {np.degrees(_SIGMAS * error):.2g} deg (95 %)" if error else " deg"
        lowest = "not seen: the phase does not pass -180 deg where the loop can be estimated"
        if np.isfinite(gain):
            lowest = f"{20 * np.log10(gain):.3g} dB at {place / (2 * np.pi):.3g} Hz "
            lowest += f"({place:.3g} rad/s){beyond}; 6 dB or more is usual"
        facts = {
            "crossover": f"{crossover / (2 * np.pi):.3g} Hz ({crossover:.3g} rad/s){by}",
            "phase margin": f"{np.degrees(margin):.3g}{sure}; 45 deg or more is usual",
            "gain margin": lowest,
        }
    image = embed_figure(
        lambda: _draw_loop(loop, model),
        alt=f"Bode diagram of the broken loop with its 95 % band; crossover {facts['crossover']}.",
        caption=f"Broken loop L, {origin}; grey holds 95 %.",
    )
    return {"image": image, "facts": facts, "note": note}


def entry_of(record: Record, frf: FrequencyResponse) -> Entry | None:
    """Where the reference enters, by its unit: that of the output, or that of the input."""
    if not record.reference_names:
        return None
    unit = record.unit(record.reference_names[0])
    output, source = record.unit(frf.output_names[0]), record.unit(frf.input_names[0])
    if output == source:
        return None
    entries: dict[str, Entry] = {output: "set-point", source: "plant input"}
    return entries.get(unit)


def _draw_loop(loop: BrokenLoop, model: BrokenLoop | None) -> Figure:
    figure = Figure(figsize=(5.0, 4.2))
    level = figure.add_axes((0.14, 0.52, 0.82, 0.36), label="level")
    phase = figure.add_axes((0.14, 0.11, 0.82, 0.36), sharex=level, label="phase")
    level.tick_params(labelbottom=False)
    turn = _turn(loop)
    decibels, reach = 20 * np.log10(np.abs(loop.response)), _SIGMAS * loop.error
    drawn = ((level, decibels, 20 / np.log(10) * reach), (phase, turn, np.degrees(reach)))
    for panel, values, band in drawn:
        panel.fill_between(loop.omega, values - band, values + band, color="0.8", lw=0)
        panel.plot(loop.omega, values, "o-", ms=3, lw=1, color="0.15", label="L")
        margin = 0.06 * np.ptp(values) + 3
        panel.set_ylim(values.min() - margin, values.max() + margin)
        panel.grid(True, color="0.9", lw=0.5)
        if model is not None:
            inside = (model.omega >= loop.omega[0] / 1.5) & (model.omega <= 1.5 * loop.omega[-1])
            line = _turn(model) if panel is phase else 20 * np.log10(np.abs(model.response))
            panel.plot(model.omega[inside], line[inside], color="tab:blue", lw=1, label="model")
        if np.isfinite(loop.crossover):
            panel.axvline(loop.crossover, color="tab:blue", lw=1, ls="--")
    level.axhline(0, color="0.3", lw=0.8)
    phase.axhline(-180, color="0.3", lw=0.8)
    level.set(ylabel="|L|, dB", xscale="log")
    phase.set(ylabel="phase of L, deg", xlabel="frequency, rad/s")
    plain_ticks(phase.xaxis)
    add_hertz(level)
    return figure


def _turn(loop: BrokenLoop) -> np.ndarray:
    """The phase in deg, which passes -180 at the crossover without a margin."""
    turn = np.degrees(np.unwrap(np.angle(-loop.response)))
    at = np.interp(np.log(loop.crossover), np.log(loop.omega), turn)
    return turn - 180 - (0 if np.isnan(at) else 360 * np.round(at / 360))
