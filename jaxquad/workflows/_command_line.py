"""What the command line says where the library speaks Python.

`max_gap=` is an argument, `jq.verify` a function. Someone who typed `jaxquad identify` needs the
option, `--max-gap`, or the command, `jaxquad verify`.
"""

from jaxquad._core import marked_text, Message

from ._settings import AutopilotSettings, BatchSettings, IdentifySettings, TuneSettings


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
_WORDS = {  # of a message, by what stands in its guillemets
    "name inputs, outputs and references yourself": "name them (--input, --output, --reference)",
    "pick channels with jq.records.select": "name one channel each with --input and --output",
    "select other channels with jq.records.select, or ": "",
    " with jq.records.select": "",
    ", jq.records.channels": "",
    ", or build a jq.Record from its arrays": "",
    " in jq.read, or cut the arrays": "",
    " (jq.Record, jq.read)": "",
    "jq.spectra.LocalPolynomial()": "--estimator local",
    " (estimator=jq.spectra.LocalPolynomial())": " (without --reference)",
    "joint estimate": " (--reference)",
    ", or give the frequencies (omega=)": "",
    ", or raise global_order": "",
    "wider": "",
    "start from other values": "choose another band (--band)",
    "start from other values, or leave solver= at its default":
        "choose another band (--band) or a simpler model (--no-lag, --no-delay, fewer --poles)",
    "try other starting values": "try another band (--band), or jaxquad identify --no-lag",
    ", or give starts=20": "",
    "sign": " (--no-lag, --no-delay)",
    "other sign": ". A lag and a delay cannot be negative: the model",
    " (leave it out of free=)": "",
    "fit with a jq.identify.Prior or a second record, or ask for a determined combination":
        "fit without one of them (--no-lag, --no-delay), or fly again with more excitation",
    "Fit.explain()": "--explain",
    "jq.verify": "jaxquad verify",
    "jq.sweep": "jaxquad design sweep",
}  # fmt: skip


def in_options(text: str | BaseException) -> Message:
    """A message with options in place of Python's words, and of keys of settings in backticks."""
    marked = marked_text(text)
    for key, flag in _FLAGS.items():
        marked = marked.replace(f"`{key}`", flag)
    return Message(marked, text.kind if isinstance(text, Message) else "").in_words(_word)


def _word(term: str) -> str:
    key, _, python = term.rpartition("|")
    key = key or python
    name, _, value = key.partition("=")
    flag = _ARGUMENTS.get(name)
    return _WORDS.get(key, python if flag is None else f"{flag} {value}".rstrip())
