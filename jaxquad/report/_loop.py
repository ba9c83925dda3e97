"""The broken loop that was flown: crossover and margins, by its law or from the record alone."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxquad.plot import plain_ticks, StepBand
from jaxquad.records import Record
from jaxquad.spectra import BrokenLoop, Entry, estimate_broken_loop, FrequencyResponse

from ._figure import embed_figure, Image, Section


_FEWEST = 8  # frequencies of a loop that is shown
_SIGMAS = 1.96
_ALONE = "Estimated from the record alone, without plant or controller. It holds if "
_ASSUMED: dict[Entry, str] = {
    "set-point": f"{_ALONE}the controller sees the reference only as its difference from the "
    "output.",
    "plant input": f"{_ALONE}the reference is added to the command, and nothing else answers it.",
}
_BY_LAW = (
    "The law of the log's parameters, with the integral as set, times the measured response from "
    "command to rate."
)


class LawLoop(NamedTuple):
    """The flown loop where the law is known.

    **Attributes:**

    - `measured`: law times measured response of the plant; `model`: times the identified one.
    - `step`: from set-point to rate, of plants that the fit leaves possible.
    - `unmodelled`: what the law leaves out.
    """

    measured: BrokenLoop
    model: BrokenLoop | None
    step: StepBand | None
    unmodelled: Sequence[str] = ()

    @property
    def note(self) -> str:
        """What it is, in words."""
        missing = "; ".join(self.unmodelled)
        return f"{_BY_LAW} Not in the law: {missing}." if missing else _BY_LAW


def loop_section(
    frf: FrequencyResponse, record: Record, law: LawLoop | None = None
) -> Section | None:
    """Bode diagram, crossover and margins, by the law where it is known.

    Without it None where the units do not tell where the reference enters.
    """
    if law is not None and law.measured.omega.size >= _FEWEST:
        image = embed_figure(
            lambda: _figure(law.measured, law.model),
            alt=f"Bode diagram of the broken loop with its 95 % band; crossover "
            f"{_facts(law.measured, law.model)['crossover']}.",
            caption="Broken loop L, the law times the plant's response; grey holds 95 %.",
        )
        return {"image": image, "facts": _facts(law.measured, law.model), "note": law.note}
    entry = entry_of(record, frf)
    if entry is None:
        return None
    found = estimate_broken_loop(
        record, entry=entry, output=frf.output_names[0], input=frf.input_names[0]
    )
    if found.omega.size < _FEWEST:
        return None
    return {"image": _image(found, record, entry), "facts": _facts(found), "note": _ASSUMED[entry]}


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


def _facts(found: BrokenLoop, model: BrokenLoop | None = None) -> dict[str, str]:
    """Those that are not seen are those of the model, where there is one."""
    crossover, by = found.crossover, ""
    if model is not None and np.isnan(crossover):
        found, crossover, by = model, model.crossover, " by the identified model"
    if np.isnan(crossover):
        low, high = found.omega[[0, -1]] / (2 * np.pi)
        where = f"|L| does not fall through 1 from {low:.3g} to {high:.3g} Hz"
        return {"crossover": f"not seen: {where}, where the loop can be estimated"}
    margin, error = found.phase_margin
    gain, place = found.gain_margin
    beyond = ""
    if model is not None and not np.isfinite(gain):
        (gain, place), beyond = model.gain_margin, " by the identified model"
    sure = f" \u00b1 {np.degrees(_SIGMAS * error):.2g} deg (95 %)" if error else " deg"
    facts = {
        "crossover": f"{crossover / (2 * np.pi):.3g} Hz ({crossover:.3g} rad/s){by}",
        "phase margin": f"{np.degrees(margin):.3g}{sure}; 45 deg or more is usual",
        "gain margin": "not seen: the phase does not pass -180 deg where the loop can be estimated",
    }
    if np.isfinite(gain):
        facts["gain margin"] = (
            f"{20 * np.log10(gain):.3g} dB at {place / (2 * np.pi):.3g} Hz ({place:.3g} rad/s)"
            f"{beyond}; 6 dB or more is usual"
        )
    return facts


def _image(found: BrokenLoop, record: Record, entry: Entry) -> Image:
    facts = _facts(found)
    return embed_figure(
        lambda: _figure(found),
        alt=f"Bode diagram of the broken loop with its 95 % band; crossover {facts['crossover']}.",
        caption=f"Broken loop L, from {record.reference_names[0]} as {entry}; grey holds 95 %.",
    )


def _figure(found: BrokenLoop, model: BrokenLoop | None = None) -> Figure:
    figure = Figure(figsize=(5.0, 4.2))
    level = figure.add_axes((0.14, 0.52, 0.82, 0.36), label="level")
    phase = figure.add_axes((0.14, 0.11, 0.82, 0.36), sharex=level, label="phase")
    level.tick_params(labelbottom=False)
    turn = _turn(found)
    decibels, reach = 20 * np.log10(np.abs(found.response)), _SIGMAS * found.error
    drawn = ((level, decibels, 20 / np.log(10) * reach), (phase, turn, np.degrees(reach)))
    for panel, values, band in drawn:
        panel.fill_between(found.omega, values - band, values + band, color="0.8", lw=0)
        panel.plot(found.omega, values, "o-", ms=3, lw=1, color="0.15", label="L")
        margin = 0.06 * np.ptp(values) + 3
        panel.set_ylim(values.min() - margin, values.max() + margin)
        panel.grid(True, color="0.9", lw=0.5)
        if model is not None:
            inside = (model.omega >= found.omega[0] / 1.5) & (model.omega <= 1.5 * found.omega[-1])
            line = _turn(model) if panel is phase else 20 * np.log10(np.abs(model.response))
            panel.plot(model.omega[inside], line[inside], color="tab:blue", lw=1, label="model")
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


def _turn(loop: BrokenLoop) -> np.ndarray:
    """The phase in deg, which passes -180 at the crossover without a margin."""
    turn = np.degrees(np.unwrap(np.angle(-loop.response)))
    at = np.interp(np.log(loop.crossover), np.log(loop.omega), turn)
    return turn - 180 - (0 if np.isnan(at) else 360 * np.round(at / 360))
