"""Exported controllers under samples that are not finite: compiled, and run on recorded signals."""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
from c_loops import AXES, LAWS, NOMINAL, SCHEDULED, signals, STRICT

from jaxquad.control import LADRC, PID
from jaxquad.export import c_header, Gain, Source, write_c_header


NAMES = list(LAWS)
OPTIONS = {"strict": ["-O2"], "fast": ["-Ofast"]}  # -Ofast assumes that no number is a NaN
BAD = np.array([np.nan, -np.nan, np.inf, -np.inf], np.float32)
SAMPLES, AXIS = 400, 1
HUGE, DENORMAL = np.float32(3e38), np.float32(1e-42)

_DRIVER = """
#include <stddef.h>
#include "law$.h"
void run$(int n, int ahead, const float *now, const float *start, float *command)
{
    law$_state state;
    law$_init(&state);
    START
    for (int k = 0; k < n; ++k, now += 15, command += 3) {
        TOLD
        law$_step(&state, now, ahead ? now + 3 : NULL, ahead ? now + 6 : NULL, now + 9, command);
    }
}
"""


@pytest.fixture(scope="module", params=OPTIONS)
def library(request, tmp_path_factory):
    if shutil.which("gcc") is None:
        pytest.skip("no gcc to compile the headers with")
    folder = tmp_path_factory.mktemp("laws")
    text = ""
    for k, name in enumerate(NAMES):
        write_c_header(folder / f"law{k}.h", LAWS[name], name=f"law{k}", axes=AXES)
        begins = f"law{k}_init_at" in (folder / f"law{k}.h").read_text()
        start = "law$_init_at(&state, start);" if begins else "(void)start;"
        told = "law$_schedule(&state, now + 12);" if name in SCHEDULED else ""
        text += _DRIVER.replace("START", start).replace("TOLD", told).replace("$", str(k))
    (folder / "laws.c").write_text(text)
    flags = [*STRICT, "-Wno-unused-function", *OPTIONS[request.param]]
    compiled = ["gcc", "-std=c99", *flags, "-fPIC", "-c", "laws.c", "-o", "laws.o"]
    # Linked without -Ofast, which would have this whole process flush denormals to zero.
    linked = ["gcc", "-shared", "laws.o", "-o", "laws.so", "-lm"]
    for command in (compiled, linked):
        subprocess.run(command, cwd=folder, check=True)
    loaded = ctypes.CDLL(str(folder / "laws.so"))
    assert np.nextafter(0.0, 1.0) * np.ones(1) > 0
    return loaded


@pytest.fixture(params=NAMES)
def run(request, library):
    """The commands [samples, axes] of a law on samples [samples, 5, axes]."""
    function = getattr(library, f"run{NAMES.index(request.param)}")

    def commands(samples, *, start=(0, 0, 0), ahead=True):
        now = np.ascontiguousarray(samples, np.float32)
        found = np.zeros((len(now), AXES), np.float32)
        begin = np.asarray(start, np.float32)
        pointers = (ctypes.c_void_p(x.ctypes.data) for x in (now, begin, found))
        function(len(now), int(ahead), *pointers)
        return found

    return commands


def recorded():
    """Set-point, its rate and acceleration, measurement, inertia: [samples, 5, axes]."""
    reference, rate, acceleration, noise, _, inertia = signals()[:, 45 : 45 + SAMPLES]
    measurement = 0.6 * reference + noise
    return np.stack([reference, rate, acceleration, measurement, inertia], 1).astype(np.float32)


@pytest.mark.slow
@pytest.mark.parametrize("ahead", [True, False])
@pytest.mark.parametrize("at", [0, 7, 60])
def test_a_sample_that_is_not_finite_is_as_if_it_had_not_been_taken(run, at, ahead):
    # The derivatives of the set-point are read only where they are given.
    for signal in (0, 1, 2, 3) if ahead else (0, 3):
        spoilt = np.insert(recorded(), at, recorded()[at], axis=0)
        spoilt[at, signal, AXIS] = BAD[signal]
        found, clean = run(spoilt, ahead=ahead), run(recorded(), ahead=ahead)
        without = np.delete(found, at, axis=0)
        assert np.array_equal(without[:, AXIS], clean[:, AXIS])
        assert found[at, AXIS] == (clean[at - 1, AXIS] if at else 0)


