"""Tied parameters, and bands of single response pairs."""

from typing import cast

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad.models import imaginary


class Pair(eqx.Module):
    """Two lags that share a gain, of opposite signs: K u / (T s + 1) and -K u / (S s + 1)."""

    gains: jnp.ndarray
    lags: jnp.ndarray

    def frequency_response(self, omega):
        s = imaginary(omega)[:, None]
        gains, lags = (leaf.astype(s.dtype)[None, :] for leaf in (self.gains, self.lags))
        return (gains / (lags * s + 1))[:, :, None]


TRUTH = Pair(jnp.array([3.0, -3.0]), jnp.array([0.2, 0.05]))
START = Pair(jnp.array([2.0, 1.0]), jnp.array([0.1, 0.1]))
TIED = {"gains[1]": lambda m: -m.gains[0]}
FREE = ("gains[0]", "lags[0]", "lags[1]")
ML = jq.identify.MaximumLikelihood()


@pytest.mark.slow
def test_a_tied_number_follows_the_free_one():
    fit = jq.fit(START, response_of(TRUTH), free=FREE, tied=TIED, cost=ML)
    np.testing.assert_allclose(fit.values, [3.0, 0.2, 0.05], rtol=1e-7)
    assert fit.model.gains[1] == -fit.model.gains[0]


@pytest.mark.slow
def test_a_tie_sharpens_what_both_outputs_determine():
    frf = response_of(TRUTH, seed=0)
    tied = jq.fit(START, frf, free=FREE, tied=TIED, cost=ML)
    apart = jq.fit(TRUTH, frf, free=("gains[0]", "gains[1]", "lags[0]", "lags[1]"), cost=ML)
    assert tied.standard_errors[0] < 0.8 * apart.standard_errors[0]


@pytest.mark.slow
def test_a_derived_quantity_moves_with_what_is_tied():
    fit = jq.fit(START, response_of(TRUTH, seed=0), free=FREE, tied=TIED, cost=ML)
    apart = fit.derived(lambda m: m.gains[0] - m.gains[1])
    assert apart.standard_error == pytest.approx(2 * fit.standard_errors[0], rel=1e-9)


@pytest.mark.slow
def test_what_is_tied_is_shown_with_its_value_and_error():
    fit = jq.fit(START, response_of(TRUTH, seed=0), free=FREE, tied=TIED, cost=ML)
    [tied] = fit.tied
    assert tied.value == -fit["gains[0]"] and tied.follows == ("gains[0]",) and tied.determined
    assert tied.standard_error == pytest.approx(fit.standard_errors[0], rel=1e-9)
    for level, model_error in ((0.95, True), (0.95, False), (0.8, True)):
        low, high = fit.interval("gains[0]", level=level, model_error=model_error)
        found = tied.interval(level=level, model_error=model_error)
        assert found == pytest.approx((-high, -low), rel=1e-9)
    [head, *rows] = str(fit).splitlines()
    assert rows[3].split()[:3] == ["gains[1]", f"{tied.value:.5g}", f"{tied.standard_error:.2g}"]
    assert head.index("width") - 1 == rows[3].index("tied") - 2
    assert rows[4].startswith("tied") and "gains[1]" in rows[4] and "gains[0]" in rows[4]
    [stored] = cast(list, fit.to_dict()["tied"])
    assert stored["name"] == "gains[1]" and stored["tied_to"] == ["gains[0]"]
    assert stored["interval_95"] == pytest.approx(tied.interval())


@pytest.mark.slow
def test_what_follows_an_undetermined_parameter_is_not_determined():
    """Of L K_t / J_x the record shows the product alone."""
    truth = jq.models.AttitudeAxis(L=0.2, K_t=0.1, J_x=0.05, lag=0.05)
    frf, tied = response_of(truth, seed=0), {"L": lambda model: 2 * model.K_t}
    fit = jq.fit(truth, frf, free=("K_t", "J_x"), tied=tied, cost=ML)
    assert not fit.tied[0].determined and fit.tied[0].standard_error == np.inf
    row = next(line for line in str(fit).splitlines() if line.startswith("L *"))
    assert "not determined" in row and row.split()[-1] == f"{fit.tied[0].value:.5g}"


@pytest.mark.slow
def test_the_gain_of_a_transfer_function_moves_with_what_is_tied():
    servo = jq.TransferFunction([900.0], [1.0, 36.0, 900.0])
    tied = {"numerator[0]": lambda servo: servo.denominator[2]}
    free = ("denominator[1]", "denominator[2]")
    fit = jq.fit(servo, response_of(servo, seed=0), free=free, tied=tied, cost=ML)
    assert jq.identify.factors(fit).gain.standard_error == pytest.approx(fit.standard_errors[1])


@pytest.mark.slow
def test_without_free_all_but_the_tied_numbers_are_free():
    fit = jq.fit(START, response_of(TRUTH), tied=TIED, cost=ML)
    assert fit.names == FREE


@pytest.mark.parametrize(
    "tied, message",
    [
        ({"gain": lambda m: m.gains[0]}, "no parameter 'gain' to tie; the model has: gains"),
        ({"gains[0]": lambda m: -m.gains[1]}, "cannot be free and tied at once"),
        ({"gains[1]": lambda m: -2 * m.gains[1]}, r"gains\[1\] is tied to itself, or"),
        ({"gains[1]": lambda m: m.gains}, r"tied to an array of shape \(2,\): return one number"),
    ],
)
def test_an_impossible_tie_is_refused(tied, message):
    with pytest.raises(ValueError, match=message):
        jq.fit(START, response_of(TRUTH), free=FREE, tied=tied)


@pytest.mark.slow
def test_a_tie_may_follow_an_earlier_one_and_no_later_one():
    first, second = {"lags[1]": lambda m: m.gains[0] / 60}, {"lags[0]": lambda m: 4 * m.lags[1]}
    fit = jq.fit(START, response_of(TRUTH), tied=TIED | first | second, cost=ML)
    assert fit.names == ("gains[0]",)
    np.testing.assert_allclose(fit.model.lags, TRUTH.lags, rtol=1e-6)
    with pytest.raises(ValueError, match=r"lags\[0\] is tied .* whose tie comes later"):
        jq.fit(START, response_of(TRUTH), tied=TIED | second | first, cost=ML)


@pytest.mark.slow
def test_each_pair_has_a_band_of_its_own():
    frf = response_of(TRUTH)
    fit = jq.fit(START, frf, tied=TIED, cost=ML, band={("y1", "u0"): (2.0, 10.0)})
    assert fit.points == OMEGA.size + np.sum((OMEGA >= 2) & (OMEGA <= 10))
    np.testing.assert_allclose(fit.values, [3.0, 0.2, 0.05], rtol=1e-7)


@pytest.mark.slow
def test_a_pair_can_be_left_out():
    frf = response_of(TRUTH)
    fit = jq.fit(START, frf, free=FREE[:2], tied=TIED, cost=ML, band={("y1", "u0"): None})
    assert fit.points == OMEGA.size
    np.testing.assert_allclose(fit.values, [3.0, 0.2], rtol=1e-7)


def test_a_band_of_an_unknown_pair_is_refused_with_the_known_ones():
    with pytest.raises(ValueError, match=r"no response pair \('q', 'u0'\).*\('y0', 'u0'\)"):
        jq.fit(START, response_of(TRUTH), band={("q", "u0"): (1.0, 2.0)})
