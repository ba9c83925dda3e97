"""A fit as one page; what a reader has to know first comes first."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import jaxquad.plot as plot
from jaxquad._core import write_file
from jaxquad.identify import (
    AGREES,
    Combination,
    CONTRADICTS,
    Fit,
    GOOD_TIC,
    KnownFilter,
    MISFIT,
    Verification,
)
from jaxquad.models import Model
from jaxquad.plot import COHERENT, short_names, unit_label
from jaxquad.records import clock_start, Record, show_times
from jaxquad.spectra import find_line, FrequencyResponse

from ._answers import answer_section
from ._loop import LawLoop, loop_section, step_section
from ._numbers import identifiability_section, parameter_section, tuned_section, verdict_headlines
from ._page import Cell, embed_figure, Headline, Image, render_page, Section, Table
from ._results import attempt, Provenance, provenance_section


if TYPE_CHECKING:
    from jaxquad.simulation import Simulation
    from jaxquad.tuning import Certificate, Tuned


_ORDER = (
    "answers", "step", "loop", "tuned", "response", "parameters", "identifiability",
    "verification", "spectrum", "record", "provenance",
)  # fmt: skip


def write_report(
    path: str | Path, *, fit: Fit, frf: FrequencyResponse | Mapping[str, FrequencyResponse],
    models: Mapping[str, Model] | None = None,
    others: Mapping[str, FrequencyResponse] | None = None,
    record: Record | Mapping[str, Record] | None = None, spectrum: Record | None = None,
    filters: Sequence[KnownFilter] = (), law: LawLoop | None = None,
    checks: Verification | Mapping[str, Verification] | None = None,
    derived: Sequence[Combination] = (), texts: Mapping[str, str] | None = None,
    tuned: "Tuned | Certificate | None" = None, flights: "Mapping[str, Simulation] | None" = None,
    provenance: Provenance | None = None, title: str = "", formula: str = "",
) -> Path:  # fmt: skip
    """Write one self-contained HTML page on a fit, whole or not at all.

    The verdict and all remarks come first, then what the log can answer and what to fly next,
    results, and records at the end. Figures are inside the page; under a pointer they show the
    numbers of their curves, and they can be enlarged. The script that does this is part of the
    page, and the page's policy lets no other run. Nothing is fetched from elsewhere, and every text
    from a log is escaped. A section or a figure that cannot be computed says why; the rest is
    written.

    **Arguments:**

    - `path`: of the page.
    - `fit`: the fit; one that is not identifiable has a page, too.
    - `frf`: the response that was fitted, or several that one fit explains, by name.
    - `models`: with several responses, the models under a known change (`conditions=` of `jq.fit`)
      by the same names; by default the fit's own.
    - `others`: further estimates of the same response, by name.
    - `record`, `checks`: the records, and the model simulated on records; one, or several by name.
    - `spectrum`: the record whose spectrum is shown, such as one with the throttle beside its
        channels; by default the first record.
    - `filters`: of the outputs, up to whose inputs response and model are.
    - `law`: the flown loop where its law is known, which is shown instead of an estimate.
    - `derived`: rows below the parameters, see `Fit.derived`.
    - `texts`: what stands below them by title, such as `Fit.bands` and `Fit.explain` in print.
    - `tuned`: gains with their certificate, or a certificate alone.
    - `flights`: of these gains, by name, see `jaxquad.tuning.worst_flights`.
    - `provenance`: where the result comes from, see `jaxquad.report.provenance`.
    - `title`: by default "output / input" of the first response.
    - `formula`: the model in words.

    **Returns:** the path.

    **Raises:** ValueError for no response, and for `models` whose names no response has.
    """
    frfs = {"response": frf} if isinstance(frf, FrequencyResponse) else dict(frf)
    if not frfs:
        raise ValueError("frf is empty: give the response that was fitted, or several by name")
    records = {"record": record} if isinstance(record, Record) else dict(record or {})
    verified = {"verification": checks} if isinstance(checks, Verification) else dict(checks or {})
    drawn: dict[str, Model] = dict(models or {})
    unknown = [name for name in drawn if name not in frfs]
    if unknown:
        raise ValueError(f"models of no response: {unknown}; the responses are {list(frfs)}")
    if fit.verdict.fitted:
        drawn = {name: fit.model for name in frfs} | drawn
    first = next(iter(frfs.values()))  # of the responses that were fitted
    names = (first.output_names[0], first.input_names[0])
    channels = {*first.input_names, *first.output_names}
    flown = next((one for one in records.values() if channels <= {*one.names}), None)
    first_record = next(iter(records.values()), None)
    sections: dict[str, object] = {
        "answers": attempt(answer_section, fit, first, first_record, verified),
        "identifiability": attempt(identifiability_section, fit),
    }
    if fit.verdict.fitted:
        sections["parameters"] = attempt(parameter_section, fit, derived, texts or {})
    if provenance is not None:
        sections["provenance"] = attempt(provenance_section, provenance)
    diverging = [name for name, check in verified.items() if not np.isfinite(check.tic)]
    remarks: list[str] = [*fit.remarks]
    remarks += [f"{x}: the simulation diverges, so it verifies nothing" for x in diverging]
    remarks = list(dict.fromkeys(remarks))
    headlines = [fit_headline(fit, len(remarks))]
    headlines += [check_headline(name, check, fit) for name, check in verified.items()]
    if tuned is not None:
        headlines += verdict_headlines(tuned)
        sections["tuned"] = attempt(tuned_section, tuned, flights or {})
    sections["response"] = attempt(response_section, frfs, drawn, others or {})
    if flown is not None:
        computed = None if law is None else law.step
        sections["step"] = attempt(step_section, fit, first, flown, tuple(filters), computed)
        sections["loop"] = attempt(loop_section, first, flown, law)
    if (shown := flown if spectrum is None else spectrum) is not None:
        sections["spectrum"] = attempt(spectrum_section, first, shown)
    if records:
        sections["record"] = attempt(record_section, records)
    if verified:
        sections["verification"] = attempt(check_section, verified)
    text = render_page(
        "report.html", title=f"{headlines[0].word}: {title or ' / '.join(names)}",
        title_text=title, names=names, headlines=headlines, remarks=remarks, formula=formula,
        sections={name: sections[name] for name in _ORDER if sections.get(name) is not None},
    )  # fmt: skip
    return write_file(path, text)


def fit_headline(fit: Fit, remarks: int) -> Headline:
    """Of the fit alone; `remarks` is their number."""
    if fit.verdict.kind in ("no minimum", "no model"):
        return Headline("bad", fit.verdict.kind.upper(), fit.verdict.summary)
    if not fit.identifiable:
        return Headline("bad", "NOT IDENTIFIABLE", fit.verdict.summary)
    numbers = []
    units = fit.parameter_units or ("",) * len(fit.names)
    for name, value, unit in zip(fit.names, fit.values, units, strict=True):
        low, high = fit.interval(name)
        number = f"{value:.4g} \u00b1 {(high - low) / 2:.2g}"
        if low == 0 or high == 0:  # it keeps its sign: no symmetrical interval
            number = f"{low:.2g} .. {high:.2g}"
        numbers.append(f"{name} = {number} {unit}".rstrip())
    more = f" and {len(numbers) - 6} more" if len(numbers) > 6 else ""
    reason = f"{', '.join(numbers[:6])}{more} (95 % intervals)"
    if fit.chi_squared > MISFIT**2:
        ratio = np.sqrt(fit.chi_squared)
        word = f"IDENTIFIED, but the misfit is {ratio:.1f} times the random error"
        return Headline("warn", word, reason)
    if remarks:
        word = f"IDENTIFIED, with {remarks} remark{'s' * (remarks > 1)}"
        return Headline("warn", word, reason)
    return Headline("good", "IDENTIFIED", reason)


def check_headline(name: str, check: Verification, fit: Fit) -> Headline:
    """Of the model simulated on a record."""
    numbers = f"{name}: fit {check.fit_percent:.1f} %, TIC {check.tic:.3f}"
    if check.prediction is not None:  # one of which any smooth record has a low TIC
        kinds = {AGREES: ("good", "VERIFIED"), CONTRADICTS: ("bad", "VERIFICATION FAILS")}
        level, word = kinds.get(check.verdict.kind, ("warn", "WEAKLY VERIFIED"))
        return Headline(level, word, f"{name}: {check.method}: {check.verdict}")
    if check.tic < GOOD_TIC and not fit.identifiable:
        lost = ", ".join(fit.verdict.undetermined)
        reason = f"{numbers}: right in what it does, but its record does not determine {lost}"
        return Headline("warn", "VERIFIED AS A WHOLE", reason)
    if check.tic < GOOD_TIC:
        return Headline("good", "VERIFIED", f"{numbers} (good: below {GOOD_TIC})")
    return Headline("bad", "VERIFICATION FAILS", f"{numbers} (good: below {GOOD_TIC})")


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
            alt=f"Measured and {check.method}: {check.output_name} over time, {name}: fit "
            f"{check.fit_percent:.1f} %, TIC {check.tic:.3f}.",
        )
        measures = Table(f"Agreement, {check.method}, {within}", heads, rows, texts=2)
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
    line, above = find_line(record, output, above=top, over=throttle), top / (2 * np.pi)
    if line is None:
        text = f"No narrow line stands out of the spectrum of {output} above the identified band, "
        return {"images": images, "text": f"{text}{above:.3g} Hz."}
    hertz = [x / (2 * np.pi) for x in (line.omega, line.low, line.high)]
    text = (
        f"The strongest line of {output} above the identified band, {above:.3g} Hz, is at "
        f"{hertz[0]:.3g} Hz ({line.omega:.3g} rad/s; 90 % of the time {hertz[1]:.3g} to "
        f"{hertz[2]:.3g} Hz): {line.height:.0f} dB above its surroundings, in "
        f"{100 * line.share:.0f} % of the windows."
    )
    if line.harmonics:
        multiples = " and ".join(f"{m} times" for m in line.harmonics)
        text += f" It has harmonics at {multiples} its frequency, as motors and propellers make."
    ranked = f"(rank correlation {line.follows:.2f})"
    if throttle is None:
        text += " Record the throttle as well to tell a motor from a resonance of the frame."
    elif line.follows > _FOLLOWS:
        text += f" It rises with {throttle} {ranked}: motors."
    elif abs(line.follows) < _STAYS:
        text += f" It does not follow {throttle} {ranked}: a resonance of the frame or of the "
        text += "loop, or an electrical line."
    else:
        text += f" Its rank correlation with {throttle} is {line.follows:.2f}."
    return {"images": images, "text": text}


def throttle_of(record: Record) -> str | None:
    """The channel whose name is that of a throttle, if there is one that moves."""
    named = [name for name in record.names if _THROTTLE.search(name)]
    return next((name for name in named if np.ptp(record.channel(name)) > 0), None)
