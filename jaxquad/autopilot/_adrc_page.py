"""The page of a proposal for Betaflight's ADRC, from what `autopilot` found."""

from typing import TYPE_CHECKING

import numpy as np

from jaxquad.identify import GainBand, GainOverThrottle
from jaxquad.plot import StepBand, ThrottleCurve
from jaxquad.records import AXES
from jaxquad.report import Headline, Provenance, Table

from ._adrc import ADRCProposal
from ._adrc_loops import ADRCFrame, make_adrc_loop
from ._filters import FilterChain, PT2
from ._page import B0Section, PilotPage
from ._pilot_page import (
    Chains,
    chains_of,
    change_rows,
    logged_terms,
    motor_rows,
    StepGrid,
    VERDICTS,
)
from .betaflight._adrc import FlownADRC


if TYPE_CHECKING:
    from ._adrc_result import ADRCAutopilot

_PLANTS, _SEED = 100, 77  # of the steps' bands
_POINTS = 60  # of a curve over the throttle


def adrc_page(found: "ADRCAutopilot", origin: Provenance) -> PilotPage:
    """All that the page shows."""
    version, proposal, plant = ".".join(map(str, found.version)), found.proposal, found.plant
    flight = found.flight
    return PilotPage(
        title=f"betaflight {version}, ADRC for {found.axis}".replace(" ,", ","),
        headlines=_headlines(found),
        remarks=[*found.remarks, *(f"not modelled: {each}" for each in found.flown.unmodelled)],
        filters=_filters(found),
        steps={} if proposal is None or plant is None else _steps(found, proposal, plant),
        b0=None if proposal is None or plant is None else _b0(found, proposal, plant),
        terms={} if flight is None or not flight.terms else logged_terms(flight),
        terms_are="as logged",
        motors=[] if flight is None else motor_rows(flight),
        stages=None if proposal is None else _stage_rows(proposal, found.settings.fresh),
        changes=change_rows(found.changes, found.words) if found.new else None,
        text=str(found),
        unit="pidsum",
        provenance=origin,
    )


def _headlines(found: "ADRCAutopilot") -> list[Headline]:
    headlines = [Headline(*VERDICTS[found.kind], found.verdict)]
    for throttle, each in found.shown_again.items():
        flew = each.kind == "flown"
        word = "THE FLOWN LOOP AGAIN" if flew else "THE FLOWN LOOP IS NOT REPRODUCED"
        level = "good" if flew else "warn" if each.kind == "unknown" else "bad"
        headlines.append(Headline(level, word, f"at {throttle:.2f} throttle: {each.verdict}"))
    return headlines


def _frame(found: "ADRCAutopilot", proposal: ADRCProposal) -> ADRCFrame:
    values = found.new or found.flown.parameters()
    return ADRCFrame(
        proposal.schedule, values.get("adrc_gyro_lpf_hz", 150.0), values.get("adrc_td_hz", 0.0),
        values.get("adrc_sigma_decay", 3.0) / 10,
    )  # fmt: skip


def _filters(found: "ADRCAutopilot") -> dict[str, Chains]:
    """Those that flew, and those of the ADRC where the PID flew."""
    flown, axis = found.flown, AXES.index(found.axis)
    pid = flown.pid.law if isinstance(flown, FlownADRC) else flown.law
    chains = chains_of(pid, axis)
    if isinstance(flown, FlownADRC):
        return {"flown": _with_observer(chains, flown.lowpass_hz, pid.dt)}
    if found.proposal is None or not found.new:
        return {"flown": chains}
    cutoff = found.new["adrc_gyro_lpf_hz"]
    return {"flown": chains, "proposed": _with_observer(chains, cutoff, pid.dt)}


def _with_observer(chains: Chains, cutoff: float, dt: float) -> Chains:
    own = (FilterChain((PT2(cutoff),), 1 / dt),) if cutoff > 0 else ()
    return {"gyro": chains["gyro"], "observer": own}


def _steps(
    found: "ADRCAutopilot", proposal: ADRCProposal, plant: GainOverThrottle
) -> dict[str, StepBand]:
    """At the middle one of the throttles that were certified."""
    middle = proposal.throttle[len(proposal.throttle) // 2]
    grid = StepGrid.of(found.flown.law.dt)
    loop = make_adrc_loop(
        plant, found.flown, AXES.index(found.axis), middle, _frame(found, proposal), _PLANTS,
        found.settings.seed + _SEED, grid.omega,
    )  # fmt: skip
    name = lambda law: f"{law}, {middle:.2f} throttle"
    flown = name(f"{'ADRC' if found.flew_adrc else 'PID'} flown")
    steps = {flown: grid.band(loop.closed(None))}
    if found.new:
        design = np.array(proposal.stage[:3])
        steps[name("ADRC proposed")] = grid.band(loop.closed(design))
    return steps


def _b0(found: "ADRCAutopilot", proposal: ADRCProposal, plant: GainOverThrottle) -> B0Section:
    levels = [plant.b0(k) for k in range(plant.throttle.size)]
    low, high = np.array([each.interval for each in levels]).T
    measured = GainBand(plant.throttle, np.array([each.value for each in levels]), low, high)
    ends = float(plant.low.min()), float(plant.high.max())
    grid, scale = np.linspace(*ends, _POINTS), proposal.schedule.scale
    taken = {}
    if isinstance(found.flown, FlownADRC):
        b0 = proposal.stages["what flew"].b0
        taken["b0 that flew"] = ThrottleCurve(grid, b0 * found.flown.schedule.scale(grid))
    if found.new:
        name = f"b0 proposed, {proposal.law}"
        taken[name] = ThrottleCurve(grid, proposal.stage.b0 * scale(grid))
    curve = None if proposal.scaled is None else plant.b0_over(grid)
    text = plant.what_to_fly() if proposal.scaled is None else f"gain / lag: {proposal.scaled}"
    text = f"{text[0].upper()}{text[1:]}"
    more = (
        " The best b0 is not gain / lag: the motors' own pole 1 / lag is a part of what the "
        "observer has to follow."
    )
    return B0Section(measured, taken, curve, f"{text}.{more}")


def _stage_rows(proposal: ADRCProposal, fresh: int) -> Table:
    number = lambda x: "-" if np.isnan(x) else f"{x:.0f}"
    rows = [
        [
            name, number(x.wc), number(x.wo), number(x.b0), f"{100 * x.stable:.1f}",
            f"{x.peak:.2f}", f"{x.resonance:.2f}", f"{x.crossover / (2 * np.pi):.1f}",
            f"{x.rejection:.2f}", f"{x.noise:.2f}",
        ]
        for name, x in proposal.stages.items()
    ]  # fmt: skip
    heads = (
        "parameters", "wc", "wo", "b0", "stable, %", "worst Ms", "worst peak", "crossover, Hz",
        "torque", "noise",
    )  # fmt: skip
    first, last = proposal.throttle[0], proposal.throttle[-1]
    where = f"at {first:.2f}" if first == last else f"from {first:.2f} to {last:.2f}"
    return Table(f"On {fresh} fresh plants, {where} throttle", heads, rows)
