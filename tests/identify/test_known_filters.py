"""Records behind filters of their outputs: a filter and a plant may change places."""

import numpy as np
from scipy.signal import lfilter

import jaxquad as jq
from jaxquad.control.autopilots import Butterworth, FilterChain, PT1
from jaxquad.identify import behind_filters


RATE, SAMPLES = 400.0, 6000
CHAIN = FilterChain((Butterworth(20.0), PT1(60.0)), RATE)


def test_inputs_pass_the_filters_as_the_firmware_computes_them():
    time = np.arange(SAMPLES) / RATE
    u = np.sin(2 * np.pi * 3 * time) * (time > 1) + 2.0
    record = jq.Record(time, u, np.cos(time))
    late = behind_filters(record, [CHAIN]).inputs[:, 0]
    exact = u - u[0]
    for section in CHAIN.sections():
        b0, b1, a1, b2, a2 = (0.0 if x is None else float(x) for x in section)
        exact = np.asarray(lfilter([b0, b1, b2], [1.0, a1, a2], exact))
    assert np.allclose(late, exact + u[0], atol=1e-9)
    assert behind_filters(record, []) is record


def test_a_model_without_the_filters_verifies_on_what_is_behind_them():
    plant = jq.LaggedIntegrator(30.0, 0.03, 0.0).transfer_function()
    time = np.arange(SAMPLES) / RATE
    u = np.sin(2 * np.pi * 4 * time) + np.sin(2 * np.pi * 9 * time)
    y = np.asarray(jq.models.simulate_linear(plant, u, 1 / RATE))
    for section in CHAIN.sections():
        b0, b1, a1, b2, a2 = (0.0 if x is None else float(x) for x in section)
        y = np.asarray(lfilter([b0, b1, b2], [1.0, a1, a2], y))
    record = jq.Record(time, u, y, hold="dt")
    band = (2 * np.pi * 2, 2 * np.pi * 15)
    right = jq.verify(plant, behind_filters(record, [CHAIN]), band=band)
    wrong = jq.verify(plant, record, band=band)
    assert right.fit_percent > 98 and wrong.fit_percent < 70
