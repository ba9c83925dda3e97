"""Programs of arrays alone compute what `eqx.filter_jit` does, and are found by all else."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxquad._compile import Jit


ONES = jnp.ones(3)


class Settings(eqx.Module):
    gain: jax.Array
    power: int | float | bool
    name: str = eqx.field(static=True)


@pytest.fixture
def run():
    """A function of arrays and settings, which counts how often it is traced."""

    def scaled(settings, x):
        scaled.traced += 1
        answer = settings.gain * x**settings.power
        return {"answer": answer, "power": settings.power, "made by": settings, "shape": x.shape}

    scaled.traced = 0
    return Jit(scaled)


def test_what_is_no_array_comes_back_as_it_is(run):
    given = Settings(jnp.asarray(3.0), 2, "square")
    found = run(given, 2 * ONES)
    np.testing.assert_array_equal(found["answer"], 12.0)
    assert found["power"] == 2 and type(found["power"]) is int and found["shape"] == (3,)
    assert found["made by"].name == "square" and found["made by"].gain == 3.0
    longer = run(given, np.ones(4))
    assert longer["shape"] == (4,) and run(given, ONES)["shape"] == (3,)


def test_a_program_is_for_the_leaves_that_it_was_traced_from(run):
    for power, kind in ((1, int), (1.0, float), (True, bool), (1, int)):
        assert type(run(Settings(ONES, power, "a"), ONES)["power"]) is kind
    assert run.__wrapped__.traced == 3
    run(Settings(2 * ONES, 1, "a"), ONES)
    assert run.__wrapped__.traced == 3
    assert run(Settings(ONES, 1, "b"), ONES)["made by"].name == "b"
    assert run.__wrapped__.traced == 4


def test_a_failure_while_it_runs_is_told_in_its_own_words_and_once(caplog):
    checked = Jit(lambda x: eqx.error_if(x, jnp.any(x < 0), "x is below 0"))
    np.testing.assert_array_equal(checked(ONES), 1.0)
    with pytest.raises(eqx.EquinoxRuntimeError, match="x is below 0"):
        checked(-ONES)
    assert not caplog.records
