"""The broken loop and the spectrum of a page: where they are shown, and what they say."""

import numpy as np
import pytest
from scipy.signal import lfilter
from synthetic import response_of

import jaxquad as jq
from jaxquad.report._loop import entry_of, loop_section
from jaxquad.report._spectrum import spectrum_section, throttle_of


DT, SAMPLES = 0.004, 15000


def flown(units=("", "rad/s", "rad/s"), *, motor=60.0):
    """An integrator under proportional feedback with a motor's line in its gyro, and a throttle."""
    random = np.random.default_rng(0)
    time, throttle = DT * np.arange(SAMPLES), 0.5 + 0.2 * np.sin(0.3 * DT * np.arange(SAMPLES))
    r = np.repeat(random.standard_normal(SAMPLES // 100), 100)
    y = lfilter([0.04], [1, -0.96], r) + 0.001 * random.standard_normal(SAMPLES)
    line = 0.05 * np.sin(np.cumsum(2 * np.pi * DT * motor * (0.5 + throttle)))
    inputs = np.stack([r - y, throttle], axis=1)
    return jq.Record(
        time, inputs, y + line, r, input_names=("u0", "throttle"), output_names="y0",
        input_units=(units[0], ""), output_units=units[1], reference_units=units[2],
    )  # fmt: skip


@pytest.fixture(scope="module")
def frf():
    return response_of(jq.LaggedIntegrator(10.0, 0.01, 0.0), seed=0)


def test_the_unit_of_the_reference_says_where_it_enters(frf):
    assert entry_of(flown(("V", "rad/s", "rad/s")), frf) == "set-point"
    assert entry_of(flown(("V", "rad/s", "V")), frf) == "plant input"
    assert entry_of(flown(("V", "rad/s", "m")), frf) is None
    assert entry_of(flown(("", "", "")), frf) is None


def test_the_loop_has_the_crossover_of_the_one_that_was_simulated(frf):
    """y = 0.04 r + 0.96 y before is an integrator of its error, of 10.4 rad/s."""
    section = loop_section(frf, flown(("V", "rad/s", "rad/s"), motor=90.0))
    assert section is not None
    crossover = float(section["facts"]["crossover"].split("(")[1].split()[0])
    assert crossover == pytest.approx(10.4, rel=0.05)
    assert section["facts"]["phase margin"].startswith(("8", "9"))
    assert loop_section(frf, flown(("", "", ""))) is None


def test_a_motor_is_called_one_where_it_follows_the_throttle(frf):
    record = flown()
    assert throttle_of(record) == "throttle"
    section = spectrum_section(frf, record)
    assert section is not None
    assert len(section["images"]) == 2 and "throttle" in section["images"][1].caption
    assert section["text"].endswith("motors.")
    quiet = jq.records.select(record, inputs=["u0"], outputs=["y0"])
    poor = spectrum_section(frf, quiet)
    assert poor is not None and "Record the throttle as well" in poor["text"]
