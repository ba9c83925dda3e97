"""The sections of a proposal's page that hold figures."""

from collections.abc import Callable, Mapping

from jaxquad.plot import (
    again_figure,
    b0_figure,
    balance_figure,
    filters_figure,
    spectra_figure,
    StepBand,
    steps_figure,
)
from jaxquad.report import Cell, embed_figure, Section, Table

from ._filters import FilterChain
from ._page import Chains, PilotPage


_SHOWN = (10.0, 50.0)  # Hz, of a table of delays


def _filters(page: PilotPage) -> Section:
    filters = page.filters
    drawn = {
        f"{signal}, {design}": _passed(chains, signal)
        for design, chains in filters.items()
        for signal in chains
    }
    drawn = {name: chains for name, chains in drawn.items() if chains}
    if not drawn:
        return {"image": None, "tables": []}
    image = embed_figure(
        lambda: filters_figure(drawn),
        alt=f"Magnitude and delay over the frequency of {', '.join(drawn)}.",
        caption="Magnitude and phase delay; what filters the gyro filters the D term, too.",
    )
    tables = [_delays(design, chains) for design, chains in filters.items()]
    return {"image": image, "tables": tables}


def _passed(chains: Chains, signal: str) -> list[FilterChain]:
    """All filters that a signal has passed: those of the gyro, too."""
    names = list(chains)[: list(chains).index(signal) + 1]
    return [chain for name in names for chain in chains[name] if chain.filters]


def _delays(design: str, chains: Chains) -> Table:
    rows: list[list[str | Cell]] = []
    for signal, group in chains.items():
        total = [0.0] * len(_SHOWN)
        for chain in group:
            *shares, _ = chain.shares(_SHOWN)
            for share in shares:
                late = [float(x) for x in share.delay_ms]
                total = [a + b for a, b in zip(total, late, strict=True)]
                rows.append([Cell(share.name), signal, *(f"{x:.2f}" for x in late)])
        rows.append([f"all of the {signal}'s", signal, *(f"{x:.2f}" for x in total)])
    heads = ("filter", "of", *(f"delay at {x:g} Hz, ms" for x in _SHOWN))
    return Table(f"Filters {design}, with their shares of the delay", heads, rows, texts=2)


def _noise(page: PilotPage) -> Section | None:
    if not page.gyro:
        return None
    image = embed_figure(
        lambda: spectra_figure(page.gyro, page.derivative, unit=page.unit),
        alt=f"Spectra of the gyro and of the D term: {', '.join(page.gyro)}.",
        caption="Noise of the gyro, and what the D term makes of it; before the filters by the "
        "gain that flew.",
    )
    return {"image": image, "text": page.noise}


def _steps(page: PilotPage) -> Section | None:
    if not page.steps:
        return None
    image = embed_figure(
        lambda: steps_figure(page.steps),
        alt=f"Rate after a step of the set-point: {', '.join(page.steps)}; 95 % of the plants.",
        caption="The logged rate after a step of 1 of the set-point, without feed-forward: median "
        "and 95 % of the plants that the log leaves possible.",
    )
    rows = [[Cell(name), *_step_numbers(band)] for name, band in page.steps.items()]
    heads = ("gains", "overshoot, %", "worst, %", "half way after, ms")
    return {"image": image, "table": Table("Step responses", heads, rows)}


def _step_numbers(band: StepBand) -> list[str]:
    half = float(band.time[(band.middle >= 0.5).argmax()])
    over = [100 * max(float(x.max()) - 1, 0.0) for x in (band.middle, band.high)]
    return [f"{over[0]:.0f}", f"{over[1]:.0f}", f"{1e3 * half:.0f}"]


def _again(page: PilotPage) -> Section | None:
    flight = page.again
    if flight is None:
        return None
    image = embed_figure(
        lambda: again_figure(flight),
        alt="Set-point, logged rate, and the rate that law and plant make of the set-point.",
        caption="The liveliest part of the flight: the rate as logged, and as the law that flew "
        "and the identified plant make it of the logged set-point alone, without gusts.",
    )
    return {"image": image, "text": page.again_text}


def _b0(page: PilotPage) -> Section | None:
    section = page.b0
    if section is None:
        return None
    levels = section.levels
    image = embed_figure(
        lambda: b0_figure(levels, section.taken, curve=section.curve),
        alt=f"b0 over the throttle: of the log, and {', '.join(section.taken)}.",
        caption="b0 over the throttle: gain / lag of the log with what it leaves uncertain, and "
        "what the ADRC takes.",
    )
    rows: list[list[str | Cell]] = [
        [f"{x:.2f}", f"{value:.0f}", f"{low:.0f} .. {high:.0f}"]
        for x, value, low, high in zip(*levels, strict=True)
    ]
    heads = ("throttle", "gain / lag, deg/s^3", "95 %")
    return {"image": image, "table": Table("Levels flown", heads, rows), "text": section.text}


def _balance(page: PilotPage) -> Section | None:
    if not page.terms and not page.motors:
        return None
    image = None
    if page.terms:
        shown = ", ".join(f"{name} {value:.3g}" for name, value in page.terms.items())
        image = embed_figure(
            lambda: balance_figure(page.terms, unit=page.unit),
            alt=f"Root mean squares of the terms: {shown} {page.unit}.",
            caption=f"Root mean square of each term of the command in the log, {page.terms_are}; "
            "the mean of I is left out.",
        )
    rows = [
        [Cell(name), f"{100 * low:.2f}", f"{100 * high:.2f}"] for name, low, high in page.motors
    ]
    motors = Table("Motors at their limits", ("motor", "lowest, %", "highest, %"), rows)
    return {"image": image, "motors": motors if rows else None}


SECTIONS: Mapping[str, Callable[[PilotPage], Section | None]] = {
    "filters": _filters,
    "again": _again,
    "noise": _noise,
    "steps": _steps,
    "b0": _b0,
    "balance": _balance,
}  # None for what a page does not have
