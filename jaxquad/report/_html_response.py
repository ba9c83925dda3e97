"""Measured responses, the model on them, and what it leaves."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from jaxquad.plot import bode, COHERENT, residual_figure, Residuals, residuals_of, short_names
from jaxquad.spectra import FrequencyResponse

from ._html_figure import figure
from ._html_text import element, given, Html, joined, section


_PAIRS = 6  # responses that are drawn, of all estimates together


def response_section(
    frfs: Mapping[str, FrequencyResponse],
    models: Mapping[str, Any],
    others: Mapping[str, FrequencyResponse],
) -> Html:
    """A Bode diagram of every response; `models` by the names of the `frfs`."""
    parts, share = [], max(1, _PAIRS // len(frfs))
    for name, frf in frfs.items():
        parts += [element("h3", given(name))] if len(frfs) > 1 else []
        parts += [_bode(frf, models.get(name), others, *pair) for pair in _pairs(frf, share)]
        parts += [_left_out(frf, share)]
    return section("response", "Frequency response", *parts)


def residual_section(frfs: Mapping[str, FrequencyResponse], models: Mapping[str, Any]) -> Html:
    note = (
        "Measured minus modelled magnitude (dB) and phase (deg), each over its random error. The "
        "band holds 95 % of them if the model is right; a trend is structure that it lacks."
    )
    parts, share = [], max(1, _PAIRS // len(frfs))
    for name, frf in frfs.items():
        parts += [element("h3", given(name))] if len(frfs) > 1 else []
        parts += [_residuals(frf, models[name], *pair) for pair in _pairs(frf, share)]
    return section("residuals", "Residuals", element("p", note), *parts)


def _pairs(frf: FrequencyResponse, most: int) -> list[tuple[int, int]]:
    return list(product(range(len(frf.output_names)), range(len(frf.input_names))))[:most]


def _left_out(frf: FrequencyResponse, most: int) -> Html:
    rest = len(frf.output_names) * len(frf.input_names) - most
    return element("p", f"{rest} more responses are not drawn.") if rest > 0 else Html("")


def _bode(
    frf: FrequencyResponse,
    model: Any,
    others: Mapping[str, FrequencyResponse],
    output: int,
    source: int,
) -> Html:
    short = _short(frf)
    pair = (short.output_names[output], short.input_names[source])
    beside = {
        name: _short(other)
        for name, other in zip(short_names(list(others)), others.values(), strict=True)
        if other.output_names == frf.output_names and other.input_names == frf.input_names
    }
    fitted = None if model is None else {"identified": model}
    return figure(
        lambda: bode(short, fitted, others=beside, pair=pair),
        alt=f"Bode diagram of {_name(frf, output, source)}: magnitude, phase and coherence with "
        f"their 95 % band{' and the identified model' if model is not None else ''}. "
        f"{_coherence(frf, output, source)}",
        caption=joined(
            given(frf.output_names[output]), " / ", given(frf.input_names[source]),
            f", {frf.method} estimate. {_coherence(frf, output, source)}",
        ),
    )  # fmt: skip


def _short(frf: FrequencyResponse) -> FrequencyResponse:
    return replace(
        frf, input_names=short_names(frf.input_names), output_names=short_names(frf.output_names)
    )


def _name(frf: FrequencyResponse, output: int, source: int) -> str:
    return f"{frf.output_names[output]} / {frf.input_names[source]}"


def _coherence(frf: FrequencyResponse, output: int, source: int) -> str:
    omega = np.asarray(frf.omega)
    good = omega[np.asarray(frf.coherence)[:, output, source] >= COHERENT]
    if not good.size:
        return f"The coherence is below {COHERENT} at all {omega.size} frequencies."
    return (
        f"The coherence is {COHERENT} or more at {good.size} of {omega.size} frequencies, "
        f"within {good[0]:.3g} .. {good[-1]:.3g} rad/s."
    )


def _residuals(frf: FrequencyResponse, model: Any, output: int, source: int) -> Html:
    found, name = residuals_of(frf, model, output, source), _name(frf, output, source)
    told = _told(found)
    caption = joined(given(frf.output_names[output]), " / ", given(frf.input_names[source]))
    return figure(
        lambda: residual_figure(found),
        alt=f"Residuals of {name} over frequency, in units of the random error. {told}",
        caption=joined(caption, f": {told}"),
    )


def _told(found: Residuals) -> str:
    count = int(found.coherent.sum())
    if not count:
        return "no frequency is coherent enough to judge."
    return (
        f"{100 * found.outside:.0f} % of the coherent points lie outside the band (5 % are "
        f"expected), rms {found.rms:.2f} random errors, "
        f"{_rms(found.decibels[found.coherent]):.2g} dB and "
        f"{_rms(found.degrees[found.coherent]):.2g} deg, at {count} frequencies."
    )


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))
