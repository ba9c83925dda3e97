"""The step, the broken loop and the spectrum of a page: where they are shown, what they say."""

import numpy as np
import pytest
from html_pages import read_page
from scipy.signal import lfilter
from synthetic import response_of

import jaxquad as jq
from jaxquad.plot import StepBand
from jaxquad.report import LawLoop, write_report
from jaxquad.report._loop import entry_of, loop_section, predict_step, step_section
from jaxquad.spectra import BrokenLoop, estimate_step


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


def law_loop(top, *, model=True, crossover=10.0):
    """A loop crossover / s with a delay, up to so many rad/s."""
    ends = np.geomspace(1.0, top, 40), np.geomspace(1.0, 400.0, 300)
    of = lambda w: crossover / (1j * w) * np.exp(-0.01j * w)
    loops = [BrokenLoop(w, of(w), np.full(w.size, 0.01), np.ones(w.size)) for w in ends]
    time = np.linspace(0.0, 1.0, 50)
    step = StepBand(time, 1 - np.exp(-10 * time), 0 * time, 1 + 0 * time)
    return LawLoop(loops[0], loops[1] if model else None, step, ("anti-gravity",))


def test_a_known_law_gives_the_margins_whatever_the_reference_is(frf):
    record = flown(("", "", ""))
    section = loop_section(frf, record, law_loop(400.0))
    assert section is not None and not section["image"].failure
    facts = section["facts"]
    assert facts["crossover"].startswith("1.59 Hz (10 rad/s)")
    assert facts["phase margin"].startswith("84.3")  # 90 deg - 10 rad/s 0.01 s
    assert facts["gain margin"].startswith("23.9 dB at 25 Hz") and "model" not in str(facts)
    assert "law of the log's parameters" in section["note"] and "anti-gravity" in section["note"]


def test_what_the_measured_response_does_not_reach_is_said_by_the_model(frf):
    section = loop_section(frf, flown(("", "", "")), law_loop(60.0))
    assert section is not None
    assert "23.9 dB at 25 Hz (157 rad/s) by the identified model" in section["facts"]["gain margin"]
    assert "model" not in section["facts"]["crossover"]
    low = loop_section(frf, flown(("", "", "")), law_loop(6.0))
    assert low is not None and "by the identified model" in low["facts"]["crossover"]
    alone = loop_section(frf, flown(("", "", "")), law_loop(60.0, model=False))
    assert alone is not None and alone["facts"]["gain margin"].startswith("not seen")


def test_a_step_that_the_log_does_not_show_is_computed_by_the_law(frf):
    """One step in a minute is too few."""
    quiet = flown(("V", "rad/s", "rad/s"))
    r = np.where(np.arange(SAMPLES) > SAMPLES // 2, 1.0, 0.0)
    record = jq.Record(
        quiet.time, quiet.inputs[:, 0], quiet.outputs, r, input_names="u0", output_names="y0"
    )
    fit = jq.fit(jq.LaggedIntegrator(10.0, 0.01, 0.0), frf, free=("gain", "lag"))
    section = step_section(fit, frf, record, (), law_loop(60.0).step)
    assert section is not None and section["doubts"]
    assert "computed from the law" in section["computed"].caption
    bare = step_section(fit, frf, record)
    assert bare is not None and bare["computed"] is None


@pytest.mark.slow
def test_a_motor_is_called_one_where_it_follows_the_throttle(frf, tmp_path):
    fit = jq.fit(jq.LaggedIntegrator(10.0, 0.01, 0.0), frf, free=("gain", "lag"))
    record = flown()
    alone = jq.records.select(record, inputs=["u0"], outputs=["y0"])
    pages = [
        read_page(write_report(tmp_path / "page.html", fit=fit, frf=frf, spectrum=each))
        for each in (record, alone)
    ]
    assert any("Spectrum of y0 over throttle" in page.text("figcaption") for page in pages[:1])
    assert "motors." in pages[0].text("p") and "Record the throttle as well" in pages[1].text("p")


@pytest.fixture(scope="module")
def stepped():
    """A lagged integrator under proportional feedback, flown by steps, in weak gusts."""
    random, samples = np.random.default_rng(2), 15000
    r = np.repeat(random.standard_normal(samples // 150), 150)
    u, y = np.zeros((2, samples))
    rate = moment = 0.0
    for k in range(samples):
        y[k] = rate + 0.001 * random.standard_normal()
        u[k] = 0.04 * (r[k] - y[k])
        stay = np.exp(-DT / 0.03)
        mean = u[k] + (moment - u[k]) * (1 - stay) * 0.03 / DT
        rate += DT * 280.0 * mean + 0.001 * random.standard_normal()
        moment = u[k] + (moment - u[k]) * stay
    return jq.Record(
        np.arange(samples) * DT, u, y, r, input_names="u0", output_names="y0",
        output_units="rad/s", reference_units="rad/s", hold="dt",
    )  # fmt: skip


def fit_of(gain):
    model = jq.LaggedIntegrator(gain, 0.03, 0.0)
    frf = response_of(model, error=0.01, seed=0)
    return jq.fit(model, frf, free=("gain", "lag")), frf


def test_the_right_model_predicts_the_measured_step_and_a_wrong_one_does_not(stepped):
    found = estimate_step(stepped)
    inside = {}
    for gain in (280.0, 0.6 * 280.0):
        fit, frf = fit_of(gain)
        predicted = predict_step(fit, frf, stepped)
        assert predicted is not None
        assert predicted.error is not None
        error = np.hypot(predicted.error, found.standard_error)
        early = (found.time > 0.05) & (found.time < 0.5)
        inside[gain] = np.abs(predicted.mean - found.mean)[early] < 3 * error[early] + 0.02
    assert np.mean(inside[280.0]) > 0.95 and np.mean(inside[0.6 * 280.0]) < 0.3


def test_the_section_says_that_the_data_suffice_and_shows_both(stepped):
    fit, frf = fit_of(280.0)
    section = step_section(fit, frf, stepped)
    assert section is not None
    assert not section["doubts"] and "The data suffice" in section["notes"][0]
    assert section["table"].heads == ("", "measured", "model")
    assert "prediction of the model" in section["image"].alt


def test_no_reference_gives_no_section_and_a_poor_one_no_figure(stepped):
    fit, frf = fit_of(280.0)
    bare = jq.Record(stepped.time, stepped.inputs, stepped.outputs, output_names="y0")
    assert step_section(fit, frf, bare) is None
    quiet = np.zeros_like(stepped.time)
    quiet[5000:5200] = 1.0
    poor = jq.Record(
        stepped.time, stepped.inputs, stepped.outputs, quiet, input_names="u0", output_names="y0"
    )
    section = step_section(fit, frf, poor)
    assert section is not None and section["doubts"] and section["image"] is None
