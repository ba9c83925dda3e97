from collections.abc import Sequence

import numpy as np

from jaxquad._core import Number, require_all_positive, whole_samples

from ._excitation import Excitation, Kind


def doublet(
    *,
    width: Number,
    amplitude: Number,
    sample_rate: Number,
    lead: Number = 1.0,
    tail: Number = 3.0,
) -> Excitation:
    """Make a doublet: up for `width`, then down for `width`.

    It has no net input, and serves to verify a model.

    **Arguments:**

    - `width`: of each half, in s.
    - `amplitude`: peak value.
    - `sample_rate`: in Hz.
    - `lead`, `tail`: zeros before and after, in s.

    **Returns:** an `Excitation`.

    **Raises:**

    - `ValueError`: for times that are not whole numbers of samples.
    """
    return _pulses("doublet", [1, -1], width, amplitude, sample_rate, lead, tail)


def three_two_one_one(
    *,
    width: Number,
    amplitude: Number,
    sample_rate: Number,
    lead: Number = 1.0,
    tail: Number = 3.0,
) -> Excitation:
    """Make a 3-2-1-1: up for three times `width`, down for two, up for one, down for one.

    It excites a wider band than a doublet, and has a net input of `amplitude` times `width`.

    **Arguments:**

    - `width`: of the shortest pulse, in s.
    - `amplitude`: peak value.
    - `sample_rate`: in Hz.
    - `lead`, `tail`: zeros before and after, in s.

    **Returns:** an `Excitation`.

    **Raises:**

    - `ValueError`: for times that are not whole numbers of samples.
    """
    steps = [1, 1, 1, -1, -1, 1, -1]
    return _pulses("3-2-1-1", steps, width, amplitude, sample_rate, lead, tail)


def _pulses(
    kind: Kind,
    steps: Sequence[int],
    width: Number,
    amplitude: Number,
    sample_rate: Number,
    lead: Number,
    tail: Number,
) -> Excitation:
    require_all_positive(width=width, amplitude=amplitude, sample_rate=sample_rate)
    before = whole_samples("lead", lead, sample_rate, fewest=0)
    after = whole_samples("tail", tail, sample_rate, fewest=0)
    shape = np.repeat(
        np.asarray(steps, dtype=np.float64), whole_samples("width", width, sample_rate)
    )
    signal = amplitude * np.pad(shape, (before, after))
    # The band within 3 dB of the peak of the spectrum.
    power = np.abs(np.fft.rfft(shape, 256 * shape.size)) ** 2
    peak = int(power.argmax())
    weak = np.flatnonzero(power < 0.5 * power[peak])
    low = weak[weak < peak].max(initial=-1) + 1
    high = weak[weak > peak].min(initial=power.size) - 1
    spacing = 2 * np.pi * sample_rate / (256 * shape.size)
    return Excitation(
        np.arange(signal.size) / sample_rate,
        signal,
        np.empty(0),
        kind=kind,
        omega_min=float(low * spacing),
        omega_max=float(high * spacing),
        amplitude=float(amplitude),
        sample_rate=float(sample_rate),
        duration=float(shape.size / sample_rate),
        lead=float(lead),
        tail=float(tail),
    )