@pytest.mark.slow
def test_an_axis_is_not_touched_by_the_bad_samples_of_another(run):
    spoilt = recorded()
    spoilt[30:90, 3, AXIS] = np.nan
    others = [axis for axis in range(AXES) if axis != AXIS]
    assert np.array_equal(run(spoilt)[:, others], run(recorded())[:, others])


def test_no_bits_of_a_sample_make_a_command_that_is_not_finite(run):
    rng = np.random.default_rng(3)
    for kind in ("any bits", "huge", "denormal"):
        samples = recorded()
        spoil = rng.random(samples.shape) < 0.2
        values = rng.integers(0, 2**32, samples.shape, np.uint32).view(np.float32)
        values = {"huge": HUGE * np.sign(samples), "denormal": DENORMAL}.get(kind, values)
        found = run(np.where(spoil, values, samples))
        assert np.isfinite(found).all()


def test_denormal_samples_are_zeros(run):
    samples = recorded()
    samples[:, :4] = 0
    denormal = samples.copy()
    denormal[:, :4] = DENORMAL
    assert np.abs(run(denormal) - run(samples)).max() < 1e-30


def test_a_start_that_is_not_finite_is_angle_zero(run):
    assert np.array_equal(run(recorded(), start=BAD[:3]), run(recorded()))


def test_an_inertia_that_is_not_finite_and_positive_keeps_the_last_one(run):
    samples = recorded()
    samples[:, 4] = np.asarray(NOMINAL, np.float32)
    samples[50:, 4] *= 1.3
    spoilt = samples.copy()
    spoilt[60:, 4] = np.tile([np.nan, np.inf, -np.inf, -1.0, 0.0], SAMPLES)[: SAMPLES - 60, None]
    assert np.array_equal(run(spoilt), run(samples))


def test_what_was_achieved_is_ignored_where_it_is_not_finite(tmp_path):
    write_c_header(tmp_path / "law.h", LAWS["LADRC"], name="law", axes=AXES)
    (tmp_path / "law.c").write_text("""
        #include "law.h"
        int main(void) {
            const float zero = 0, nan[3] = {zero / zero, 1 / zero, 2}, set[3] = {.1f, .1f, .1f};
            float rest[3] = {0, 0, 0}, command[3];
            law_state state;
            law_init(&state);
            law_step(&state, set, 0, 0, rest, command);
            law_applied(&state, nan);
            return !(state.command[0] == command[0] && state.command[1] == command[1]
                     && state.command[2] == 2);
        }""")
    subprocess.run(["gcc", "-std=c99", "law.c", "-o", "law"], cwd=tmp_path, check=True)
    subprocess.run([tmp_path / "law"], check=True)


class Bang:
    """A user's own controller."""

    def c_source(self, axes, precision):
        step = (
            "static inline $real ${name}_step($real e) { return ${name}_limited(e * 1e9$f, "
            "${name}_table[0].most); }"
        )
        gains = {"most": Gain("N m", np.full(axes or 1, 0.5))}
        return Source("Bang-bang.", 0.01, {}, gains, {"old": "unused"}, (step,))


def test_a_controller_of_a_users_own_brings_its_source():
    text = c_header(Bang(), name="bang")
    assert "static inline float bang_step(float e)" in text
    assert "{0.5f}" in text


def test_a_controller_without_a_source_is_told_what_it_lacks():
    with pytest.raises(ValueError, match=r"is a Own, .* method c_source\(axes, precision\)"):
        c_header(type("Own", (), {})())


@pytest.mark.parametrize("law", [LADRC(4.0, 25.0, 0.9), PID(1.0, 1.0, 1.0)])
def test_the_clamp_of_a_nan_is_zero(tmp_path, law):
    write_c_header(tmp_path / "law.h", law, name="law", axes=1)
    (tmp_path / "law.c").write_text("""
        #include "law.h"
        int main(void) {
            const float zero = 0;
            return !(law_limited(zero / zero, 1) == 0 && law_limited(1 / zero, 1) == 1
                     && law_limited(-1 / zero, 1) == -1 && law_limited(.5f, 1) == .5f);
        }""")
    subprocess.run(["gcc", "-std=c99", "law.c", "-o", "law"], cwd=tmp_path, check=True)
    subprocess.run([tmp_path / "law"], check=True)
