"""The certified nonlinear regressions of NIST (StRD), through the solver set-up of every fit.

Certified are parameters, their standard deviations and the residual sum of squares. Parameters are
scaled by their starting values, as everywhere in this package.
"""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad.identify import least_squares


DIGITS = 1e-6  # six significant digits
TIGHT = 1e-9  # MGH09's Gauss-Newton steps shrink by a third only: stop late

exp, pi = jnp.exp, jnp.pi


def _gauss(b, x):
    peaks = b[2] * exp(-(((x - b[3]) / b[4]) ** 2)) + b[5] * exp(-(((x - b[6]) / b[7]) ** 2))
    return b[0] * exp(-b[1] * x) + peaks


def _cubics(b, x):
    return (b[0] + x * (b[1] + x * (b[2] + x * b[3]))) / (1 + x * (b[4] + x * (b[5] + x * b[6])))


def _lanczos(b, x):
    return b[0] * exp(-b[1] * x) + b[2] * exp(-b[3] * x) + b[4] * exp(-b[5] * x)


def _chwirut(b, x):
    return exp(-b[0] * x) / (b[1] + b[2] * x)


def _saturation(b, x):
    return b[0] * (1 - exp(-b[1] * x))


def _wave(cosine, sine, period, x):
    return cosine * jnp.cos(2 * pi * x / period) + sine * jnp.sin(2 * pi * x / period)


def _enso(b, x):
    cycles = _wave(b[4], b[5], b[3], x) + _wave(b[7], b[8], b[6], x)
    return b[0] + _wave(b[1], b[2], 12.0, x) + cycles


MODELS = {
    "Bennett5": lambda b, x: b[0] * (b[1] + x) ** (-1 / b[2]),
    "BoxBOD": _saturation,
    "Chwirut1": _chwirut,
    "Chwirut2": _chwirut,
    "DanWood": lambda b, x: b[0] * x ** b[1],
    "ENSO": _enso,
    "Eckerle4": lambda b, x: b[0] / b[1] * exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "Gauss3": _gauss,
    "Hahn1": _cubics,
    "Kirby2": lambda b, x: (b[0] + b[1] * x + b[2] * x**2) / (1 + b[3] * x + b[4] * x**2),
    "Lanczos1": _lanczos,
    "Lanczos2": _lanczos,
    "Lanczos3": _lanczos,
    "MGH09": lambda b, x: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "MGH10": lambda b, x: b[0] * exp(b[1] / (x + b[2])),
    "MGH17": lambda b, x: b[0] + b[1] * exp(-x * b[3]) + b[2] * exp(-x * b[4]),
    "Misra1a": _saturation,
    "Misra1b": lambda b, x: b[0] * (1 - (1 + b[1] * x / 2) ** -2),
    "Misra1c": lambda b, x: b[0] * (1 - (1 + 2 * b[1] * x) ** -0.5),
    "Misra1d": lambda b, x: b[0] * b[1] * x / (1 + b[1] * x),
    "Nelson": lambda b, x: b[0] - b[1] * x[:, 0] * exp(-b[2] * x[:, 1]),
    "Rat42": lambda b, x: b[0] / (1 + exp(b[1] - b[2] * x)),
    "Rat43": lambda b, x: b[0] / (1 + exp(b[1] - b[2] * x)) ** (1 / b[3]),
    "Roszman1": lambda b, x: b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / pi,
    "Thurber": _cubics,
}


def _read(path):
    """Starts [2, n], certified values and deviations [2, n], sum of squares, y, x."""
    lines = path.read_text().splitlines()
    rows = [line.split("=")[1].split() for line in lines if re.match(r"\s*b\d+\s*=", line)]
    table = np.array(rows, float).T
    (total,) = (line.split(":")[1] for line in lines if line.startswith("Residual Sum of Squares"))
    first = max(k for k, line in enumerate(lines) if line.startswith("Data:")) + 1
    numbers = np.array([line.split() for line in lines[first:] if line.strip()], float)
    y, x = numbers[:, 0], numbers[:, 1:]
    if path.stem == "Nelson":
        return table[:2], table[2:], float(total), np.log(y), x
    return table[:2], table[2:], float(total), y, x[:, 0]


