"""Units that models declare for their numbers."""

import re

import jax.numpy as jnp
import numpy as np
import pytest

import jaxquad as jq
from jaxquad.models import parameter_units


OMEGA = np.geomspace(0.3, 30, 7)
FACTOR = 3.7  # of the unit of time
MODELS = {
    "gain": jq.LaggedIntegrator(4.0, 0.3, 0.02, integrators=0),
    "rate": jq.LaggedIntegrator(4.0, 0.3, 0.02),
    "angle": jq.LaggedIntegrator(4.0, 0.3, 0.02, integrators=2),
    "ratio": jq.TransferFunction([2.0, 3.0], [1.0, 4.0, 5.0, 0.5], delay=0.02),
}


def seconds(unit):
    """The power of s in a unit such as `y/s^2 per u`."""
    if unit == "s":
        return 1
    found = re.search(r"/s(?:\^(\d))?", unit)
    return -int(found[1] or 1) if found else 0


@pytest.mark.parametrize("model", MODELS.values(), ids=list(MODELS))
def test_another_unit_of_time_leaves_the_response_as_it_is(model):
    """Each number changes by the power of s in its unit, and frequencies by 1 / s."""
    if isinstance(model, jq.TransferFunction):
        below = [f"denominator[{k}]" for k in range(4)]
        names = ["numerator[0]", "numerator[1]", *below, "delay"]
        values = [*np.asarray(model.numerator), *np.asarray(model.denominator), 0.02]
    else:
        names, values = ["gain", "lag", "delay"], [4.0, 0.3, 0.02]
    units = parameter_units(model, names, output="y", input="u")
    v = [x * FACTOR ** seconds(unit) for x, unit in zip(values, units, strict=True)]
    if isinstance(model, jq.TransferFunction):
        other = jq.TransferFunction(v[:2], v[2:6], delay=v[6])
    else:
        other = jq.LaggedIntegrator(*v, integrators=model.integrators)
    same = other.frequency_response(jnp.asarray(OMEGA / FACTOR))
    np.testing.assert_allclose(same, model.frequency_response(jnp.asarray(OMEGA)), rtol=1e-12)


def test_units_of_the_channels_are_part_of_them():
    names = ("gain", "lag", "unknown", "plant.lag")
    units = parameter_units(MODELS["rate"], names, output="deg/s", input="N m")
    assert units == ("deg/s^2 per N m", "s", "", "")
    assert parameter_units(MODELS["angle"], ["gain"], output="rad", input="V") == ("rad/s^2 per V",)
    assert parameter_units(MODELS["gain"], ["gain"], output="m/s^2", input="V") == ("m/s^2 per V",)
