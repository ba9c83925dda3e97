"""The broken loop that was flown: crossover and margins, from the record alone."""

import numpy as np
from matplotlib.figure import Figure

from jaxquad.plot import plain_ticks
from jaxquad.records import Record
from jaxquad.spectra import BrokenLoop, Entry, estimate_broken_loop, FrequencyResponse

from ._figure import embed_figure, Image, Section


_FEWEST = 8  # frequencies of a loop that is shown
_SIGMAS = 1.96
_ASSUMED = {
    "set-point": "the controller sees the reference only as its difference from the output",
    "plant input": "the reference is added to the command, and nothing else answers it",
}


def loop_section(frf: FrequencyResponse, record: Record) -> Section | None:
    """Bode diagram, crossover and margins; None where the units do not tell where r enters."""
    entry = entry_of(record, frf)
    if entry is None:
        return None
    found = estimate_broken_loop(
        record, entry=entry, output=frf.output_names[0], input=frf.input_names[0]
    )
    if found.omega.size < _FEWEST:
        return None
    return {"image": _image(found, record, entry), "facts": _facts(found), "if": _ASSUMED[entry]}


def entry_of(record: Record, frf: FrequencyResponse) -> Entry | None:
    """Where the reference enters, by its unit: that of the output, or that of the input."""
    if not record.reference_names:
        return None
    unit = record.unit(record.reference_names[0])
    output, source = record.unit(frf.output_names[0]), record.unit(frf.input_names[0])
    if output == source:
        return None
    entries: dict[str, Entry] = {output: "set-point", source: "plant input"}
    return entries.get(unit)


def _facts(found: BrokenLoop) -> dict[str, str]:
    crossover = found.crossover
    if np.isnan(crossover):
        low, high = found.omega[[0, -1]] / (2 * np.pi)
        where = f"|L| does not fall through 1 from {low:.3g} to {high:.3g} Hz"
        return {"crossover": f"not seen: {where}, where the loop can be estimated"}
    margin, error = found.phase_margin
    gain, place = found.gain_margin
    facts = {
        "crossover": f"{crossover / (2 * np.pi):.3g} Hz ({crossover:.3g} rad/s)",
        "phase margin": f"{np.degrees(margin):.3g} \u00b1 {np.degrees(_SIGMAS * error):.2g} deg "
        "(95 %); 45 deg or more is usual",
        "gain margin": "not seen: the phase does not pass -180 deg where the loop can be estimated",
    }
    if np.isfinite(gain):
        facts["gain margin"] = (
            f"{20 * np.log10(gain):.3g} dB at {place / (2 * np.pi):.3g} Hz ({place:.3g} rad/s); "
            "6 dB or more is usual"
        )
    return facts


def _image(found: BrokenLoop, record: Record, entry: Entry) -> Image:
    facts = _facts(found)
    return embed_figure(
        lambda: _figure(found),
        alt=f"Bode diagram of the broken loop with its 95 % band; crossover {facts['crossover']}.",
        caption=f"Broken loop L, from {record.reference_names[0]} as {entry}; grey holds 95 %.",
    )


def _figure(found: BrokenLoop) -> Figure:
    figure = Figure(figsize=(5.0, 4.2))
    level = figure.add_axes((0.14, 0.52, 0.82, 0.36), label="level")
    phase = figure.add_axes((0.14, 0.11, 0.82, 0.36), sharex=level, label="phase")
    level.tick_params(labelbottom=False)
    turn = np.degrees(np.unwrap(np.angle(-found.response)))
    at = np.interp(np.log(found.crossover), np.log(found.omega), turn)
    turn = turn - 180 - (0 if np.isnan(at) else 360 * np.round(at / 360))
    decibels, reach = 20 * np.log10(np.abs(found.response)), _SIGMAS * found.error
    drawn = ((level, decibels, 20 / np.log(10) * reach), (phase, turn, np.degrees(reach)))
    for panel, values, band in drawn:
        panel.fill_between(found.omega, values - band, values + band, color="0.8", lw=0)
        panel.plot(found.omega, values, "o-", ms=3, lw=1, color="0.15", label="L")
        margin = 0.06 * np.ptp(values) + 3
        panel.set_ylim(values.min() - margin, values.max() + margin)
        panel.grid(True, color="0.9", lw=0.5)
        if np.isfinite(found.crossover):
            panel.axvline(found.crossover, color="tab:blue", lw=1, ls="--")
    level.axhline(0, color="0.3", lw=0.8)
    phase.axhline(-180, color="0.3", lw=0.8)
    level.set(ylabel="|L|, dB", xscale="log")
    phase.set(ylabel="phase of L, deg", xlabel="frequency, rad/s")
    turns = (lambda omega: omega / (2 * np.pi), lambda hertz: 2 * np.pi * hertz)
    hertz = level.secondary_xaxis("top", functions=turns)
    hertz.set_xlabel("frequency, Hz")
    for axis in (phase.xaxis, hertz.xaxis):
        plain_ticks(axis)
    return figure
