"""Entries of a state space that carry the names of derivatives."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from synthetic import response_of

import jaxquad as jq
from jaxquad.identify import Prior, select_parameters


NAMES = {"Lp": "F[0][0]", "Lda": "G[0][0]", "tau": "input_delay[0]"}


def roll(Lp=-4.0, Lda=60.0, tau=0.02, names=NAMES):
    """Roll rate and bank angle per aileron."""
    return jq.StateSpace(
        [[Lp, 0.0], [1.0, 0.0]], [[Lda], [0.0]], [[1.0, 0.0]], input_delay=[tau], names=names
    )


class Axis(eqx.Module):
    roll: jq.StateSpace


def test_names_stand_for_entries_and_entries_stay_valid():
    by_name = select_parameters(roll(), ("Lp", "tau"))
    by_entry = select_parameters(roll(), ("F[0][0]", "input_delay"))
    assert by_name.names == by_entry.names == ("Lp", "tau")
    assert by_name.places == by_entry.places
    assert select_parameters(Axis(roll()), ("roll.Lda", "roll.F[1][0]")).names == (
        "roll.Lda", "roll.F[1][0]",
    )  # fmt: skip


def test_a_whole_matrix_is_free_under_the_names_of_its_entries():
    lag = jq.StateSpace([[-1.0]], [[2.0]], [[1.0]], names={"Lp": "F[0][0]"})
    assert select_parameters(lag, ("F", "G")).names == ("Lp", "G[0][0]")


def test_a_name_can_be_tied():
    tied = {"Lda": lambda m: -15.0 * m.F[0, 0]}
    parameters = select_parameters(roll(), ("Lp", "tau"), tied)
    changed = parameters.replace(roll(), jnp.array([-2.0, 0.01]))
    np.testing.assert_allclose(changed.G[0, 0], 30.0)
    with pytest.raises(ValueError, match="cannot be free and tied"):
        select_parameters(roll(), ("G[0][0]",), tied)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        ({"Lp": "F[2][0]"}, r"'F\[2\]\[0\]', which the model does not have"),
        ({"Lp": "H1[0][0]"}, "does not have"),
        ({"F[0][1]": "F[0][0]"}, "that of an array"),
        ({"Lp": "F[0][0]", "lp": "F[0][0]"}, "two names"),
    ],
)
def test_names_that_stand_for_nothing_or_for_two_things_are_refused(names, message):
    with pytest.raises(ValueError, match=message):
        roll(names=names)


def test_names_follow_their_entries_to_the_selected_channels():
    both = jq.StateSpace(
        np.diag([-1.0, -2.0]), np.eye(2), np.eye(2), input_delay=[0.1, 0.2],
        names={"a": "F[0][0]", "b": "G[1][1]", "c": "H0[0][0]", "d": "input_delay[1]"},
    )  # fmt: skip
    kept = both.select([1], [1])
    assert dict(kept.names) == {"a": "F[0][0]", "b": "G[1][0]", "d": "input_delay[0]"}
    assert dict(dataclasses.replace(both, F=-np.eye(2)).names) == dict(both.names)


@pytest.mark.slow
def test_a_fit_shows_the_names_and_is_that_without_them():
    frf, free = response_of(roll(-5.0, 50.0, 0.03)), ("Lp", "Lda", "tau")
    priors = [Prior("Lda", 50.0, 1.0)]
    named = jq.fit(roll(), frf, free=free, priors=priors)
    entries = [NAMES[name] for name in free]
    plain = jq.fit(roll(names={}), frf, free=entries, priors=[Prior("G[0][0]", 50.0, 1.0)])
    assert named.names == free and plain.names == tuple(entries)
    np.testing.assert_allclose(named.values, plain.values, rtol=1e-9)
    assert all(f"\n{name} " in str(named) for name in free)
