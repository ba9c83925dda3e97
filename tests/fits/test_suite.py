"""The scenario suite: its data, the matching of its designs, and laws that its rows obey."""

import functools as ft
import importlib
import sys
from types import SimpleNamespace

import jax
import numpy as np
import pytest
from conftest import ROOT
from scipy.linalg import solve_discrete_lyapunov


_MODULES = (
    "suite",
    "data",
    "rigs",
    "signals",
    "designs",
    "matching",
    "nominal",
    "pid_shape",
    "flights",
    "loops",
    "rows",
)


@pytest.fixture(scope="module")
def fits():
    """The modules of fits/, by their short names."""
    sys.path.insert(0, str(ROOT / "fits"))
    try:
        names = [name if name == "suite" else f"experiments.{name}" for name in _MODULES]
        found = [importlib.import_module(name) for name in names]
    finally:
        sys.path.remove(str(ROOT / "fits"))
    return SimpleNamespace(**dict(zip(_MODULES, found, strict=True)))


@pytest.fixture(scope="module")
def data(fits):
    return fits.data.load()


@pytest.fixture(scope="module")
def loops(fits, data):
    return fits.matching.match(data, "A")


def altered(fits, data, scenario, name, **changes):
    [case] = [c for c in fits.data.cases(data, (scenario,)) if c.name == name]
    return case._replace(data=case.data | changes)


def test_the_suite_has_the_scenarios_s0_to_s11_and_seven_designs(data):
    assert list(data["scenarios"]) == [f"S{k}" for k in range(12)]
    assert len(data["designs"]) == 7
    assert all(scenario["purpose"] for scenario in data["scenarios"].values())


@pytest.mark.slow
def test_every_case_builds_its_rig_its_signals_and_every_controller(fits, data):
    designs = [
        fits.designs.Design(
            name,
            x,
            {"wc": 2.0, "wo": 20.0, "pole": 2.0, "filter": 10.0, "damping": 0.5, "ratio": 1.0},
        )
        for name, x in data["designs"].items()
    ]
    width = fits.nominal.WIDTH
    for case in fits.data.cases(data):
        members = fits.data.members_of(case, quick=True, seed=0)
        assert sum(len(group.place) for group in members.groups) == members.count
        if case.kind != "flight":
            continue
        chunk = fits.flights.chunk_of(members, 0)
        belief, truth = fits.flights.believed(case, chunk, data)
        for design in designs:
            fits.designs.controller(design, belief, dt=data["dt"])
        signals = ft.partial(
            fits.signals.scenario_of, case, chunk, dt=data["dt"], axes=len(truth.torque_gain)
        )
        happening = jax.eval_shape(lambda key, build=signals: build(key=key), jax.random.key(0))
        samples = round(case.data["duration"] / data["dt"])
        assert happening.reference.shape == (samples, len(truth.torque_gain), width)
        assert happening.ensemble == (width,)


def test_members_are_every_combination_with_the_same_draws(fits, data):
    case = altered(fits, data, "S4", "Jhat known", quick=3)
    members = fits.data.members_of(case, quick=True, seed=1)
    inertia = members.of("J").reshape(3, 3)
    assert members.count == 9
    assert np.array_equal(inertia[0], inertia[1])
    assert np.all((inertia > 0.5) & (inertia < 3.0))
    assert [group.label for group in members.groups] == ["error 0", "error 0.1", "error 0.2"]


def test_misspelt_data_are_refused(fits, data, tmp_path):
    text = fits.data.SOURCE.read_text()
    for good, bad, message in (
        ('held = "yaw"', 'hold = "yaw"', "hold"),
        ('plant = "C"', 'plant = "D"', "no plant"),
        ('only = ["adaptive LADRC"]', 'only = ["adaptive"]', "no design"),
        ("{ quantity = \"rms\", at_most", "{ quantity = \"rms\", at_mots", "at_mots"),
    ):  # fmt: skip
        path = tmp_path / "scenarios.toml"
        path.write_text(text.replace(good, bad))
        with pytest.raises(ValueError, match=message):
            fits.data.load(path)
    with pytest.raises(ValueError, match="no scenario"):
        fits.data.cases(data, ("S12",))


def test_a_pair_of_equations_is_solved_within_its_bounds(fits):
    # ln Ms = x + y, ln activity = x y: of the two solutions only one has y >= x.
    numbers = lambda logs: np.stack([logs[0] + logs[1], logs[0] * logs[1]])
    found = fits.matching.solve(numbers, np.array([3.0, 2.0]), np.array([[0.0, 4.0], [0.0, 4.0]]))
    assert found == pytest.approx([1.0, 2.0], abs=1e-6)


