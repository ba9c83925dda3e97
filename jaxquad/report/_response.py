"""The frequency domain: measured responses, the model on them, and what it leaves."""

from collections.abc import Mapping
from dataclasses import replace
from itertools import product

import numpy as np
from jaxtyping import Float

from jaxquad.models import Model
from jaxquad.plot import bode, COHERENT, resid, Residuals, residuals_of, short_names
from jaxquad.spectra import FrequencyResponse

from ._figure import embed_figure, Image


_PAIRS = 6  # responses that are drawn, of all estimates together


def response_section(
    frfs: Mapping[str, FrequencyResponse],
    models: Mapping[str, Model],
    others: Mapping[str, FrequencyResponse],
) -> list[dict[str, object]]:
    """A Bode diagram of every response, beside its residuals; `models` by the names of `frfs`."""
    share = max(1, _PAIRS // len(frfs))
    return [
        {
            "name": name if len(frfs) > 1 else "",
            "images": _images(frf, models.get(name), others, share),
            "left_out": left_out(frf, share),
        }
        for name, frf in frfs.items()
    ]


def _images(
    frf: FrequencyResponse,
    model: Model | None,
    others: Mapping[str, FrequencyResponse],
    most: int,
) -> list[Image]:
    images = []
    for pair in pairs(frf, most):
        images.append(_bode(frf, model, others, *pair))
        images += [] if model is None else [_residuals(frf, model, *pair)]
    return images


def pairs(frf: FrequencyResponse, most: int) -> list[tuple[int, int]]:
    """Outputs and inputs of the responses that are drawn."""
    return list(product(range(len(frf.output_names)), range(len(frf.input_names))))[:most]


def left_out(frf: FrequencyResponse, most: int) -> str:
    """How many responses are not drawn, in words."""
    rest = len(frf.output_names) * len(frf.input_names) - most
    return f"{rest} more responses are not drawn." if rest > 0 else ""


def _bode(
    frf: FrequencyResponse,
    model: Model | None,
    others: Mapping[str, FrequencyResponse],
    output: int,
    source: int,
) -> Image:
    short = _short(frf)
    pair = (short.output_names[output], short.input_names[source])
    beside = {
        name: _short(other)
        for name, other in zip(short_names(list(others)), others.values(), strict=True)
        if other.output_names == frf.output_names and other.input_names == frf.input_names
    }
    coherence = _coherence(frf, output, source)
    return embed_figure(
        lambda: bode(short, beside, {"identified": model} if model else {}, pair=pair),
        alt=f"Bode diagram of {_name(frf, output, source)}: magnitude, phase and coherence with "
        f"their 95 % band{' and the identified model' if model is not None else ''}. {coherence}",
        ratio=(frf.output_names[output], frf.input_names[source]),
        caption=f", {frf.method} estimate. {coherence}",
    )


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


def _residuals(frf: FrequencyResponse, model: Model, output: int, source: int) -> Image:
    found = residuals_of(frf, model, output, source)
    summary = _summary(found)
    return embed_figure(
        lambda: resid(found),
        alt=f"Residuals of {_name(frf, output, source)} over frequency, in units of the random "
        f"error. {summary}",
        ratio=(frf.output_names[output], frf.input_names[source]),
        caption=f": {summary}",
    )


def _summary(found: Residuals) -> str:
    count = int(found.coherent.sum())
    if not count:
        return f"no frequency has a coherence of {COHERENT} or more."
    return (
        f"{100 * found.outside:.0f} % of the points lie outside the band (5 % are expected); rms "
        f"{found.rms:.2f} random errors, {_rms(found.decibels[found.coherent]):.2g} dB and "
        f"{_rms(found.degrees[found.coherent]):.2g} deg, at {count} frequencies with a coherence "
        f"of {COHERENT} or more."
    )


def _rms(values: Float[np.ndarray, " points"]) -> float:
    return float(np.sqrt(np.mean(values**2)))
