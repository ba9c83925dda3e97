"""What was measured: responses and what the model leaves of them, records, checks and spectra."""

import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np

import jaxquad.plot as plot
from jaxquad.identify import Verification
from jaxquad.models import Model
from jaxquad.plot import COHERENT, short_names, unit_label
from jaxquad.records import clock_start, Record, show_times
from jaxquad.spectra import find_line, FrequencyResponse

from ._page import Cell, embed_figure, Image, Section, Table


GOOD_TIC = 0.25  # Theil inequality coefficient, below which agreement is good
_DASH = "\u2013"
_PAIRS = 6  # responses that are drawn, of all estimates together
_SHORTEST = 5.0  # s, of a record whose spectrum over time says something
_THROTTLE = re.compile(
    r"throttle|\bthr\b|thro\b|rccommand\[?3|collective|\bthrust\b", re.IGNORECASE
)
_FOLLOWS, _STAYS = 0.7, 0.3  # rank correlation


def response_section(
    frfs: Mapping[str, FrequencyResponse],
    models: Mapping[str, Model],
    others: Mapping[str, FrequencyResponse],
) -> list[dict[str, object]]:
    """A Bode diagram of every response, beside its residuals; `models` by the names of `frfs`."""
    share, sections = max(1, _PAIRS // len(frfs)), []
    for name, frf in frfs.items():
        pairs = list(product(range(len(frf.output_names)), range(len(frf.input_names))))
        model, images = models.get(name), []
        for pair in pairs[:share]:
            images.append(_bode(frf, model, others, *pair))
            images += [] if model is None else [_residuals(frf, model, *pair)]
        rest, name = len(pairs) - share, name if len(frfs) > 1 else ""
        left_out = f"{rest} more responses are not drawn." if rest > 0 else ""
        sections.append({"name": name, "images": images, "left_out": left_out})
    return sections


def _bode(
    frf: FrequencyResponse, model: Model | None, others: Mapping[str, FrequencyResponse],
    output: int, source: int,
) -> Image:  # fmt: skip
    shorten = lambda x: replace(
        x, input_names=short_names(x.input_names), output_names=short_names(x.output_names)
    )
    short = shorten(frf)
    same_channels = {
        name: shorten(other)
        for name, other in zip(short_names(list(others)), others.values(), strict=True)
        if other.output_names == frf.output_names and other.input_names == frf.input_names
    }
    names, omega = (frf.output_names[output], frf.input_names[source]), np.asarray(frf.omega)
    good = omega[np.asarray(frf.coherence)[:, output, source] >= COHERENT]
    coherence = f"The coherence is below {COHERENT} at all {omega.size} frequencies."
    if good.size:
        coherence = (
            f"The coherence is {COHERENT} or more at {good.size} of {omega.size} frequencies, "
            f"within {good[0]:.3g} .. {good[-1]:.3g} rad/s."
        )
    pair = (short.output_names[output], short.input_names[source])
    return embed_figure(
        lambda: plot.bode(short, same_channels, {"identified": model} if model else {}, pair=pair),
        alt=f"Bode diagram of {' / '.join(names)}: magnitude, phase and coherence with "
        f"their 95 % band{' and the identified model' if model is not None else ''}. {coherence}",
        ratio=names,
        caption=f", {frf.method} estimate. {coherence}",
    )


def _residuals(frf: FrequencyResponse, model: Model, output: int, source: int) -> Image:
    residuals = plot.residuals_of(frf, model, output, source)
    names, count = (frf.output_names[output], frf.input_names[source]), residuals.coherent.sum()
    summary = f"no frequency has a coherence of {COHERENT} or more."
    if count:
        rms = lambda values: float(np.sqrt(np.mean(values[residuals.coherent] ** 2)))
        summary = (
            f"{100 * residuals.outside:.0f} % of the points lie outside the band (5 % are "
            f"expected); rms {residuals.rms:.2f} random errors, {rms(residuals.decibels):.2g} dB "
            f"and {rms(residuals.degrees):.2g} deg, at {count} frequencies with a coherence of "
            f"{COHERENT} or more."
        )
    return embed_figure(
        lambda: plot.resid(residuals),
        alt=f"Residuals of {' / '.join(names)} over frequency, in units of the random error. "
        f"{summary}",
        ratio=names,
        caption=f": {summary}",
    )


def record_section(records: Mapping[str, Record]) -> list[dict[str, object]]:
    """Every channel over time, and its size."""
    sections = []
    for name, record in records.items():
        channels = plot.channels_of(record)
        drawn, rest = channels[: plot.ROWS], channels[plot.ROWS :]
        names = ", ".join(f"{role} {channel}" for role, channel in drawn)
        text = (
            f"{record.samples} samples, {record.duration:.6g} s at {record.sample_rate:.6g} Hz, "
            f"t = {show_times(record.time[0], record.time[-1], start=clock_start(record.time))}."
        )
        text += "" if record.reference_names else " There is no external reference."
        image = embed_figure(
            lambda record=record, drawn=drawn: plot.record_figure(record, drawn),
            alt=f"Over time, from top to bottom: {names}.",
            caption=f"{len(rest)} more channels are not drawn." if rest else "",
        )
        rows = []
        for role, channel in channels:
            scale, unit = unit_label(record.unit(channel))
            values = scale * record.channel(channel)
            numbers = (values.mean(), values.std(), values.min(), values.max())
            rows.append([Cell(channel), role, _unit(unit), *(f"{x:.4g}" for x in numbers)])
        heads = ("channel", "role", "unit", "mean", "std. deviation", "minimum", "maximum")
        section = {"name": name if len(records) > 1 else "", "source": record.source, "text": text}
        table = Table("Channels", heads, rows, texts=3)
        sections.append(section | {"image": image, "channels": table})
    return sections


def _unit(label: str) -> str | Cell:
    return Cell(label.removeprefix(", ")) if label else _DASH


def check_section(checks: Mapping[str, Verification]) -> dict[str, object]:
    """Measured and simulated outputs of each check."""
    sections = []
    for name, check in checks.items():
        band, rows = check.band, []
        for one in check.outputs:
            scale, unit = unit_label(one.unit)
            numbers = (f"{one.fit_percent:.1f}", f"{one.variance_percent:.1f}", f"{one.tic:.3f}")
            rows.append([Cell(one.name), _unit(unit), *numbers, f"{scale * one.rms:.4g}"])
        within = f"within {band[0]:.4g} .. {band[1]:.4g} rad/s" if band else "whole band"
        heads = ("output", "unit", "fit, %", "variance accounted for, %", "TIC", "rms difference")
        names = short_names([one.name for one in check.outputs])
        outputs = tuple(
            replace(one, name=short, unit=short_names([one.unit])[0] if one.unit else "")
            for one, short in zip(check.outputs, names, strict=True)
        )
        image = embed_figure(
            lambda check=check, outputs=outputs: plot.compare(replace(check, outputs=outputs)),
            alt=f"Measured and simulated {check.output_name} over time, {name}: fit "
            f"{check.fit_percent:.1f} %, TIC {check.tic:.3f}.",
        )
        measures = Table(f"Agreement, {within}", heads, rows, texts=2)
        omitted = str(check.omitted) if check.omitted else ""
        sections.append({"name": name, "image": image, "measures": measures, "omitted": omitted})
    return {"good": GOOD_TIC, "checks": sections}


def spectrum_section(frf: FrequencyResponse, record: Record) -> Section | None:
    """Spectrograms of the first output, and its strongest line; None for a short record."""
    if record.duration < _SHORTEST:
        return None
    output, throttle = frf.output_names[0], throttle_of(record)
    top = float(np.asarray(frf.omega)[-1])
    overs = ["time", *([throttle] if throttle else [])]
    images = [
        embed_figure(
            lambda over=over: plot.spectrogram(record, output, over=over),
            alt=f"Power spectral density of {output} over {over}.",
            caption=f"Spectrum of {output} over {over}.",
            is_map=True,
        )
        for over in overs
    ]
    return {"images": images, "text": _describe_line(record, output, top, throttle)}


def throttle_of(record: Record) -> str | None:
    """The channel whose name is that of a throttle, if there is one that moves."""
    named = [name for name in record.names if _THROTTLE.search(name)]
    return next((name for name in named if np.ptp(record.channel(name)) > 0), None)


def _describe_line(record: Record, output: str, top: float, throttle: str | None) -> str:
    line = find_line(record, output, above=top, over=throttle)
    above = f"above the identified band, {top / (2 * np.pi):.3g} Hz"
    if line is None:
        return f"No narrow line stands out of the spectrum of {output} {above}."
    hertz = [x / (2 * np.pi) for x in (line.omega, line.low, line.high)]
    text = (
        f"The strongest line of {output} {above}, is at {hertz[0]:.3g} Hz ({line.omega:.3g} rad/s; "
        f"90 % of the time {hertz[1]:.3g} to {hertz[2]:.3g} Hz): {line.height:.0f} dB above its "
        f"surroundings, in {100 * line.share:.0f} % of the windows."
    )
    if line.harmonics:
        multiples = " and ".join(f"{m} times" for m in line.harmonics)
        text += f" It has harmonics at {multiples} its frequency, as motors and propellers make."
    if throttle is None:
        return f"{text} Record the throttle as well to tell a motor from a resonance of the frame."
    if line.follows > _FOLLOWS:
        return f"{text} It rises with {throttle} (rank correlation {line.follows:.2f}): motors."
    if abs(line.follows) < _STAYS:
        return (
            f"{text} It does not follow {throttle} (rank correlation {line.follows:.2f}): a "
            "resonance of the frame or of the loop, or an electrical line."
        )
    return f"{text} Its rank correlation with {throttle} is {line.follows:.2f}."
