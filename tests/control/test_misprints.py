"""What the paper prints and what must stand there: docs/equations/misprints.csv lists all."""

import ast
import re
from itertools import permutations
from types import SimpleNamespace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import ROOT
from synthetic import response_of

import jaxquad as jq


# Exponents of (kg m^2, s) of the symbols in Eq. (3)-(23), and a value for each.
UNITS = {
    "tau": (1, -2), "K": (1, -1), "J": (1, 0), "J_y": (1, 0), "J_z": (1, 0), "J_M": (1, 0),
    "J_n": (1, 0), "dJ": (1, 0), "p": (0, -1), "q": (0, -1), "r": (0, -1), "spin": (0, -1),
    "lam": (0, -1), "alpha": (0, -2), "M_c": (1, -2), "M_g": (1, -2), "q0": (0, -1),
    "dq0": (0, -2), "q1": (1, -2), "dq1": (1, -3), "share": (0, 0),
}  # fmt: skip
VALUES = dict(zip(UNITS, np.random.default_rng(0).uniform(1, 2, len(UNITS)), strict=True))
# What the printed and the right form say, and the exponents of the quantity on the left.
FORMS = {
    "(5)": (
        lambda v: (v.tau - v.K * v.p + v.J_M * v.spin + (v.J_y - v.J_z) * v.q * v.r) / v.J,
        lambda v: (v.tau - v.K * v.p + v.J_M * v.q * v.spin + (v.J_y - v.J_z) * v.q * v.r) / v.J,
        (0, -2),
    ),
    "(6)": (
        lambda v: (v.tau - v.K * v.q + v.J_M * v.spin + (v.J_z - v.J) * v.p * v.r) / v.J_y,
        lambda v: (v.tau - v.K * v.q - v.J_M * v.p * v.spin + (v.J_z - v.J) * v.p * v.r) / v.J_y,
        (0, -2),
    ),
    "text after (19)": (
        lambda v: v.J_n * v.dq1 - v.q0,
        lambda v: v.J_n * v.dq0 - v.q1,
        (1, -2),
    ),
    "(20)": (
        lambda v: -v.lam * v.M_c - v.lam * (v.dJ * v.p + v.K * v.J + v.M_g),
        lambda v: -v.lam * v.M_c - v.lam * (v.dJ * v.alpha + v.K * v.p + v.M_g),
        (1, -3),
    ),
    "(21)": (
        lambda v: -v.dJ * v.q0 - v.K * v.q0 + v.M_g * v.q1,
        lambda v: -v.dJ * v.dq0 - v.K * v.q0 - v.M_g * v.share,
        (1, -2),
    ),
    "(23)": (
        lambda v: v.M_c * v.dq0 / v.dq0,
        lambda v: -v.M_c * v.dq0 / v.dq0**2,
        (1, 0),
    ),
}


def keeps_its_value_in_other_units(form, exponents):
    """Whether `form` gives the same quantity in units of 3 kg m^2 and 7 s."""
    factor = lambda powers: 3.0 ** powers[0] * 7.0 ** powers[1]
    other = {name: VALUES[name] * factor(UNITS[name]) for name in UNITS}
    found = form(SimpleNamespace(**other)) / factor(exponents)
    return bool(np.isclose(found, form(SimpleNamespace(**VALUES)), rtol=1e-12))


@pytest.mark.parametrize("name", FORMS)
def test_the_printed_form_depends_on_the_units_and_the_right_one_does_not(name):
    printed, right, exponents = FORMS[name]
    assert not keeps_its_value_in_other_units(printed, exponents)
    assert keeps_its_value_in_other_units(right, exponents)


def test_the_roll_torque_of_rotation_holds_the_other_two_rates_alone():
    """Eq. (3) prints a cross product of roll with roll: nothing, or J_x p^2 if it multiplies."""
    inertia, rate = np.array([0.05, 0.07, 0.11]), np.array([1.0, 2.0, -1.5])
    roll = np.cross(rate, inertia * rate)[0]
    assert roll == pytest.approx(rate[1] * rate[2] * (inertia[2] - inertia[1]))
    assert roll != pytest.approx(0.0) and roll != pytest.approx(inertia[0] * rate[0] ** 2)


