"""Errors stored by the atoms that reach each frequency are those of all atoms side by side."""

import dataclasses

import numpy as np
import pytest

import jaxquad as jq
from jaxquad.spectra import ErrorCovariance


pytestmark = pytest.mark.slow


FREQUENCIES, OUTPUTS, INPUTS, PARAMETERS = 70, 2, 3, 4
WIDTH, ATOMS = 40, 9000
SHAPE = (FREQUENCIES, OUTPUTS, INPUTS)


def draw(rng, *shape):
    return rng.standard_normal(shape) + 1j * rng.standard_normal(shape)


def by_reach() -> ErrorCovariance:
    """Neighbours share atoms, the last ones lie far from the others, and parameters move all."""
    rng = np.random.default_rng(0)
    first = np.sort(rng.integers(0, 900, FREQUENCIES))
    first[-5:] += 8000
    effect = draw(rng, FREQUENCIES, INPUTS, WIDTH)
    effect[: FREQUENCIES // 2, :, WIDTH // 3 :] = 0.0  # shorter windows, padded
    driven = np.unique(rng.integers(0, ATOMS, 4000))
    drive = draw(rng, PARAMETERS, driven.size, OUTPUTS) / 100
    return ErrorCovariance(
        np.geomspace(1.0, 50.0, FREQUENCIES),
        effect,
        draw(rng, FREQUENCIES, OUTPUTS, OUTPUTS),
        sensitivity=draw(rng, *SHAPE, PARAMETERS),
        drive=drive,
        first=first,
        driven=driven,
    )


def side_by_side(errors: ErrorCovariance) -> ErrorCovariance:
    assert errors.drive is not None
    effect = np.zeros((FREQUENCIES, INPUTS, ATOMS), complex)
    for row, narrow, begin in zip(effect, errors.effect, np.asarray(errors.first), strict=True):
        row[:, begin : begin + WIDTH] = narrow
    drive = np.zeros((PARAMETERS, ATOMS, OUTPUTS), complex)
    drive[:, np.asarray(errors.driven)] = errors.drive
    return dataclasses.replace(errors, effect=effect, drive=drive, first=None, driven=None)


ERRORS = by_reach()
WHOLE = side_by_side(ERRORS)


def plain_covariance(errors: ErrorCovariance) -> np.ndarray:
    """Of [real, imaginary] parts of all responses under real and imaginary parts of the noise."""
    assert errors.drive is not None and errors.sensitivity is not None
    count = np.prod(SHAPE)
    own = np.einsum("fia,foc->foiac", errors.effect, errors.noise).reshape(count, -1)
    slope = np.asarray(errors.sensitivity).reshape(count, -1)
    drive = np.asarray(errors.drive).reshape(PARAMETERS, -1)
    # A circular noise of unit power has parts of power one half; times j, it turns.
    under_real = own + slope @ np.real(drive)
    under_imaginary = 1j * own - slope @ np.imag(drive)
    rows = np.concatenate([under_real, under_imaginary], axis=1) / np.sqrt(2)
    return rows @ rows.conj().T


@pytest.fixture(scope="module")
def plain():
    return plain_covariance(WHOLE).reshape(*SHAPE, *SHAPE)


@pytest.mark.parametrize("errors", (ERRORS, WHOLE), ids=("reach", "whole"))
def test_all_forms_of_the_covariance_are_the_plain_one(errors, plain):
    for first, second in (((0, 0), (0, 0)), ((1, 2), (1, 2)), ((0, 1), (1, 2))):
        expected = plain[:, first[0], first[1], :, second[0], second[1]]
        found = errors.between(first, second)
        np.testing.assert_allclose(found, expected, atol=1e-12 * np.max(np.abs(expected)))
    each = np.arange(FREQUENCIES)
    at_each = plain[each, :, :, each].reshape(FREQUENCIES, OUTPUTS * INPUTS, -1)
    np.testing.assert_allclose(errors.at_each_frequency(), at_each, atol=1e-9)
    np.testing.assert_allclose(
        errors.variance().reshape(FREQUENCIES, -1), np.real(np.diagonal(at_each, axis1=1, axis2=2))
    )


def test_projections_and_pairs_do_not_depend_on_the_form(plain):
    columns = draw(np.random.default_rng(1), *SHAPE, 5)
    expected = WHOLE.project(columns)
    np.testing.assert_allclose(ERRORS.project(columns), expected, rtol=1e-10)
    one = ERRORS.pair(1, 2).scaled(np.full(FREQUENCIES, 2.0 + 0j))
    np.testing.assert_allclose(one.between((0, 0), (0, 0)), 4 * plain[:, 1, 2, :, 1, 2], rtol=1e-9)


def test_the_projection_is_the_variance_of_a_weighted_sum(plain):
    """The two columns are the real and the imaginary part of one sum."""
    columns = np.zeros((*SHAPE, 2), complex)
    columns[3, 1, 0], columns[69, 0, 2] = (1.0, 1j), (2.0, 2j)
    weights = columns[..., 0].reshape(-1)
    expected = weights.conj() @ plain.reshape(weights.size, -1) @ weights
    assert np.trace(ERRORS.project(columns)) == pytest.approx(float(np.real(expected)), rel=1e-9)


def test_frequencies_are_independent_where_no_atom_reaches_two():
    first = 10 * np.arange(FREQUENCIES)
    for width, apart in ((10, True), (11, False)):
        effect = np.ones((FREQUENCIES, 1, width), complex)
        noise = np.ones((FREQUENCIES, 1, 1), complex)
        errors = ErrorCovariance(ERRORS.omega, effect, noise, first=first)
        rows = np.arange(FREQUENCIES)
        assert errors.independent(0, rows) == apart
        assert errors.independent(0, rows[::2])


def test_independent_errors_take_room_for_themselves_only():
    errors = jq.spectra.independent_errors(ERRORS.omega, np.full(SHAPE, 0.25))
    assert errors.effect.shape == (FREQUENCIES, INPUTS, INPUTS)
    assert errors.independent(1, np.arange(FREQUENCIES))
    np.testing.assert_allclose(errors.variance(), 0.25)
    np.testing.assert_allclose(errors.between((0, 1), (0, 1)), 0.25 * np.eye(FREQUENCIES))
    np.testing.assert_allclose(errors.between((0, 1), (0, 2)), 0.0)


@pytest.mark.parametrize("width", (1, 4, 5))
@pytest.mark.parametrize("step", (1, -1), ids=("rising", "falling"))
def test_narrow_effects_are_those_of_all_atoms(width, step):
    rng = np.random.default_rng(width)
    first = np.cumsum(rng.integers(1, 4, FREQUENCIES))[::step]
    effect = draw(rng, FREQUENCIES, INPUTS, width)
    effect[3, :, -1] = 0.0  # a shorter one
    all_atoms = np.zeros((FREQUENCIES, INPUTS, int(np.max(first)) + width), complex)
    for row, narrow, begin in zip(all_atoms, effect, first, strict=True):
        row[:, begin : begin + width] = narrow
    noise, columns = draw(rng, FREQUENCIES, OUTPUTS, OUTPUTS), draw(rng, *SHAPE, 2)
    found = ErrorCovariance(ERRORS.omega, effect, noise, first=first).project(columns)
    expected = ErrorCovariance(ERRORS.omega, all_atoms, noise).project(columns)
    np.testing.assert_allclose(found, expected, rtol=1e-12, atol=1e-12 * np.max(np.abs(expected)))
