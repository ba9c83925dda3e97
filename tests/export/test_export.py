"""Controllers as C headers: compiled by gcc and held against the step in JAX."""

import shutil
import subprocess
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_loops import (
    AXES,
    Flight,
    in_c,
    in_jax,
    LADRCS,
    LAWS,
    MAP,
    NOMINAL,
    PIDS,
    PLAIN,
    SCHEDULED,
    signals,
    STRICT,
)  # fmt: skip

from jaxquad.control import AdaptiveLADRC, FuzzyMap, LADRC, PID, RecursiveInertia, ScheduledLADRC
from jaxquad.export import c_header, write_c_header


@pytest.fixture(autouse=True)
def compiler():
    if shutil.which("gcc") is None:
        pytest.skip("no gcc to compile the headers with")


QUICK = {"scheduled LADRC": "float"}  # double for the others; the other precision is slow


def agree(found, expected, precision):
    scale = np.abs(expected).max(axis=0)
    within = 1e-6 if precision == "float" else 1e-12
    assert np.max(np.abs(found - expected) / scale) < within


@pytest.mark.slow
@pytest.mark.parametrize(
    "name, precision",
    [(name, "double") for name in [*LADRCS, *PIDS]]
    + [(name, "float") for name in ("LADRC", "Euler", "order 1, predictive", "PID", "filtered")],
)
def test_the_header_is_the_step(tmp_path, name, precision):
    law = LAWS[name]
    flight = PLAIN._replace(order=getattr(law, "order", 2))
    expected = in_jax(name, precision, flight=flight)
    saturated = np.abs(expected) == np.asarray(law.limit, expected.dtype)
    assert 0 < saturated.mean() < 0.5
    agree(in_c(tmp_path, law, precision, flight=flight)[0], expected, precision)


@pytest.mark.parametrize(
    ("name", "precision"),
    [
        pytest.param(name, kind, marks=[pytest.mark.slow] * (kind != QUICK.get(name, "double")))
        for name in SCHEDULED
        for kind in ("float", "double")
    ],
)
def test_a_header_that_is_told_inertias_is_the_scheduled_step(tmp_path, name, precision):
    law, flight = LAWS[name], Flight(told=True)
    found, b0 = in_c(tmp_path, law, precision, flight=flight)
    told = jnp.asarray(signals()[5]).astype(b0.dtype)
    assert np.ptp(b0) > 0.3
    agree(b0, np.asarray(jax.vmap(law.map)(told)), precision)
    # A b0 that is a rounding away, as exp and log are, makes another rounding error of all else.
    agree(found, in_jax(name, precision, flight=flight, b0=b0.tobytes()), precision)


@pytest.mark.parametrize("name", ["LADRC", "PID", "filtered"])
def test_a_bare_reference_is_two_null_pointers(tmp_path, name):
    flight = Flight(ahead=False)
    expected = in_jax(name, "double", flight=flight)
    agree(in_c(tmp_path, LAWS[name], "double", flight=flight)[0], expected, "double")


def test_what_the_drive_really_gave_is_applied(tmp_path):
    flight = Flight(share=0.9)
    expected = in_jax("LADRC", "double", flight=flight)
    agree(in_c(tmp_path, LAWS["LADRC"], "double", flight=flight)[0], expected, "double")


def test_in_float_it_is_as_close_to_exact_arithmetic_as_a_fused_loop_in_jax(tmp_path):
    exact = in_jax("LADRC", "double")
    own = np.abs(in_jax("LADRC", "float", fused=True) - exact).max()
    assert 1e-6 < own < 1e-3
    assert np.abs(in_c(tmp_path, LAWS["LADRC"], "float")[0] - exact).max() < 1.5 * own


@pytest.mark.parametrize("flags", [("-O0",), ("-ffp-contract=off",), ("-O3", "-march=native")])
@pytest.mark.parametrize("name", ["LADRC", "PID"])
def test_no_optimiser_changes_it(tmp_path, name, flags):
    agree(in_c(tmp_path, LAWS[name], "float", *flags)[0], in_jax(name, "float"), "float")


