"""The page of a proposal for an autopilot, from what `autopilot` found."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TYPE_CHECKING, TypeVar

import numpy as np
from jaxtyping import Complex, Float

from jaxquad.plot import FlownAgain, Spectrum, StepBand
from jaxquad.records import AXES
from jaxquad.report import Cell, Headline, Provenance, reason_of, Table

from ._files import ParameterChange, WordChange
from ._filters import FilterChain
from ._firmware import firmware_named
from ._flight_channels import FlightChannels
from ._gyro_noise import gyro_noise, GyroNoise
from ._law import RateLoop
from ._page import PilotPage
from ._rate_loops import gains_in, gains_of, gyro_chain_response, law_paths
from ._stages import limits_text


if TYPE_CHECKING:
    from ._proposal import AutopilotProposal

Chains = dict[str, tuple[FilterChain, ...]]
_PLANTS, _SEED = 100, 77  # of the steps' bands
_PERIOD, _SHOWN, _FINEST = 8.0, 1.2, 1 / 400  # s, of a computed step, of a shown one, of a sample
_WINDOW = 4.0  # s, of computed terms
_NEAR = 0.005  # of a motor's range, from its ends
_SLOWEST = 20.0  # Hz, below which motion is taken for noise


Designs = Mapping[str, tuple[RateLoop, Float[np.ndarray, " gains"]]]
Part = TypeVar("Part")
VERDICTS = {
    "proposed": ("good", "PROPOSED"), "kept": ("good", "WHAT FLEW IS KEPT"),
    "cannot tell": ("bad", "THIS LOG CANNOT TELL"), "not to be flown": ("bad", "NOT TO BE FLOWN"),
}  # fmt: skip


def pilot_page(proposal: "AutopilotProposal", origin: Provenance, overview: str = "") -> PilotPage:
    """All that the page shows; what cannot be computed says why. `overview` is of all axes."""
    flown, flight, new = proposal.flown, proposal.flight, proposal.new
    law, axis, filters = flown.law, flown.axis, proposal.filters
    failures: dict[str, str] = {}

    def attempt(section: str, compute: Callable[[], Part], missing: Part) -> Part:
        try:
            return compute()
        except Exception as error:  # the page holds the rest
            failures[section] = reason_of(error)
            return missing

    def shown_noise() -> GyroNoise | None:
        if proposal.noise is not None or flight is None:
            return proposal.noise
        noise = gyro_noise(flight, law, axis, _SLOWEST)
        return noise if isinstance(noise, GyroNoise) else None

    designs = {"flown": (law, gains_of(law, axis))}
    if new:
        changed = {} if filters is None else {name: new[name] for name in filters.flown}
        after = flown.with_filters(changed) if changed else law
        designs["proposed"] = (after, gains_in(law, axis, new))
    noise = attempt("noise", shown_noise, None)
    spectra = lambda: ({}, {}) if noise is None else noise_spectra(noise, axis, designs)
    gyro, derivative = attempt("noise", spectra, ({}, {}))
    steps = lambda: (
        step_bands(proposal, designs) if proposal.identification.fit.identifiable else {}
    )
    logged = flight is not None and {"P", "I"} <= set(flight.terms)
    compute_terms = lambda: (
        {} if flight is None else logged_terms(flight) if logged
        else computed_terms(flight, law, axis)
    )  # fmt: skip
    terms = attempt("balance", compute_terms, {})
    terms_are = "as logged" if logged else "computed by the law from set-point and rate"
    headlines = [Headline(*VERDICTS[proposal.kind], proposal.verdict)]
    check, throttle = proposal.reproduction, proposal.throttle
    if check is not None and check.kind == "flown":  # else the verdict says it
        headlines.append(Headline("good", "THE FLOWN LOOP AGAIN", check.verdict))
    if filters is not None:
        headlines.append(Headline("good" if filters.flown else "warn", "FILTERS", filters.text))
    if throttle is not None:
        level = "warn" if throttle.gains is None else "good"
        headlines.append(Headline(level, "THROTTLE", throttle.text))
        if throttle.curve is not None:
            level = "warn" if throttle.curve.change else "good"
            headlines.append(Headline(level, "THRUST CURVE", throttle.curve.text))
    version = ".".join(map(str, flown.version))
    return PilotPage(
        title=f"{flown.firmware} {version}, rate loop of {AXES[axis]}".replace(" ,", ","),
        headlines=headlines,
        remarks=[
            *(f"not modelled: {text}" for text in flown.unmodelled),
            *([flown.filters_text] if flown.filters_text else []),
            *([limits_text(proposal.settings)] if new else []),
        ],
        filters={
            name: chains_of(other, axis)
            for name, (other, _) in designs.items() if name == "flown" or other is not law
        },
        gyro=gyro,
        derivative=derivative,
        noise="" if noise is None else (
            f"Noise of {noise.source}, less what the set-point explains. Below "
            f"{noise.least_hz:.0f} Hz motion is taken for noise, so the level above is used."
        ),
        steps=attempt("steps", steps, {}),
        terms=terms,
        terms_are=terms_are,
        motors=[] if flight is None else motor_rows(flight),
        stages=stage_rows(proposal) if proposal.stages else None,
        changes=change_rows(proposal.changes) if new else None,
        text=str(proposal),
        unit=firmware_named(flown.firmware).unit,
        again=None if check is None else FlownAgain(
            check.time, check.setpoint, check.rate, check.again
        ),
        again_text="" if check is None else f"{check.verdict[0].upper()}{check.verdict[1:]}.",
        overview=overview,
        provenance=origin,
        failures=failures,
    )  # fmt: skip


def chains_of(law: RateLoop, axis: int) -> Chains:
    """The filters of the gyro and those of the D term alone."""
    gyro, slope = law.gyro_chains(), law.derivative_chain(axis)
    chains: Chains = {"gyro": tuple(chain for chain in gyro if chain.filters)}
    if slope.filters and gains_of(law, axis)[2] > 0:
        chains["D term"] = (slope,)
    return chains


def noise_spectra(
    noise: GyroNoise, axis: int, designs: Designs
) -> tuple[dict[str, Spectrum], dict[str, Spectrum]]:
    """Of gyro and D term: before all filters, then behind those of each design."""
    inside = (noise.before.hertz > 1.0) & (noise.before.hertz <= noise.known_hz)
    hertz, before = noise.before.hertz[inside], noise.before.power[inside]
    behind = noise.behind.power[inside]
    omega = 2 * np.pi * np.minimum(hertz, 0.4999 / designs["flown"][0].dt)
    law, gains = designs["flown"]
    gyro, derivative = {"before the filters": Spectrum(hertz, before)}, {}
    chain = gyro_chain_response(law, omega)
    for name, (other, its_gains) in designs.items():
        changed = np.abs(gyro_chain_response(other, omega) / chain) ** 2
        if name == "flown" or other is not law:
            gyro[name] = Spectrum(hertz, behind * changed)
        through = np.abs(its_gains[2] * law_paths(other, axis, omega)[0][2]) ** 2
        if name == "flown" and gains[2] > 0:
            [slope] = chains_of(law, axis).get("D term", [FilterChain((), 1 / law.dt)])
            open = before * through / np.abs(np.asarray(slope.response(hertz))) ** 2
            derivative["before the filters"] = Spectrum(hertz, open)
        if its_gains[2] > 0:
            derivative[name] = Spectrum(hertz, behind * changed * through)
    return gyro, derivative


def step_bands(proposal: "AutopilotProposal", designs: Designs) -> dict[str, StepBand]:
    """From set-point to rate, of plants drawn from the fit: by their responses."""
    flown, axis = proposal.flown, proposal.flown.axis
    grid, seed = StepGrid.of(flown.law.dt), proposal.settings.seed + _SEED
    loops = proposal.plants.loops(flown.law, axis, _PLANTS, seed, omega=grid.omega)
    steps = {}
    for name, (law, gains) in designs.items():
        mine = loops if law is flown.law else loops.of_law(law, axis)
        [back], [ahead] = mine.paths(gains[None])
        steps[name] = grid.band(ahead * mine.plants / (1 + back * mine.plants))
    return steps


class StepGrid(NamedTuple):
    """Frequencies from whose closed responses steps are computed.

    **Attributes:**

    - `dt`: of the computed step in s; `omega`: rad/s.
    - `fade`: of the responses, where the law runs faster than the step is computed.
    """

    dt: float
    omega: Float[np.ndarray, " frequencies"]
    fade: Float[np.ndarray, " frequencies"]

    @classmethod
    def of(cls, dt: float) -> "StepGrid":
        """For a law of this interval."""
        coarse = max(dt, _FINEST)
        count = 2 * int(_PERIOD / coarse / 2)
        omega = 2 * np.pi * np.arange(1, count // 2) / (count * coarse)
        fade = np.cos(np.linspace(0, np.pi / 2, omega.size)) ** 2
        return cls(coarse, omega, fade if coarse > dt else np.ones(omega.size))

    def band(self, closed: Complex[np.ndarray, "plants frequencies"]) -> StepBand:
        """Of the responses from set-point to rate: median and 95 % of the plants."""
        ends = np.ones((len(closed), 1)), np.zeros((len(closed), 1))
        response = np.concatenate([ends[0], self.fade * closed, ends[1]], axis=1)
        impulse = np.fft.irfft(response, 2 * (self.omega.size + 1), axis=1)
        shown = int(_SHOWN / self.dt)
        low, middle, high = np.percentile(
            np.cumsum(impulse, axis=1)[:, :shown], [2.5, 50.0, 97.5], axis=0
        )
        return StepBand(np.arange(shown) * self.dt, middle, low, high)


def logged_terms(flight: FlightChannels) -> dict[str, float]:
    """Root mean squares of P, I, D and F as they were logged, I without its mean."""
    moved = {name: x - x.mean() if name == "I" else x for name, x in flight.terms.items()}
    return {name: float(np.sqrt(np.mean(x**2))) for name, x in moved.items()}


def computed_terms(flight: FlightChannels, law: RateLoop, axis: int) -> dict[str, float]:
    """Likewise, by the law from set-point and rate."""
    size = min(int(_WINDOW / flight.dt), len(flight.setpoint))
    hertz = np.fft.rfftfreq(size, flight.dt)
    inside = (hertz > 0) & (hertz < 0.4999 / law.dt)
    back, ahead = law_paths(law, axis, 2 * np.pi * hertz[inside])
    places = np.arange(0, len(flight.setpoint) - size + 1, size // 2)[:, None] + np.arange(size)
    taper = np.hanning(size)
    rate = flight.rates[min(axis, len(flight.rates) - 1)]
    r, y = (
        np.fft.rfft((x[places] - x[places].mean(axis=1, keepdims=True)) * taper, axis=1)[:, inside]
        for x in (flight.setpoint, rate)
    )
    terms = {}
    for k, (name, gain) in enumerate(zip("PID", gains_of(law, axis), strict=True)):
        power = np.mean(np.sum(np.abs(gain * (ahead[k] * r - back[k] * y)) ** 2, axis=1))
        terms[name] = float(np.sqrt(2 * power / (size * np.sum(taper**2))))
    return terms


def motor_rows(flight: FlightChannels) -> list[tuple[str, float, float]]:
    """Each motor's shares of samples at the lowest and at the highest command."""
    if flight.motors is None:
        return []
    low, high = flight.motor_ends
    near = _NEAR * (high - low)
    return [
        (f"motor {k + 1}", float(np.mean(x <= low + near)), float(np.mean(x >= high - near)))
        for k, x in enumerate(flight.motors.T)
    ]