@pytest.mark.slow
def test_every_family_meets_the_common_targets(data, loops):
    targets = data["targets"]
    free = [
        loop for loop in loops.values() if "free" in loop.design.data or "as" in loop.design.data
    ]
    assert len(free) == 6
    for loop in free:
        assert loop.matched
        assert loop.sensitivity_peak == pytest.approx(targets["sensitivity_peak"]["A"], rel=0.005)
        assert loop.activity == pytest.approx(targets["activity"], rel=0.005)


@pytest.mark.slow
def test_the_printed_design_is_not_matched_and_says_what_it_reaches(loops):
    printed = loops["paper's LADRC, as printed"]
    assert not printed.matched
    assert printed.sensitivity_peak == pytest.approx(7.1, rel=0.01)


def textbook(gains):
    """kp, ki, kd of a PID on 1/s^2 from the poles that its gains place."""
    pole, damping = gains["pole"], gains["damping"]
    pair = pole * (-damping + 1j * np.sqrt(1 - damping**2))
    kd, kp, ki = np.poly([-gains["ratio"] * pole, pair, np.conj(pair)])[1:].real
    return kp, ki, kd, gains["filter"]


def by_hand(gains, dt):
    """Sampled double integrator and PID in units of b u: x+ = matrix x + noise n + step r.

    x = angle, rate, integral, filtered rate; u = sent x - through n.
    """
    kp, ki, kd, filter = textbook(gains)
    keep = np.exp(-dt * filter)
    sharp = (1 - keep) / dt
    row, through = np.array([1.0, kd]), kp + ki * dt / 2 + kd * sharp
    entry = np.array([ki * dt, (keep - 1) * sharp])
    drive = np.array([dt**2 / 2, dt])
    top = np.hstack([[[1, dt], [0, 1]] - np.outer(drive, [through, 0]), -np.outer(drive, row)])
    matrix = np.vstack([top, np.hstack([np.outer(entry, [1, 0]), np.diag([1.0, keep])])])
    noise = np.concatenate([-drive * through, entry])
    step = np.concatenate([drive * ki * dt / 2, [-ki * dt, 0.0]])
    return matrix, noise, step, -np.concatenate([[through, 0], row]), through


@pytest.mark.slow
def test_the_matched_pid_has_that_ms_and_that_activity_by_its_textbook_form(data, loops):
    dt, gains = data["dt"], loops["tuned PID"].design.gains
    kp, ki, kd, filter = textbook(gains)
    keep = np.exp(-dt * filter)
    z = np.exp(1j * dt * np.geomspace(0.1, 100.0, 40001))
    plant = dt**2 / 2 * (z + 1) / (z - 1) ** 2
    law = kp + ki * dt / 2 * (z + 1) / (z - 1) + kd * (1 - keep) / dt * (z - 1) / (z - keep)
    peak = np.abs(1 / (1 + plant * law)).max()
    assert peak == pytest.approx(data["targets"]["sensitivity_peak"]["A"], rel=1e-4)
    matrix, noise, _, sent, through = by_hand(gains, dt)
    power = sent @ solve_discrete_lyapunov(matrix, np.outer(noise, noise)) @ sent + through**2
    assert np.sqrt(power) == pytest.approx(data["targets"]["activity"], rel=1e-4)


@pytest.mark.slow
def test_the_step_of_the_matched_pid_overshoots_as_far_as_it_may(data, loops):
    matrix, _, step, *_ = by_hand(loops["tuned PID"].design.gains, data["dt"])
    state, highest = np.zeros(4), 0.0
    for _ in range(4000):
        state = matrix @ state + step
        highest = max(highest, state[0])
    # Both are within 1e-4 of the peak in continuous time.
    allowed = data["designs"]["tuned PID"]["shape"]["overshoot"]
    assert highest - 1 == pytest.approx(allowed, abs=2e-4)


