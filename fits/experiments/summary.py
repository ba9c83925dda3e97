"""From flights to numbers: those of every member, and those of a row of the table."""

from typing import Any

import numpy as np

from jaxquad.simulation import Metrics, metrics, Simulation

from .data import Case, Group, Members, Numbers
from .identification import identification_numbers
from .matching import Matched
from .rows import NEVER, Row
from .theory import theory_rms


_AXES = ("roll", "pitch", "yaw")
_ROOTS = ("rms", "disturbance_rmse")  # averaged as squares


def flight_numbers(case: Case, done: Simulation, dt: float) -> Numbers:
    """Of the first axis, in the table's units; members that crashed have infinite numbers."""
    window = dict(case.data.get("metrics", {}))
    load = window.pop("load", None)
    given = metrics(done, **window)
    loaded = given if load is None else metrics(done, **load)
    numbers = _step_numbers(given) | _load_numbers(loaded)
    if "held" in case.data:
        held = np.asarray(given.peak)[_AXES.index(case.data["held"])]
        size = np.abs(np.asarray(given.step)[0])
        numbers |= {"cross_peak": np.degrees(held), "cross_share": held / size}
    lost = np.asarray(done.diverged)
    numbers = {name: np.where(lost, np.inf, x) for name, x in numbers.items()}
    beyond = np.nan_to_num(np.asarray(given.beyond_authority)[0])
    numbers |= {"unstable": 100.0 * lost, "beyond": 100 * beyond}
    if done.authority is not None:
        held = np.asarray(done.authority.torque)[0]
        numbers["authority"] = np.array(np.broadcast_to(held, lost.shape))
    if "estimate" in case.data and "inertia" in done.signals:
        numbers |= _estimates(case.data["estimate"], done, dt)
    return numbers


def row_of(
    case: Case,
    members: Members,
    group: Group,
    loop: Matched,
    numbers: Numbers,
    suite: dict[str, Any],
) -> Row:
    """One row, of the members of a group."""
    mine = {name: values[group.place] for name, values in numbers.items()}
    found = {name: _mean(name, values) for name, values in mine.items()}
    stepped = not np.all(np.isnan(mine["itae"]))
    found["worst"] = float(np.max(mine["itae" if stepped else "peak"]))
    if stepped:
        found["itae_p95"] = float(np.quantile(mine["itae"], 0.95, method="higher"))
    notes = [_about_loops(mine, found), _about_coupling(case, found), _about_inertia(mine, found)]
    notes += [_about_gain(mine, found), _about_theory(case, members, group, loop, suite, found)]
    infeasible = ""
    if found["beyond"] > suite["infeasible"]:
        infeasible = (
            f"the torque exceeds the drive's {found['authority']:.3g} N m in "
            f"{found['beyond']:.3g} % of the time"
        )
    note = "; ".join(text for text in notes if text)
    return Row(case, group.label, loop.design.name, found, infeasible, note, group.shown)


def _step_numbers(given: Metrics) -> Numbers:
    normal = given.normalised()
    never = np.asarray(given.stepped)[0] & np.isnan(np.asarray(given.settling_time)[0])
    return {
        "itae": np.asarray(normal.itae)[0],
        "overshoot": np.asarray(given.overshoot)[0],
        "settling_time": np.where(never, NEVER, np.asarray(given.settling_time)[0]),
        "saturation": 100 * np.asarray(given.saturation_share)[0],
        "square_changes": np.asarray(given.activity)[0],
    }


def _load_numbers(given: Metrics) -> Numbers:
    return {
        "peak": np.degrees(np.asarray(given.peak)[0]),
        "rms": np.degrees(np.asarray(given.rms)[0]),
        "disturbance_rmse": 1e3 * np.asarray(given.disturbance_rmse)[0],
    }


def _estimates(asked: dict[str, float], done: Simulation, dt: float) -> Numbers:
    """Error of the estimated inertia, and the time from a change until it stays right."""
    error = np.asarray(done.signals["inertia"])[:, 0] / asked["inertia"] - 1
    first, last, changed = (round(asked[name] / dt) for name in ("from", "to", "changed"))
    wrong = np.abs(error[changed:last]) > asked["within"]
    still = len(wrong) - np.argmax(wrong[::-1], axis=0)  # samples up to the last wrong one
    time = np.where(wrong[-1], np.inf, dt * np.where(wrong.any(axis=0), still, 0))
    return {"inertia_error": error[first:last].mean(axis=0), "time_to_estimate": time}


def _mean(name: str, values: np.ndarray) -> float:
    """Over the members that did not crash; infinite if all did."""
    kept = values[np.isfinite(values)]
    if not len(kept):
        return float(values[0])
    if name == "settling_time":
        return float(np.max(kept))
    return float(np.sqrt(np.mean(kept**2)) if name in _ROOTS else np.mean(kept))


def _about_loops(mine: Numbers, found: dict[str, float]) -> str:
    if "sensitivity" not in mine:
        return ""
    worst = found["sensitivity_worst"] = float(np.max(mine["sensitivity"]))
    return f"Ms up to {worst:.3g}" if np.isfinite(worst) else "Ms without bound"


def _about_coupling(case: Case, found: dict[str, float]) -> str:
    return f"{case.data['held']} up to {found['cross_peak']:.3g} deg" if "held" in case.data else ""


def _about_inertia(mine: Numbers, found: dict[str, float]) -> str:
    if "inertia_error" not in mine:
        return ""
    errors, times = mine["inertia_error"], mine["time_to_estimate"]
    found["inertia_bias"], found["inertia_sd"] = abs(float(np.mean(errors))), float(np.std(errors))
    found["time_to_estimate"] = float(np.median(times))
    late = int(np.sum(np.isinf(times)))
    worst = f"not at all in {late} of {len(times)}" if late else f"at worst {np.max(times):.3g} s"
    return (
        f"Jhat {100 * np.mean(errors):+.2g} % +- {100 * np.std(errors):.2g} %, right to 10 % after "
        f"{np.median(times):.3g} s, {worst}"
    )


def _about_gain(mine: Numbers, found: dict[str, float]) -> str:
    if "gain_error" not in mine:
        return ""
    numbers = identification_numbers(mine)
    found |= numbers
    return (
        f"b {100 * numbers['mean_error']:+.2g} % +- {100 * numbers['scatter']:.2g} %, "
        f"95 % intervals hold it {numbers['covered']:.0%}"
    )


def _about_theory(
    case: Case,
    members: Members,
    group: Group,
    loop: Matched,
    suite: dict[str, Any],
    found: dict[str, float],
) -> str:
    if "theory" not in case.data:
        return ""
    expected = theory_rms(case, members, group, loop.design, suite)
    if not np.isfinite(expected):
        found["theory_error"] = np.inf
        return "linear theory: no steady state"
    found["theory_error"] = abs(found["rms"] / expected - 1)
    return f"linear theory {expected:.3g} deg rms"