NORTH, WEST, UP = np.eye(3)  # the vehicle's front points north
ROTORS = {"front": (NORTH, 1), "left": (WEST, -1), "back": (-NORTH, 1), "right": (-WEST, -1)}
PRINTED = np.array([[0, -1, 0, 1], [1, 0, -1, 0], [1, -1, 1, -1]])  # signs of Eq. (10)
LEVEL = [
    (turned, np.cross(third, turned), third)
    for third in (UP, -UP)
    for turned in (NORTH, WEST, -NORTH, -WEST)
]


def signs(frame, order):
    """Of roll, pitch and yaw torque under more thrust of each rotor; section 5.1's senses."""
    axes = np.stack(frame)
    columns = [
        axes @ np.cross(ROTORS[name][0], UP) - ROTORS[name][1] * (axes @ UP) for name in order
    ]
    return np.stack(columns, axis=1)


def test_eq_10_belongs_to_one_frame_and_one_order_of_the_rotors():
    fits = [
        (frame, order)
        for frame in LEVEL
        for order in permutations(ROTORS)
        if np.array_equal(signs(frame, order), PRINTED)
    ]
    forward = [(frame[2], order) for frame, order in fits if np.array_equal(frame[0], NORTH)]
    [(third, order)] = forward  # the other fits name another arm the front
    assert len(fits) == 4 and order == ("front", "right", "back", "left")
    np.testing.assert_array_equal(third, -UP)


def test_eq_10_has_no_row_for_the_thrust():
    allocation = jq.models.Allocation(0.197, 0.1188, 0.0036)
    assert np.linalg.matrix_rank(allocation.matrix) == 3
    np.testing.assert_allclose(allocation.torque(jnp.full(4, 2.0)), 0.0, atol=1e-16)


def test_the_weight_of_eq_14_is_squared_and_a_decibel_weighs_as_7_57_degrees():
    frf = response_of(jq.LaggedIntegrator(280.0, 0.016, 0.011))
    frf = eqx.tree_at(lambda f: f.coherence, frf, jnp.full(frf.coherence.shape, 0.6))
    ones = np.ones(frf.coherence.shape)
    points = jq.identify.Points(frf, ones > 0, shared=ones, floor=0 * ones)
    weights = jq.identify.CoherenceWeighted().weights(points, ones)
    one_db, one_degree = np.log(10) / 20, np.radians(1.0)
    cost = lambda k, misfit: np.sum((weights[..., k] * misfit) ** 2) / 20
    # Half of a coherent point's weight, as the textbook says; the printed 0.713 is its root.
    assert cost(0, one_db) == pytest.approx(0.508, abs=5e-4)
    assert cost(0, one_db) == pytest.approx((1.58 * (1 - np.exp(-0.6))) ** 2, rel=1e-12)
    assert cost(1, 7.57 * one_degree) == pytest.approx(cost(0, one_db), rel=1e-3)


def printed_14(decibels, degrees):
    return 20 * np.mean(1.58 * (1 - np.exp(-1.0)) * (decibels**2 - 0.01745 * degrees**2))


def test_the_printed_minus_of_eq_14_falls_with_the_square_of_a_wrong_delay():
    omega = np.geomspace(0.3, 12.0, 60)
    costs = [printed_14(0.0, np.degrees(omega * late)) for late in (0.1, 1.0, 10.0)]
    assert costs[0] < 0
    np.testing.assert_allclose(np.array(costs) / costs[0], [1, 100, 10000], rtol=1e-12)


def test_with_phases_within_half_a_turn_the_printed_minus_wants_the_opposite_sign():
    omega = np.geomspace(0.3, 12.0, 60)
    truth = 0.424 / (1j * omega) ** 2 * np.exp(-0.02j * omega)
    rivals = {g: g * truth for g in (1.0, -1.0, 0.9, -0.9)}
    misfit = lambda rival: np.log(rival / truth) * [20 / np.log(10)]
    costs = {
        g: printed_14(misfit(rival).real, np.degrees(np.angle(rival / truth)))
        for g, rival in rivals.items()
    }
    assert min(costs, key=lambda g: costs[g]) == -1.0
    assert costs[1.0] == pytest.approx(0, abs=1e-20) and costs[-1.0] < -10000