@pytest.mark.slow
def test_no_other_shape_of_a_pid_has_more_integral_gain_at_the_same_targets(fits, data, loops):
    design = loops["tuned PID"].design
    names = ("pole", "filter", "damping", "ratio")
    best = np.log([design.gains[name] for name in names])
    triple = dict(design.data)
    del triple["shape"]
    altered = data | {"designs": {"PID": triple}}
    before = fits.matching.match(altered, "A")["PID"].design.gains
    assert design.gains["ratio"] * design.gains["pole"] ** 3 > 2 * before["pole"] ** 3

    angle = 2 * np.pi * np.arange(8) / 8
    logs = best[:, None] + np.vstack([np.zeros((2, 8)), 0.05 * np.cos(angle), 0.05 * np.sin(angle)])
    goal = np.log([data["targets"]["sensitivity_peak"]["A"], data["targets"]["activity"]])
    aside = 1e-4 * np.eye(4)[:, :2]
    for _ in range(5):
        tried = [logs, logs + aside[:, :1], logs + aside[:, 1:]]
        gains = dict(zip(names, np.exp(np.hstack(tried)), strict=True))
        found, reached = fits.nominal.loops_at(design, data["plants"]["A"], data["dt"], gains)
        now, *moved = np.split(reached, 3, axis=1)
        slopes = np.stack([(x - now) / 1e-4 for x in moved], axis=-1)  # [2, 8, 2]
        change = np.linalg.solve(slopes.transpose(1, 0, 2), (goal[:, None] - now).T[..., None])
        over = fits.pid_shape.overshoot(found.reference)[:8]
        ends = logs
        logs = logs + np.vstack([change[..., 0].T, np.zeros((2, 8))])
    assert np.abs(now - goal[:, None]).max() < 1e-6
    more = 3 * ends[0] + ends[3] > 3 * best[0] + best[3]
    assert more.any()
    assert np.all(over[more] > data["designs"]["tuned PID"]["shape"]["overshoot"])


@pytest.mark.slow
def test_a_linear_loop_answers_steps_of_all_sizes_alike(fits, data, loops):
    chosen = ["LADRC, b0 = KT/Jhat", "half-gain LADRC"]
    case = altered(fits, data, "S1", "A", designs=chosen)
    rows = fits.flights.fly(case, data, loops, quick=True, seed=0)
    assert [row.label for row in rows[::2]] == ["step 1 to 4", "step 0 to 1", "step 0 to 0.3"]
    assert all(row.numbers["variation"] < 1e-9 and row.verdict == "pass" for row in rows)


@pytest.mark.slow
def test_a_pulse_beyond_the_drive_is_called_infeasible(fits, data, loops):
    [case] = [c for c in fits.data.cases(data, ("S2",)) if c.name.startswith("2.5")]
    case = case._replace(data=case.data | {"duration": 10.0, "designs": ["LADRC, b0 = KT/Jhat"]})
    held, beyond = fits.flights.fly(case, data, loops, quick=True, seed=0)
    assert not held.infeasible
    assert beyond.verdict.startswith("infeasible") and "50 %" in beyond.verdict


@pytest.mark.slow
def test_a_mark_that_no_row_can_meet_is_an_error(fits, data, loops):
    case = altered(fits, data, "S0", "A", marks=[{"quantity": "stabel", "at_least": 1.0}])
    row = fits.rows.Row(case, "", "tuned PID", {"stable": 1.0})
    with pytest.raises(ValueError, match="stabel"):
        fits.rows.require_marked_quantities([row])


def test_verdicts_and_cells_say_what_failed_and_what_is_missing(fits, data):
    marks = [{"quantity": "peak", "at_most": 5.0}, {"quantity": "itae", "at_most": 1.0}]
    case = altered(fits, data, "S0", "A", marks=marks)
    row = fits.rows.Row(case, "", "tuned PID", {"peak": 6.25, "itae": float("nan")})
    assert row.verdict == "FAIL: peak 6.25 > 5; itae - > 1"
    assert row._replace(numbers={"peak": 4.0}).verdict == "pass"
    unstable = row._replace(numbers={"peak": 4.0, "sensitivity_peak": float("inf")})
    assert unstable.verdict == "FAIL: the linear loop is unstable"
    texts = [fits.rows.shown(x, 3) for x in (float("nan"), float("inf"), fits.rows.NEVER, 0.0)]
    assert texts == ["-", "lost", "never", "0"]


def test_a_stability_boundary_lies_between_the_lags_where_the_abscissa_changes_sign(fits):
    lags = np.array([0.01, 0.02, 0.03])
    growth = np.array([[-1.0, -1.0, 1.0], [-1.0, -0.5, 2.0], [3.0, -0.1, 3.0]])
    assert fits.loops.boundary(growth, lags) == pytest.approx([0.0225, 0.03, 0.0])
