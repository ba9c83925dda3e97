"""The step response of the flown loop, and what the model makes of the same command."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from matplotlib.figure import Figure

from jaxquad.identify import (
    as_sampled,
    behind_filters,
    Fit,
    KnownFilter,
    model_response,
    with_values,
)
from jaxquad.models import Model
from jaxquad.plot import short_names, StepBand, steps_figure, unit_label
from jaxquad.records import Record
from jaxquad.spectra import estimate_step, FrequencyResponse, StepResponse

from ._figure import embed_figure, Image, Section
from ._page import Table


Samples = Float[np.ndarray, " samples"]
_DASH = "\u2013"
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
    fit: Fit,
    frf: FrequencyResponse,
    record: Record,
    filters: Sequence[KnownFilter] = (),
    computed: StepBand | None = None,
) -> Section | None:
    """Measured and predicted step response; None without a reference or room for one.

    The model is up to the input of the `filters`. What is `computed` from law and model is shown
    where the log does not show a step.
    """
    if not record.reference_names:
        return None
    try:
        found = estimate_step(record, output=frf.output_names[0])
    except ValueError:
        return None
    head: Section = {"names": found.names, "doubts": found.doubts}
    if not found.is_conclusive:
        image = None if computed is None else _computed(computed)
        return head | {"image": None, "table": None, "notes": [], "computed": image}
    predicted = (
        predict_step(fit, frf, behind_filters(record, filters)) if fit.verdict.fitted else None
    )
    return head | {
        "image": _image(record, found, predicted),
        "table": _table(found, predicted),
        "notes": _notes(found, predicted),
    }


def predict_step(fit: Fit, frf: FrequencyResponse, record: Record) -> Prediction | None:
    """What the model makes of the flown inputs, through the filter of the measured step.

    No controller has to be known. None for an unstable model, whose output says nothing.
    """
    mean = _stepped(fit.model, frf, record)
    if mean is None or not np.all(np.isfinite(fit.covariance)) or not np.all(fit.standard_errors):
        return None if mean is None else Prediction(mean[0], None)
    places, slopes = fit.parameters.places[: len(fit.names)], []
    for k, error in enumerate(fit.standard_errors):
        values = np.array(fit.values, float)
        values[k] += _SMALL * error
        moved = _stepped(with_values(fit.model, places, values), frf, record)
        if moved is None:
            return Prediction(mean[0], None)
        slopes.append((moved[0] - mean[0]) / (_SMALL * error))
    spread = np.einsum("pt,pq,qt->t", np.array(slopes), fit.covariance, np.array(slopes))
    return Prediction(mean[0], np.sqrt(np.maximum(spread, 0.0) + mean[1] ** 2))


def _stepped(
    model: Model, frf: FrequencyResponse, record: Record
) -> tuple[Samples, Samples] | None:
    """The simulated step with its error by the scatter between windows."""
    inputs = np.stack([record.channel(name) for name in frf.input_names], axis=1)
    driven, integrators = _driven(as_sampled(model, frf), inputs - inputs.mean(0), record.dt)
    if driven is None:
        return None
    found = estimate_step(record, output=frf.output_names[0], simulated=driven, drift=integrators)
    if found.simulated is None or found.simulated_error is None:
        return None
    return found.simulated, found.simulated_error


def _driven(
    model: Model, inputs: Float[np.ndarray, "flight inputs"], dt: float
) -> tuple[Float[np.ndarray, " flight"] | None, int]:
    """The first output of a model at rest, None if it is unstable; and its integrators.

    As many integrators as the response has at low frequencies are taken out of the spectrum, where
    they are infinite, and are done in time.
    """
    count = len(inputs)
    size = 2 ** int(np.ceil(np.log2(_ROOM * count)))  # quick to transform
    omega = 2 * np.pi * np.fft.rfftfreq(size, dt)
    omega[0], omega[-1] = 1e-3 * omega[1], 0.999 * omega[-1]
    grid = np.geomspace(omega[0], omega[-1], _GRID)
    response = model_response(model, grid)[:, 0]
    slope = np.diff(np.log(np.max(np.abs(response[:2]), axis=1)))[0] / np.log(grid[1] / grid[0])
    integrators = int(np.clip(np.round(-slope), 0, 2))
    finite = _interpolated(omega, grid, response * (1j * grid[:, None]) ** integrators)
    impulse = np.fft.irfft(finite, size, axis=0)
    if np.sum(impulse[size // 2 :] ** 2) > _BEFORE * np.sum(impulse**2):
        return None, integrators
    output = np.fft.irfft(np.sum(np.fft.rfft(inputs, size, axis=0) * finite, axis=1), size)[:count]
    for _ in range(integrators):
        output = dt * np.concatenate([[0.0], np.cumsum((output[1:] + output[:-1]) / 2)])
    return output, integrators


def _interpolated(
    omega: Samples, grid: Float[np.ndarray, " grid"], response: Complex[np.ndarray, "grid inputs"]
) -> Complex[np.ndarray, "samples inputs"]:
    """Logarithm and phase straight between frequencies, as a delay's are."""
    columns = []
    for each in response.T:
        size = np.interp(omega, grid, np.log(np.maximum(np.abs(each), 1e-300)))
        columns.append(np.exp(size + 1j * np.interp(omega, grid, np.unwrap(np.angle(each)))))
    return np.stack(columns, axis=1)


