"""Where the power of the output lies: over time, and over the throttle, with lines of motors."""

import re

import numpy as np

from jaxquad.plot import spectrogram
from jaxquad.records import Record
from jaxquad.spectra import find_line, FrequencyResponse, SpectralLine

from ._figure import embed_figure, Image, Section


_SHORTEST = 5.0  # s, of a record whose spectrum over time says something
_THROTTLE = re.compile(
    r"throttle|\bthr\b|thro\b|rccommand\[?3|collective|\bthrust\b", re.IGNORECASE
)
_FOLLOWS, _STAYS = 0.7, 0.3  # rank correlation


def spectrum_section(frf: FrequencyResponse, record: Record) -> Section | None:
    """Spectrograms of the first output, and its strongest line; None for a short record."""
    if record.duration < _SHORTEST:
        return None
    output, throttle = frf.output_names[0], throttle_of(record)
    top = float(np.asarray(frf.omega)[-1])
    line = find_line(record, output, above=top, over=throttle)
    overs = ["time", *([throttle] if throttle else [])]
    return {
        "images": [_image(record, output, over) for over in overs],
        "text": _text(line, output, top, throttle),
    }


def throttle_of(record: Record) -> str | None:
    """The channel whose name is that of a throttle, if there is one that moves."""
    named = [name for name in record.names if _THROTTLE.search(name)]
    return next((name for name in named if np.ptp(record.channel(name)) > 0), None)


def _image(record: Record, output: str, over: str) -> Image:
    return embed_figure(
        lambda: spectrogram(record, output, over=over),
        alt=f"Power spectral density of {output} over {over}.",
        caption=f"Spectrum of {output} over {over}.",
        is_map=True,
    )


def _text(line: SpectralLine | None, output: str, top: float, throttle: str | None) -> str:
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