def _solve_all(name, starts, y, x):
    """Every start at once: values and Jacobian by the values."""

    def misfit(z, start):
        return MODELS[name](z * start, x) - y

    @jax.jit
    @jax.vmap
    def solve(start):
        z0 = jnp.ones_like(start)
        stop = least_squares(misfit, z0, start, max_steps=2000, tolerance=TIGHT)
        slopes = jax.jacfwd(misfit)(stop.z, start) / start[None]
        return stop.z * start, slopes, misfit(stop.z, start), stop.converged

    return [np.asarray(part) for part in solve(jnp.asarray(starts))]


def _check(values, slopes, misfits, certified, total):
    freedom = misfits.size - values.size
    # scaled, for the columns differ by many orders of magnitude
    size = np.linalg.norm(slopes, axis=0)
    root = np.linalg.inv(np.linalg.qr(slopes / size).R)
    deviations = np.sqrt(np.sum(misfits**2) / freedom * np.sum(root**2, axis=1)) / size
    np.testing.assert_allclose(values, certified[0], rtol=DIGITS)
    np.testing.assert_allclose(deviations, certified[1], rtol=DIGITS)
    np.testing.assert_allclose(np.sum(misfits**2), total, rtol=DIGITS)


NEEDS_OTHER_STARTS = ("MGH17", 0)  # the first start leads every local method tried to b4 = infinity


QUICK = ("BoxBOD", "MGH10")  # one of two parameters, and one that is hard


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=() if name in QUICK else pytest.mark.slow)
        for name in MODELS
        if name != "Lanczos1"
    ],
)
def test_certified_to_six_digits_from_both_starts(data, name):
    starts, certified, total, y, x = _read(data / "nist_strd" / f"{name}.dat")
    found = _solve_all(name, starts, y, x)
    for k, (values, slopes, misfits, converged) in enumerate(zip(*found, strict=True)):
        if (name, k) != NEEDS_OTHER_STARTS:
            _check(values, slopes, misfits, certified, total)
            assert converged


@pytest.mark.slow
def test_the_start_that_no_local_method_survives_is_reached_from_others_around_it(data):
    starts, certified, total, y, x = _read(data / "nist_strd" / "MGH17.dat")
    rng = np.random.default_rng(0)
    spread = starts[0] * np.exp(rng.uniform(-5, 0, (64, 5)))
    values, slopes, misfits, _ = _solve_all("MGH17", spread, y, x)
    costs = np.where(np.isfinite(misfits).all(axis=1), np.sum(misfits**2, axis=1), np.inf)
    best = int(np.argmin(costs))
    order = [0, 1, 2, 3, 4] if values[best, 3] < values[best, 4] else [0, 2, 1, 4, 3]
    _check(values[best, order], slopes[best][:, order], misfits[best], certified, total)


@pytest.mark.slow
def test_lanczos1_has_residuals_below_double_precision(data):
    """Its residuals are 1e-13 of values near 2.5: their sum of squares needs longer numbers."""
    starts, certified, total, y, x = _read(data / "nist_strd" / "Lanczos1.dat")
    long_y, long_x = _decimal(data / "nist_strd" / "Lanczos1.dat")
    for values, slopes, _, converged in zip(*_solve_all("Lanczos1", starts, y, x), strict=True):
        assert converged
        np.testing.assert_allclose(values, certified[0], rtol=DIGITS)
        exact = values.astype(np.longdouble)
        for _ in range(3):  # refinement: residuals in long precision, steps in double
            misfits = -long_y
            for k in (0, 2, 4):
                misfits = misfits + exact[k] * np.exp(-exact[k + 1] * long_x)
            exact -= np.linalg.lstsq(slopes, misfits.astype(float), rcond=None)[0]
        _check(exact.astype(float), slopes, misfits, certified, total)


def _decimal(path):
    """Responses and predictors to all their printed digits."""
    lines = path.read_text().splitlines()
    first = max(k for k, line in enumerate(lines) if line.startswith("Data:")) + 1
    rows = [line.split() for line in lines[first:] if line.strip()]
    return np.array([[np.longdouble(cell) for cell in row] for row in rows]).T
