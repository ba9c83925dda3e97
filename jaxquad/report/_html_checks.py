"""The model simulated on records, in the time domain."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from jaxquad.identify import Verification
from jaxquad.plot import extremes, overlay, short_names, unit_label

from ._html_figure import figure, short_unit
from ._html_text import element, given, Html, joined, section, table
from ._html_verdict import GOOD_TIC


def check_section(checks: Mapping[str, Verification]) -> Html:
    note = (
        "The model simulated open loop from the measured input, beside the measured output. "
        f"Agreement is good for a Theil inequality coefficient (TIC) below {GOOD_TIC}."
    )
    parts = []
    for name, check in checks.items():
        parts += [element("h3", given(name)), _overlay(name, check), _measures(check)]
    return section("verification", "Verification", element("p", note), *parts)


def _overlay(name: str, check: Verification) -> Html:
    outputs = zip(check.outputs, short_names([one.name for one in check.outputs]), strict=True)
    short = replace(
        check,
        outputs=tuple(replace(one, name=n, unit=short_unit(one.unit)) for one, n in outputs),
    )
    return figure(
        lambda: overlay(_thinned(short)),
        alt=f"Measured and simulated {check.output_name} over time, {name}: fit "
        f"{check.fit_percent:.1f} %, TIC {check.tic:.3f}.",
    )


def _thinned(check: Verification) -> Verification:
    """Of a long one, the samples at the extremes of what is drawn."""
    shape = (check.time.size, -1)
    measured, simulated = check.measured.reshape(shape), check.simulated.reshape(shape)
    curves = np.concatenate([measured, simulated, measured - simulated], axis=1).T
    kept = np.unique(np.concatenate([extremes(curve) for curve in curves]))
    return replace(
        check,
        time=check.time[kept],
        measured=check.measured[kept],
        simulated=check.simulated[kept],
    )


def _measures(check: Verification) -> Html:
    rows = []
    for one in check.outputs:
        scale, unit = unit_label(one.unit)
        numbers = (f"{one.fit_percent:.1f}", f"{one.variance_percent:.1f}", f"{one.tic:.3f}")
        named = given(unit.removeprefix(", ")) if unit else "\u2013"
        rows.append([given(one.name), named, *numbers, f"{scale * one.rms:.4g}"])
    heads = ("output", "unit", "fit, %", "variance accounted for, %", "TIC", "rms difference")
    left = f"Starting transients left out, for the record does not show them: {check.omitted}."
    noted = element("p", left, css="soft") if check.omitted else ""
    shown = table(heads, rows, title=f"Agreement, {_band(check)}", texts=2)
    return joined(shown, noted)


def _band(check: Verification) -> str:
    if check.band is None:
        return "whole band"
    low, high = check.band
    return f"within {low:.4g} .. {high:.4g} rad/s"