def test_it_is_cplusplus_too(tmp_path):
    if shutil.which("g++") is None:
        pytest.skip("no g++")
    text = ""
    for k, law in enumerate(LAWS.values()):
        write_c_header(tmp_path / f"law{k}.h", law, name=f"law{k}", axes=AXES)
        text += f'#include "law{k}.h"\n#include "law{k}.h"\n'
    (tmp_path / "all.cpp").write_text(text)
    command = ["g++", "-std=c++11", *STRICT, "-Wno-unused-function", "-c", "all.cpp"]
    subprocess.run(command, cwd=tmp_path, check=True)


def test_the_comment_says_what_it_is_and_the_members_are_the_fields(tmp_path):
    text = c_header(LADRCS["LADRC"], name="roll")
    for part in ("LADRC of order 2 for 3 axes", "wc: [4.0, 3.0, 5.0] rad/s", "0.002 s", "jaxquad",
                 "float kp; /* 1/s^2 */", "float l3;", "#define ROLL_AXES 3"):  # fmt: skip
        assert part in text
    path = write_c_header(tmp_path / "new" / "roll.h", LADRCS["LADRC"], name="roll")
    assert path.read_text() == text and [x.name for x in path.parent.iterdir()] == ["roll.h"]


def test_scalar_gains_need_the_number_of_axes():
    with pytest.raises(ValueError, match="give axes"):
        c_header(LADRC(4.0, 25.0, 0.9))
    assert "_AXES 1\n" in c_header(LADRC(4.0, 25.0, 0.9), axes=1)
    with pytest.raises(ValueError, match=r"axes is 2, but the gains are for \[3\]"):
        c_header(LADRCS["LADRC"], axes=2)


OWN: Any = lambda growth, wanted, given, dt: growth  # of a user


def broken(gain, value):
    return eqx.tree_at(lambda law: getattr(law, gain), LADRCS["LADRC"], jnp.asarray(value))


@pytest.mark.parametrize(
    "controller, message",
    [
        (lambda: SCHEDULED["scheduled LADRC"].scheduled_at(jnp.ones((AXES, 4))), "ensemble"),
        (lambda: broken("b0", [1.0, np.nan, 1.0]), "b0 is nan, which a C float"),
        (lambda: broken("b0", [1.0, 1e300, 1.0]), r"b0 is 1e\+300, which a C float"),
        (lambda: PID([1.0] * 3, 1.0, 1.0, anti_windup=OWN), "anti_windup is .*Clamping"),
        (lambda: ScheduledLADRC(LADRCS["LADRC"], FuzzyMap(NOMINAL, 3.0, [1.0, 2.0], [0.0, 1.0])),
         "FuzzyMap, but only a jq.control.InertiaMap"),
        (lambda: AdaptiveLADRC(LADRCS["LADRC"], RecursiveInertia(jnp.ones(3), NOMINAL), MAP),
         "with your estimate"),
        (lambda: None, "The controller is a NoneType"),
    ],
)  # fmt: skip
def test_what_cannot_be_written_is_refused(controller, message):
    with pytest.raises(ValueError, match=message):
        c_header(controller())


@pytest.mark.parametrize("name", ["", "2fast", "a-b", "_law", "a__b", "größe"])
def test_a_name_that_begins_no_c_identifier_is_refused(name):
    with pytest.raises(ValueError, match="is no C identifier"):
        c_header(LADRCS["LADRC"], name=name)


def test_a_double_header_wants_gains_in_double():
    coarse = jax.tree.map(lambda x: x.astype(jnp.float32), LADRCS["LADRC"])
    with pytest.raises(ValueError, match="is a float32"):
        c_header(coarse, precision="double")
    assert "float kp" in c_header(coarse)
