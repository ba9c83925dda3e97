"""Cases without a flight: numbers of linear loops (S0) and maps of their stability (S6)."""

from typing import Any

import numpy as np

from jaxquad.control import LADRC
from jaxquad.loops import LoopAnalysis

from .data import Case
from .designs import b0_of, controller, Design
from .linear import analysed, Late, stable_gains
from .matching import Matched
from .members import plain
from .nominal import nominal_belief, nominal_loops, WIDTH
from .rigs import lateness, linear_axis, LONGEST_DELAY
from .rows import Row, with_loop
from .theory import integral_gain


def loop_rows(case: Case, suite: dict[str, Any], loops: dict[str, Matched]) -> list[Row]:
    """S0: poles, margins and windows of every design's nominal loop."""
    level, dt = suite["plants"][case.data["plant"]], suite["dt"]
    rows = []
    for name in case.data.get("designs", list(loops)):
        design = loops[name].design
        found = nominal_loops(design, level, dt).member(0)
        numbers = _numbers(found) | _window(design, level, dt)
        numbers["ki"] = integral_gain(found, float(nominal_belief(level).inertia[0, 0]))
        parity = _placement_error(found, design, level)
        numbers |= {} if parity is None else {"placement_error": parity}
        row = Row(case, "", name, numbers, note=_note(numbers))
        rows.append(with_loop(row, loops[name]))
    return rows


def map_rows(case: Case, suite: dict[str, Any], loops: dict[str, Matched]) -> list[Row]:
    """S6: every design over lags and delays, and the limit of lag * wc for any b0."""
    lags, lates = np.array(case.data["lags"]), np.array(case.data["delays"])
    rows = []
    for name in case.data.get("designs", list(loops)):
        growth = growth_map(loops[name].design, case, suite)
        ends = boundary(growth, lags)
        counted = growth[lags <= case.data["longest_lag"] + 1e-9]
        numbers = {"stable_share": float(np.mean(counted < 0))}
        numbers |= {f"lag_limit_at_{1e3 * d:g}_ms": end for d, end in zip(lates, ends, strict=True)}
        texts = [f"{1e3 * end:.0f} at {1e3 * d:g}" for d, end in zip(lates, ends, strict=True)]
        note = f"stable to a lag, in ms, of {', '.join(texts[::2])} ms delay"
        rows.append(with_loop(Row(case, "", name, numbers, note=note), loops[name]))
    known = zip(case.data["any_b0"], case.data["known_limits"], strict=True)
    return rows + [_limit_row(case, suite, ratio, limit) for ratio, limit in known]


def growth_map(design: Design, case: Case, suite: dict[str, Any]) -> np.ndarray:
    """Abscissa in 1/s, [lags, delays]."""
    level, dt = suite["plants"][case.data["plant"]], suite["dt"]
    lag, late = np.meshgrid(case.data["lags"], case.data["delays"], indexing="ij")
    law = controller(plain(design), nominal_belief(level), dt=dt)
    found = np.empty(lag.size)
    for first in range(0, lag.size, WIDTH):
        place = np.minimum(np.arange(first, first + WIDTH), lag.size - 1)
        axis = linear_axis(level, WIDTH, {"lag": lag.ravel()[place]})
        loops = analysed(axis, law, Late(late.ravel()[place], LONGEST_DELAY))
        found[place] = np.asarray(loops.abscissa)
    return found.reshape(lag.shape)


def boundary(growth: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """The lag at which each delay's loop turns unstable, between grid points; s.

    0 if it is unstable at the shortest lag, the longest one if it never is.
    """
    ends = []
    for column in growth.T:
        lost = np.flatnonzero(column >= 0)
        if not lost.size:
            ends.append(float(lags[-1]))
        elif lost[0] == 0:
            ends.append(0.0)
        else:
            k = int(lost[0])
            share = -column[k - 1] / (column[k] - column[k - 1])
            ends.append(float(lags[k - 1] + share * (lags[k] - lags[k - 1])))
    return np.array(ends)


def _limit_row(case: Case, suite: dict[str, Any], ratio: float, known: float) -> Row:
    """The lag beyond which LADRC with wo = ratio * wc is stable for no b0."""
    level, dt, wc = suite["plants"][case.data["plant"]], suite["dt"], 10.0
    products = np.linspace(0.3, 0.6, WIDTH)
    wide = np.ones((1, WIDTH))
    law = LADRC(
        wc * wide, ratio * wc * wide, wide, feedback_factor=wide, observer_factor=wide,
        limit=level["limit"] * wide, dt=dt,
    )  # fmt: skip
    axis = linear_axis(level, WIDTH, {"lag": products / wc})
    late = Late(np.zeros(WIDTH), LONGEST_DELAY)
    exists = np.isfinite(stable_gains(axis, law, late)[0])
    limit = float(products[exists].max(initial=0.0))
    numbers = {"lag_times_wc": limit, "limit_error": abs(limit - known)}
    note = f"no b0 for lag * wc above {limit:.2f}; known: {known:.2f}"
    return Row(case, f"wo/wc {ratio:g}", "LADRC, any b0", numbers, note=note)


def _numbers(found: LoopAnalysis) -> dict[str, float]:
    poles = found.poles
    return {
        "stable": float(found.stable),
        "slowest_pole": float(poles[0].real),
        "gain_margin": float(found.gain_margin),
        "gain_reduction": float(found.gain_reduction),
        "phase_margin_deg": float(np.degrees(found.phase_margin)),
        "delay_margin_ms": 1e3 * float(found.delay_margin),
        "rejection_bandwidth": float(found.rejection_bandwidth),
    }


def _window(design: Design, level: dict[str, Any], dt: float) -> dict[str, float]:
    belief = nominal_belief(level)
    law = controller(plain(design), belief, dt=dt)
    edges = stable_gains(linear_axis(level, WIDTH, {}), law, lateness(level, WIDTH))
    unit = belief.gain if design.law == "pid" else b0_of(design, belief)
    low, high = (float(edge[0] / unit[0, 0]) for edge in edges)
    return {"window_low": low, "window_high": high}


def _placement_error(found: LoopAnalysis, design: Design, level: dict[str, Any]) -> float | None:
    """Largest error of the characteristic polynomial where poles were placed on this very plant."""
    if design.law != "ladrc" or "lag" in level or design.data.get("b0") != 1.0:
        return None
    if design.data.get("feedback_factor", 1.0) != 1.0:
        return None
    wc, wo = (design.gains[name] for name in ("wc", "wo"))
    wanted = np.poly(np.exp(-found.dt * np.array([wc, wc, wo, wo, wo])))
    return float(np.max(np.abs(np.poly(np.asarray(found.closed.matrix)) - wanted)))


def _note(numbers: dict[str, float]) -> str:
    window = f"b/b0 {numbers['window_low']:.3g} to {numbers['window_high']:.3g}"
    if not numbers["stable"]:
        return f"grows as exp({numbers['slowest_pole']:.3g} t); stable for {window}"
    return (
        f"slowest pole {numbers['slowest_pole']:.3g} rad/s, gain x{numbers['gain_margin']:.3g} "
        f"and x{numbers['gain_reduction']:.3g}, PM {numbers['phase_margin_deg']:.3g} deg, "
        f"delay margin {numbers['delay_margin_ms']:.3g} ms, ki {numbers['ki']:.3g} /s^3, {window}"
    )
