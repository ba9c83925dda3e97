"""An argument of the wrong kind is refused with what to give instead."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import jaxquad as jq


pytestmark = pytest.mark.usefixtures("without_type_checks")


PLANT = jq.DecoupledAxes([0.05], [0.05])
LADRC = jq.LADRC(10.0, 30.0, 1.0)
LOOP = jq.Loop(PLANT, LADRC)
WRONG: Any = "flight.csv"
AXES: Any = PLANT
NUMBER: Any = 3.0
FLIGHT = jq.scenario(duration=1.0, axes=1)
TIME = np.arange(100.0) / 100
FLOWN = jq.Record(TIME, np.sin(TIME), np.cos(TIME), np.sin(3 * TIME))
FIT: Any = SimpleNamespace(model=jq.LaggedIntegrator(1.0))
PRIOR: Any = jq.identify.Prior("gain", 1.0, 0.1)
AXIS = jq.LaggedIntegrator(1.0, 0.03, 0.02)
FREQUENCIES = np.geomspace(15.0, 60.0, 8)
RESPONSE = jq.frequency_response(FLOWN, FREQUENCIES, estimator=jq.spectra.Welch(0.5))
CALLS = {
    "estimator is 'flight.csv': give an object, such as jq.spectra.Welch": lambda: (
        jq.frequency_response(FLOWN, np.ones(1), estimator=WRONG)
    ),
    "loop is a DecoupledAxes: .* jq.loops.margins": lambda: jq.analyse(AXES),
    r"a SimpleNamespace is no model: .* simplenamespace.model": lambda: jq.verify(FIT, FLOWN),
    "entry is 'flight.csv': .* 'set-point' or 'plant input'": lambda: (
        jq.spectra.estimate_broken_loop(FLOWN, entry=WRONG)
    ),
    "the records hold a str: .* see jq.read": lambda: jq.frequency_response(WRONG, np.ones(1)),
    "verify needs a jq.Record, not a str": lambda: jq.verify(jq.LaggedIntegrator(1.0), WRONG),
    "scenario is a str: give jq.scenario": lambda: jq.simulate(LOOP, WRONG),
    "loop is a str: give jq.Loop": lambda: jq.evaluate(WRONG, FLIGHT),
    "scenario is a str: give": lambda: jq.tune(LOOP, jq.Ensemble(), WRONG),
    "ensemble is a str: give jq.Ensemble": lambda: jq.certify(LOOP, WRONG, FLIGHT),
    "fit is a str: give the result of jq.fit": lambda: jq.ensembles.Posterior(
        WRONG, recorded_dt=None
    ),
    "priors is Prior.*: give a list, priors=": lambda: jq.fit(AXIS, RESPONSE, priors=PRIOR),
    "priors is .* standard error": lambda: jq.refine(AXIS, FLOWN, priors=[NUMBER]),
    "a float is no frequency response: give": lambda: jq.loops.margins(NUMBER),
    "estimator is 3.0: give an object with the methods": lambda: jq.AdaptiveLADRC(
        LADRC, NUMBER, lambda inertia: 1 / inertia
    ),
    "the controller is a DecoupledAxes, which is a plant": lambda: jq.Loop(PLANT, AXES),
}


@pytest.mark.parametrize("message", CALLS)
def test_an_argument_of_the_wrong_kind_is_refused(message):
    with pytest.raises(ValueError, match=message):
        CALLS[message]()
