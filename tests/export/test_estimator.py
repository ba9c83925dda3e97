"""The Fourier estimator's C header, compiled by gcc, against its update in JAX."""

import ctypes
import shutil
import subprocess

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from c_loops import STRICT

from jaxquad.control import FourierInertia, ProbeTones
from jaxquad.export import c_header, write_c_header


SAMPLES, AXES, DT = 5000, 2, 0.004
LINES = 1.3 * 1.2 ** np.arange(10)  # Hz
MAKE = {"torque_gain": [2.0, 1.0], "nominal": [1.1, 0.4], "frequencies": LINES, "dt": DT}
ESTIMATORS = {
    "angle": FourierInertia(lag=0.02, delay=0.003, **MAKE),
    "rate": FourierInertia(measured="rate", nuisance=("lag", "offset", "damping"), **MAKE),
    "gain alone": FourierInertia(measured="rate", nuisance=(), forgetting=4.0, **MAKE),
}
_DRIVER = """
#include "inertia.h"
void run(int samples, const REAL *command, const REAL *measurement, REAL *inertia, REAL *deviation,
    int *trusted, REAL *values)
{
    inertia_state state;
    inertia_init(&state);
    for (int k = 0; k < samples; ++k, command += 2, measurement += 2) {
        inertia_update(&state, command, measurement);
        inertia_estimate(&state, inertia + 2 * k, deviation + 2 * k, trusted + 2 * k);
        for (int n = 0; n < 2 * INERTIA_COEFFICIENTS; ++n)
            values[2 * INERTIA_COEFFICIENTS * k + n] = state.values[n / 2][n % 2];
    }
}
"""


@pytest.fixture(autouse=True)
def compiler():
    if shutil.which("gcc") is None:
        pytest.skip("no gcc to compile the headers with")


def record(measured):
    """Multisine commands that end after 12 s, and a noisy answer: [samples, axes]."""
    rng = np.random.default_rng(3)
    clock, phase = DT * np.arange(SAMPLES)[:, None], rng.uniform(0, 6, (8, AXES))
    tones = zip(LINES[1:-1], phase, strict=True)
    command = sum(0.3 * np.sin(2 * np.pi * f * clock + p) for f, p in tones) * (clock < 12.0)
    rate = np.cumsum(DT * np.array([2.0, 3.0]) * command + 0.01 * rng.normal(size=command.shape), 0)
    answer = rate if measured == "rate" else np.cumsum(DT * rate, 0)
    return command, answer + 1e-3 * rng.normal(size=answer.shape)


@eqx.filter_jit
def in_jax(estimator, command, measurement):
    def sample(state, now):
        state = estimator.update(state, *now)
        return state, (*estimator.estimate(state), state.values)

    return jax.lax.scan(sample, estimator.init(measurement[0]), (command, measurement))[1]


def compiled(tmp_path, estimator, precision, *flags):
    write_c_header(tmp_path / "inertia.h", estimator, name="inertia", precision=precision)
    (tmp_path / "law.c").write_text(_DRIVER.replace("REAL", precision))
    library = tmp_path / "law.so"
    command = ["gcc", "-std=c99", *STRICT, "-O2", *flags, "-shared", "-fPIC", "law.c"]
    subprocess.run([*command, "-o", library, "-lm"], cwd=tmp_path, check=True)
    return ctypes.CDLL(str(library))


def in_c(library, estimator, kind, *signals):
    signals = [np.ascontiguousarray(x.astype(kind)) for x in signals]
    count = len(estimator.coefficients)
    found = np.zeros((2, SAMPLES, AXES), kind), np.zeros((SAMPLES, AXES), np.intc)
    values = np.zeros((SAMPLES, count, AXES), kind)
    arrays = (*signals, *found[0], found[1], values)
    library.run(SAMPLES, *(ctypes.c_void_p(x.ctypes.data) for x in arrays))
    return *found[0], found[1], values


@pytest.mark.parametrize("name", ESTIMATORS)
def test_the_header_is_the_update(tmp_path, name):
    """In double, to rounding, of which least squares make some thousand units."""
    estimator = ESTIMATORS[name]
    signals = record(estimator.measured)
    library = compiled(tmp_path, estimator, "double")
    inertia, deviation, trusted, values = in_c(library, estimator, np.float64, *signals)
    expected = [np.asarray(x) for x in in_jax(estimator, *map(jnp.asarray, signals))]
    np.testing.assert_allclose(inertia, expected[0], rtol=1e-10)
    np.testing.assert_allclose(deviation, expected[1], rtol=1e-9)
    np.testing.assert_array_equal(trusted, expected[2])
    settled = slice(round(2.0 / DT), None)
    scale = np.abs(expected[3][settled]).max(axis=0)
    assert np.max(np.abs(values - expected[3])[settled] / scale) < 1e-10
    assert 0.2 < trusted.mean() < 0.95


def test_in_float_it_is_as_good(tmp_path):
    estimator, signals = ESTIMATORS["rate"], record("rate")
    found = in_c(compiled(tmp_path, estimator, "float"), estimator, np.float32, *signals)
    exact = in_jax(estimator, *map(jnp.asarray, signals))
    np.testing.assert_allclose(found[0][2900], exact[0][2900], rtol=1e-3)
    np.testing.assert_allclose(found[1][2900], exact[1][2900], rtol=0.02)


@pytest.mark.parametrize("flags", [(), ("-Ofast",)])
def test_a_bad_sample_begins_anew_and_keeps_the_inertia(tmp_path, flags):
    estimator, (command, measurement) = ESTIMATORS["rate"], record("rate")
    measurement[2500, 0] = np.nan
    library = compiled(tmp_path, estimator, "double", *flags)
    inertia, deviation, _, values = in_c(library, estimator, np.float64, command, measurement)
    assert np.all(np.isfinite(inertia)) and np.all(np.isfinite(deviation))
    np.testing.assert_array_equal(inertia[2500:2600, 0], inertia[2499, 0])
    assert np.ptp(inertia[2500:2600, 1]) > 0 and np.all(values[2501, :, 0] == 0)


def test_what_cannot_be_written_is_refused():
    tones = FourierInertia(1.0, 1.0, LINES, tones=ProbeTones(), dt=DT)
    with pytest.raises(ValueError, match="test tones, which cannot be written in C"):
        c_header(tones, axes=1)
    wide = FourierInertia(np.ones((1, 4)), 1.0, LINES, dt=DT)
    with pytest.raises(ValueError, match="ensemble"):
        c_header(wide)