def test_four_seconds_are_no_record_of_the_papers_band():
    short = jq.sweep(0.3, 12.0, duration=84.0, sample_rate=50.0, amplitude=1.0)
    [length] = [
        rule for rule in jq.excitation.check_guidelines(short) if rule.rule == "record length"
    ]
    assert length.limit == pytest.approx(4 * 2 * np.pi / 0.3) and length.limit > 20 * 4
    assert length.ok


def test_the_papers_inertia_and_thrust_are_off_by_10_per_cent_in_the_ratio_that_counts():
    found, sheet = np.array([0.0492, 0.1170]), np.array([0.0552, 0.1188])
    np.testing.assert_allclose(100 * (found / sheet - 1), [-10.87, -1.52], atol=0.005)
    ratio = lambda pair: 0.197 * pair[1] / pair[0]
    np.testing.assert_allclose([ratio(sheet), ratio(found)], [0.4240, 0.4685], atol=5e-5)
    assert 100 * (ratio(found) / ratio(sheet) - 1) == pytest.approx(10.5, abs=0.05)


def test_the_reference_inertia_is_that_of_point_masses_at_the_arm_tips():
    arm, mass, motor = 7.75 * 0.0254, jq.models.QUANSER_HOVER.mass / 4, 1.91e-6
    tips = np.array([2, 2, 4]) * (motor + mass * arm**2)
    np.testing.assert_allclose(
        jq.models.QUANSER_HOVER.inertia, tips, rtol=5e-3
    )  # printed to 3 digits
    assert tips[0] == pytest.approx(0.05522, abs=5e-6)


GAIN = 0.197 * 0.1188 / 0.0552  # rad/s^2 per volt of V4 - V2


@pytest.mark.parametrize(
    ("gain", "damping"),
    [(GAIN, -1), (2 * GAIN, -1), (1 / 0.0552, -1), (33.3, -1), (33.4, 0.0), (np.degrees(GAIN), -1),
     (np.degrees(2 * GAIN), 0.018), (np.degrees(1 / 0.0552), 0.06)],
)  # fmt: skip
def test_the_papers_pid_is_stable_from_a_gain_of_33_3_and_damped_by_none(gain, damping):
    """Radians or degrees; voltage difference, voltage of each motor or torque for input."""
    roots = np.roots([1.0, 0.15 * gain, 0.01 * gain, 0.05 * gain])
    pair = roots[np.argmax(roots.imag)]
    if damping < 0:
        assert pair.real > 0
    else:
        assert pair.real < 0 and -pair.real / abs(pair) == pytest.approx(damping, abs=0.005)


def test_every_test_that_the_list_of_misprints_names_exists():
    table = (ROOT / "docs" / "equations" / "misprints.csv").read_text()
    named = re.findall(r"(test_\w+)::(test_\w+)", table)
    files = {path.stem: path.read_text() for path in (ROOT / "tests").rglob("test_*.py")}
    lost = [f"{file}::{name}" for file, name in named if f"def {name}(" not in files.get(file, "")]
    assert len(named) > 40 and lost == []


def test_every_equation_is_at_the_place_that_its_table_names():
    table = (ROOT / "docs" / "equations.md").read_text().partition("Symbols: ")[0]
    for number in range(1, 30):
        inside = [low <= number <= high for low, high in numbers(table)]
        assert any(inside), number
    places = re.findall(r"`([\w/]+\.py):([\w.]+)`", table)
    assert len(places) > 20
    for file, name in places:
        folder = ROOT if file.startswith("tests/") else ROOT / "jaxquad"
        scope = ast.parse((folder / file).read_text()).body
        for part in name.split("."):
            found = [x for x in scope if isinstance(x, DEFINITION) and x.name == part]
            assert found, f"{file}:{name}"
            scope = found[0].body


DEFINITION = (ast.FunctionDef, ast.ClassDef)


def numbers(table):
    """First and last equation of each range such as (5)-(7) and of each single number."""
    rows = [line.split("|")[1] for line in table.splitlines() if line.startswith("| (")]
    pairs = re.findall(r"\((\d+)\)(?:-\((\d+)\))?", " ".join(rows))
    return [(int(first), int(last or first)) for first, last in pairs]
