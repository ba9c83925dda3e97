import dataclasses

import numpy as np
from jaxtyping import Array

from jaxquad.spectra import FrequencyResponse


def one_pair(frf: FrequencyResponse, output: int | str, input: int | str) -> FrequencyResponse:
    """The response of one output to one input, by name or number; raises ValueError."""
    o = _position("output", output, frf.output_names)
    i = _position("input", input, frf.input_names)

    def pick(values: Array) -> Array:
        return values[:, o : o + 1, i : i + 1]

    share = None if frf.errors.share is None else pick(frf.errors.share)
    errors = dataclasses.replace(
        frf.errors,
        effect=frf.errors.effect[:, i : i + 1],
        noise=frf.errors.noise[:, o : o + 1],
        share=share,
    )
    return dataclasses.replace(
        frf,
        response=pick(frf.response),
        coherence=pick(frf.coherence),
        random_error=pick(frf.random_error),
        errors=errors,
        direct_coherence=pick(frf.direct_coherence),
        multiple_coherence=frf.multiple_coherence[:, o : o + 1],
        input_names=frf.input_names[i : i + 1],
        output_names=frf.output_names[o : o + 1],
    )


def _position(role: str, wanted: int | str, names: tuple[str, ...]) -> int:
    if isinstance(wanted, str) and wanted in names:
        return names.index(wanted)
    if isinstance(wanted, int | np.integer) and 0 <= wanted < len(names):
        return int(wanted)
    raise ValueError(f"{role}={wanted!r}: the response has {role}s 0 to {len(names) - 1}, {names}")