def _computed(band: StepBand) -> Image:
    over = 100 * max(float(np.max(band.middle)) - 1, 0.0)
    return embed_figure(
        lambda: steps_figure({"law and model": band}),
        alt=f"Rate after a step of 1 of the set-point by law and model: overshoot {over:.0f} %.",
        caption="The logged rate after a step of 1 of the set-point, computed from the law of the "
        "log's parameters, with the integral as set, and the identified model: overshoot "
        f"{over:.0f} %; median and 95 % of the plants that the log leaves possible.",
    )


def _image(record: Record, found: StepResponse, predicted: Prediction | None) -> Image:
    reference, output = found.names
    return embed_figure(
        lambda: _figure(record, found, predicted),
        alt=f"{output} after a step of 1 in {reference}: each window in grey, their mean with its "
        f"95 % band{', and the prediction of the model' if predicted else ''}. {found}",
        caption=f"{output} after a step of 1 in {reference}, deconvolved from "
        f"{len(found.windows)} windows (grey) of the log.",
    )


def _figure(record: Record, found: StepResponse, predicted: Prediction | None) -> Figure:
    figure = Figure(figsize=(5.0, 3.4))
    panel = figure.add_axes((0.14, 0.14, 0.82, 0.72))
    scale, unit = _unit(record, found.names)
    every = slice(None, None, -(-found.time.size // _POINTS))
    time = found.time[every]
    for window in found.windows[:_GREY]:
        panel.plot(time, scale * window[every], color="0.82", lw=0.6, label="_nolegend_")
    error = scale * found.standard_error[every]
    _curve(panel, time, scale * found.mean[every], error, ("measured", "0.15", "-"))
    if predicted is not None:
        error = None if predicted.error is None else scale * predicted.error[every]
        _curve(panel, time, scale * predicted.mean[every], error, ("model", "tab:blue", "--"))
    level = scale * found.final
    panel.axhline(level, color="0.5", lw=0.7, ls=":", label="_nolegend_")
    low, high = np.min(scale * found.mean), np.max(scale * found.mean)
    reach = high - low
    panel.set(xlabel="time after the step, s", xlim=(found.time[0] / 2, found.time[-1]),
              ylim=(low - 0.35 * reach, high + 0.35 * reach))  # fmt: skip
    names = short_names(found.names)
    panel.set_ylabel(f"{names[1]} per {names[0]}{unit}")
    panel.grid(True, color="0.9", lw=0.5)
    figure.legend(*panel.get_legend_handles_labels(), loc="upper center", ncols=2, fontsize=9)
    return figure


def _unit(record: Record, names: Sequence[str]) -> tuple[float, str]:
    """Factor and unit of the output per that of the reference."""
    (one, below), (other, above) = (unit_label(record.unit(name)[:12]) for name in names)
    below, above = below.removeprefix(", "), above.removeprefix(", ")
    if above == below:
        return other / one, ""
    return other / one, f", {above or '1'} / {below or '1'}"


def _curve(panel, time: Samples, mean: Samples, error: Samples | None, style: tuple[str, str, str]):
    name, colour, dash = style
    panel.plot(time, mean, color=colour, ls=dash, lw=1.6, label=name)
    if error is not None:
        low, high = mean - 1.96 * error, mean + 1.96 * error
        panel.fill_between(time, low, high, color=colour, alpha=0.2, lw=0, label=f"{name}, 95 %")


def _table(found: StepResponse, predicted: Prediction | None) -> Table:
    rows = [
        ["rise time (10 to 90 %), ms", _millis(found.rise_time)],
        ["overshoot, %", f"{100 * found.overshoot:.2g}"],
        ["settling time (5 %), ms", _millis(found.settling_time)],
        ["final value", _plus_minus(found.final, found.standard_error)],
    ]
    if predicted is None:
        return Table("Step response (95 % intervals)", ("", "measured"), rows)
    model = found._replace(mean=predicted.mean)
    over = max(
        0.0, float(np.max(model.mean)) / found.final - 1
    )  # the measured value is the sharper
    mine = [_millis(model.rise_time), f"{100 * over:.2g}", _DASH]
    mine.append(_plus_minus(model.final, predicted.error))
    both = [[*row, text] for row, text in zip(rows, mine, strict=True)]
    return Table("Step response (95 % intervals)", ("", "measured", "model"), both)


def _millis(seconds: float) -> str:
    return f"{1e3 * seconds:.3g}" if np.isfinite(seconds) else "not in the window"


def _plus_minus(value: float, error: Samples | None) -> str:
    return f"{value:.3g}" if error is None else f"{value:.3g} \u00b1 {1.96 * error[-1]:.1g}"


def _notes(found: StepResponse, predicted: Prediction | None) -> list[str]:
    error = 100 * float(found.standard_error[-1]) / abs(found.final)
    notes = [
        f"The data suffice: the reference moves in {len(found.windows)} of {found.total} windows, "
        f"and the standard error of the final value is {error:.2g} %."
    ]
    if not found.is_resolved:
        notes.append(
            f"The rise is blurred: a perfect step would rise in {1e3 * found.blur:.3g} ms here. "
            "The true rise is faster than the one that is shown, and its overshoot larger."
        )
    if predicted is not None:
        notes.append(
            "The model is driven by the flown inputs, so that no controller has to be known; in "
            "each window it may drift from the output. Its band counts its parameters, and gusts."
        )
    return notes