def stage_rows(proposal: "AutopilotProposal") -> Table:
    """What each set of gains gives on fresh plants."""
    names = ["what flew", "a third of the way", "all of it"]
    stages = list(proposal.stages)
    levels = () if proposal.throttle is None else proposal.throttle.logged
    if proposal.filters is not None and proposal.filters.flown and proposal.filters.gains_alone:
        names.append("gains alone, filters as flown")
        stages.append(proposal.filters.gains_alone)
    further = lambda x: [  # with the integral held, and of the angle loop
        *([] if x.relaxed is None else [f"{x.relaxed:.2f}"]),
        *([] if x.angle is None else [f"{x.angle.peak:.2f}", f"{x.angle.resonance:.2f}"]),
    ]
    rows: list[list[str | Cell]] = [
        [
            name, f"{100 * x.stable:.1f}", f"{x.peak:.2f}", f"{x.resonance:.2f}",
            f"{x.crossover / (2 * np.pi):.1f}", x.margin_text,
            f"{x.rejection:.2f}", f"{x.noise:.2f}", *further(x),
            *(f"{peak:.2f}" for peak in x.peaks[: len(levels)]),
        ]
        for name, x in zip(names, stages, strict=True)
    ]  # fmt: skip
    first = stages[0]
    heads = (
        "gains", "stable, %", "worst Ms", "worst peak", "crossover, Hz", "delay margin, ms",
        "torque", "noise", *(("Ms, integral held",) if first.relaxed is not None else ()),
        *(("Ms, angle loop", "peak, angle loop") if first.angle is not None else ()),
        *(f"Ms at throttle {level:.2f}" for level in levels),
    )  # fmt: skip
    return Table(f"On {proposal.settings.fresh} fresh plants", heads, rows)


def change_rows(changes: Sequence[ParameterChange], words: Sequence[WordChange] = ()) -> Table:
    """Old, new, unit, range and reason, for the page."""
    rows: list[list[str | Cell]] = [
        [
            Cell(row.name), f"{old:.5g}", f"{new:.5g}", row.unit, row.range_text, reason,
        ]
        for row, old, new, reason in changes
    ]  # fmt: skip
    rows += [[Cell(word.name), word.old, word.new, "", "", word.reason] for word in words]
    heads = ("parameter", "old", "new", "unit", "range", "reason")
    return Table("From what flew to the proposal", heads, rows)
