"""Messages of the library in the words of the command line.

The library speaks Python: `max_gap=` is an argument, `jq.verify` a function. Someone who typed
`jaxquad identify` needs the option, `--max-gap`, or the command, `jaxquad verify`.
"""

import re

from ._batch._settings import BatchSettings
from ._settings import IdentifySettings
from ._tune_settings import AutopilotSettings, TuneSettings


_FLAGS = {
    key: option.flag
    for settings in (BatchSettings, AutopilotSettings, TuneSettings, IdentifySettings)
    for key, option in settings.options().items()
}
_ARGUMENTS = _FLAGS | {  # those of `read`, `frequency_response` and `fit`, whose names differ
    "inputs": "--input",
    "outputs": "--output",
    "references": "--reference",
    "sample_rate": "--rate",
    "window_length": "--window",
    "band": "--band-rad",  # of a fit, in rad/s
}
_PHRASES = {
    r",? or build a jq\.Record from its arrays": "",
    r", jq\.records\.channels\b": "",
    r"name inputs, outputs and references yourself": "name them (--input, --output, --reference)",
    r" \(jq\.Record, jq\.read\)": "",
    r"jq\.read\(\.\.\., sample_rate=\), jq\.Record\.from_dataframe\([^)]*\) or "
    r"jq\.records\.resample": "--rate",
    r" in jq\.read, or cut the arrays": "",
    r" \(estimator=jq\.spectra\.LocalPolynomial\(\)\)": " (without --reference)",
    r"select other channels with jq\.records\.select, or ": "",
    r"pick channels with jq\.records\.select": "name one channel each with --input and --output",
    r"(leave it out) with jq\.records\.select": r"\1",
    r"(?:, or give the frequencies )?\(omega=\)": "",
    r"jq\.spectra\.LocalPolynomial\(\)": "--estimator local",
    r", or let its sign change with jq\.identify\.Real\([^)]*\)": " (--no-lag, --no-delay)",
    r": start with the other sign, or let the sign change with jq\.identify\.Real\([^;]*; "
    "where that cannot be, the model": ". A lag and a delay cannot be negative: the model",
    r"fit with a jq\.identify\.Prior or a second record, or ask for a determined combination":
        "fit without one of them (--no-lag, --no-delay), or fly again with more excitation",
    r", or raise global_order": "",
    r"; or use a larger width: [^;.]*": "",
    r"start from other values, or leave solver= at its default":
        "choose another band (--band) or a simpler model (--no-lag, --no-delay, fewer --poles)",
    r"start from other values": "choose another band (--band)",
    r", (?:try many starts at once \(starts=20\)|or give starts=20)": "",
    r"as valid=\{[^}]*\}": "as --valid NAME=-20:20",
    r"try other starting values": "try another band (--band), or jaxquad identify --no-lag",
    r"Fit\.explain\(\)": "--explain",
    r"jq\.verify\b": "jaxquad verify",
    r"jq\.propose\b": "jaxquad identify",
    r"jq\.(?:excitation\.)?sweep\b": "jaxquad design sweep",
    r" \(leave it out of free=\)": "",
    r", jq\.frequency_response\(\.\.\., estimator=jq\.spectra\.JointInputOutput\(\)\)":
        " (--reference)",
}  # fmt: skip


def in_options(text: str) -> str:
    """A message with options in place of Python's arguments, and of the keys of settings."""
    for phrase, replacement in _PHRASES.items():
        text = re.sub(phrase, replacement, text)
    text = re.sub(r"`(\w+)`", lambda key: _FLAGS.get(key[1], key[0]), text)
    text = re.sub(r"\b([a-z_]+)=(?=[\s),;.:]|$)", lambda key: _ARGUMENTS.get(key[1], key[0]), text)
    return re.sub(r"\(([a-z_]+)=(?=[^\s=])", _with_value, text)


def _with_value(found: re.Match[str]) -> str:
    flag = _ARGUMENTS.get(found[1])
    return f"({flag} " if flag else found[0]
