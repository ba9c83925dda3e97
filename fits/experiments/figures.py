"""Figures of the suite: what noise costs, where loops end, and a payload."""

from typing import Any

import numpy as np

from jaxquad.plot import histories

from .data import Case, cases, members_of
from .flights import believed, chunk_of, flown, key_of
from .loops import boundary, growth_map
from .matching import Matched
from .rows import Row


_STYLES = (
    ("black", "-", "o"), ("tab:purple", (0, (4, 1)), "P"), ("tab:blue", "--", "s"),
    ("0.55", "-", "x"), ("tab:red", "-.", "^"),
    ("tab:green", (0, (1, 1.2)), "D"), ("0.35", (0, (6, 1, 1, 1)), "v"),
)  # fmt: skip
_COMPARED = ("tuned PID", "tuned PID, filtered y", "LADRC, b0 = KT/Jhat", "adaptive LADRC")


def draw(
    suite: dict[str, Any],
    loops: dict[str, dict[str, Matched]],
    rows: list[Row],
    *,
    quick: bool,
    seed: int,
) -> dict[str, Any]:
    """The figures that the scenarios of these rows allow, by file name."""
    ran = {row.case.scenario for row in rows}
    drawn = {}
    if {"S6", "S7"} <= ran:
        drawn["trade_offs.png"] = trade_offs(suite, loops["B"], rows)
    if "S5" in ran:
        [case] = cases(suite, ("S5",))
        drawn["payload.png"] = payload(case, suite, loops["B"], quick=quick, seed=seed)
    return drawn


def trade_offs(suite: dict[str, Any], loops: dict[str, Matched], rows: list[Row]) -> Any:
    """S7: changes of the command against ITAE; S6: the longest lag at each delay."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.5, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    styles = dict(zip(loops, _STYLES, strict=True))
    for name, (colour, line, marker) in styles.items():
        costs, changes, own = _pareto(rows, name)
        look = {"color": colour, "linestyle": line}
        left.plot(changes, costs, label=name, marker=marker, markersize=4, **look)
        left.plot(*own, marker=marker, markersize=9, color=colour, fillstyle="none")
    left.set(xscale="log", yscale="log", xlabel="sum of squared changes of u in 10 s, V$^2$")
    left.set(ylabel="ITAE of a unit step, s$^2$")
    left.set_title("wo (PID: filter) x 0.5 to 2; large mark: matched", fontsize=9)
    [case] = cases(suite, ("S6",))
    lags, late = np.array(case.data["lags"]), 1e3 * np.array(case.data["delays"])
    for name, (colour, line, marker) in styles.items():
        ends = 1e3 * boundary(growth_map(loops[name].design, case, suite), lags)
        right.plot(
            late,
            np.where(ends < 1e3 * lags[-1], ends, np.nan),
            marker=marker,
            markersize=4,
            color=colour,
            linestyle=line,
        )
    right.plot(*_nominal(suite), marker="*", markersize=12, color="black", linestyle="none")
    right.annotate("plant B", _nominal(suite), xytext=(6, 6), textcoords="offset points")
    right.set(xlabel="delay, ms", ylabel="lag, ms", yscale="log", xlim=(0, late[-1]))
    right.set_yticks([10, 20, 50, 100, 200, 400], ["10", "20", "50", "100", "200", "400"])
    right.set_title("a loop is unstable above its line", fontsize=9)
    for axis in (left, right):
        axis.grid(True, which="major", color="0.92", lw=0.5)
    figure.legend(loc="outside lower center", ncols=3, fontsize=9, handlelength=3.5)
    return figure


def payload(
    case: Case, suite: dict[str, Any], loops: dict[str, Matched], *, quick: bool, seed: int
) -> Any:
    """S5 under the sine: the angle of three designs, and the estimate of the inertia."""
    members = members_of(case, quick=quick, seed=seed)
    chunk = chunk_of(members, 0)
    member = int(np.flatnonzero(chunk.of("sine") > 0)[0])
    belief, truth = believed(case, chunk, suite)
    key = key_of(case, seed, 0)
    angles, inertias = {}, {}
    for name in _COMPARED:
        done = flown(case, chunk, suite, loops[name].design, belief, truth, key)
        angles[name] = np.degrees(np.asarray(done.angle)[:, 0, member])
        if "inertia" in done.signals:
            inertias[name] = np.asarray(done.signals["inertia"])[:, 0, member]
    target = "set-point, true inertia"
    angles[target] = np.degrees(np.asarray(done.reference)[:, 0, member])
    assert done.scenario.payload is not None
    carried = np.asarray(done.scenario.payload)[:, 0, member]
    inertias[target] = truth.inertia[0, member] + carried
    panels = {"roll, deg": angles, "inertia, kg m$^2$": inertias}
    title = "payload J0 to 2 J0 from 15 to 30 s, under 0.3 N m of torque with a period of 5 s"
    return histories(done.time, panels, target=target, title=title).figure


def _pareto(rows: list[Row], design: str) -> tuple[list[float], list[float], tuple[float, float]]:
    """ITAE and changes of the command along the bandwidths, at 0.02 deg; those of the matched."""
    mine = [
        row for row in rows
        if row.case.scenario == "S7" and row.design == design and "noise 0.02" in row.label
    ]  # fmt: skip
    mine.sort(key=lambda row: row.numbers["square_changes"])
    pairs = [(row.numbers["square_changes"], row.numbers["itae"]) for row in mine]
    [own] = [pair for pair, row in zip(pairs, mine, strict=True) if row.shown]
    return [y for _, y in pairs], [x for x, _ in pairs], own


def _nominal(suite: dict[str, Any]) -> tuple[float, float]:
    level = suite["plants"]["B"]
    return 1e3 * level["delay"], 1e3 * level["lag"]
