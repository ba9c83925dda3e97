"""How far a local window may reach, by hand-made spectra."""

import numpy as np

from jaxquad.spectra._local_fit import Bins
from jaxquad.spectra._local_width import reach


LINES = np.arange(1, 401) * 0.1  # rad/s
OMEGA = np.array([4.0, 10.0, 20.0])
CENTRE, WIDEST = 0.1 * OMEGA, 1.2 * OMEGA
INPUT = slice(0, 1)


def reached(power):
    root = np.sqrt(np.broadcast_to(power, LINES.shape)).astype(complex)
    return reach(OMEGA, CENTRE, WIDEST, Bins(LINES, np.zeros(400, int), root[:, None], 1), INPUT)


def test_a_flat_spectrum_and_that_of_an_exponential_sweep_let_windows_reach_the_widest():
    np.testing.assert_allclose(reached(1.0), WIDEST)
    np.testing.assert_allclose(reached(1 / LINES), WIDEST)


def test_where_a_sweep_has_ended_windows_do_not_reach_back_into_it():
    far = reached(np.where(LINES < 5.0, 1.0, 1e-6))
    assert far[0] == WIDEST[0]
    assert np.all(OMEGA[1:] - far[1:] > 3.8)  # a step of the search beyond 5 rad/s


def test_between_lines_windows_reach_to_the_lines_on_both_sides():
    lines = np.where(np.round(LINES * 10).astype(int) % 10 == 0, 1.0, 0.0)
    np.testing.assert_allclose(reached(lines), WIDEST)
    np.testing.assert_allclose(reached(np.where(np.abs(LINES - 10.0) < 2.0, 0.0, 1.0))[1], 12.0)
