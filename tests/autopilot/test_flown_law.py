"""The gyro's filters are divided out of an autopilot's model, and its loop is that of its law."""

import dataclasses
import json

import numpy as np
import pytest
from html_pages import read_page
from scipy.signal import lfilter
from sweep_logs import write_sweep

from jaxquad._core import Message
from jaxquad.autopilot import (
    best_filters,
    BetaflightPID,
    Butterworth,
    FilterChain,
    FlightChannels,
    FlownLaw,
    FlownLoop,
    loop_of_law,
    Notch,
    PT1,
    StoredFilters,
)
from jaxquad.cli import main
from jaxquad.workflows import (
    identify,
    identify_again,
    IdentifySettings,
    load_result,
    tune,
    TuneSettings,
    verify_result,
)


CHAIN = FilterChain((Butterworth(20.0), PT1(60.0)), 400.0)
AT = np.array([0.5, 3.0, 20.0, 150.0])


def law_of(found):
    """The flown loop of an identification."""
    [unit] = found.records[0].output_units
    return loop_of_law(found.flown, found.fit, found.frf, found.filters, unit)


@pytest.fixture
def log(data):
    """The path of a log that a firmware flew."""

    def path_of(name):
        folder = "ardupilot" if name.endswith(".BIN") else "betaflight"
        path = data / f"{folder}_firmware" / name
        if not path.is_file():
            pytest.skip(f"{path} is not there")
        return path

    return path_of


def test_stored_filters_are_those_that_were_divided_out():
    content = FlownLaw((CHAIN,), "as the parameters say", chains=(CHAIN,)).content()
    stored = StoredFilters.of(content)
    assert np.allclose(stored.response(AT), np.asarray(CHAIN.response(AT)), rtol=1e-12)
    late = StoredFilters.of(content | {"correction": {"delay_s": 1e-3, "lag_s": 2e-3}})
    more = np.exp(-2j * np.pi * AT * 1e-3) / (1 + 2j * np.pi * AT * 2e-3)
    assert np.allclose(late.response(AT), stored.response(AT) * more)
    with pytest.raises(ValueError, match="identify again"):
        StoredFilters.of({"chains": [{}]})


@pytest.mark.slow
def test_ardupilots_filters_are_divided_out_and_the_result_stays_one(log, tmp_path, capsys):
    """True: 25067 deg/s^2, lag .030 s, no delay, Ms of the rate loop 1.80."""
    path = log("rate_chirp_pitch.BIN")
    found = identify(path, IdentifySettings(axis="pitch"))
    assert "Butterworth 2 20 Hz, are divided out: 12 ms at 10 Hz" in str(found)
    low, high = found.fit.interval("gain")
    assert low < 25067 < high and high - low < 0.03 * 25067
    assert found.fit.interval("lag")[0] < 0.030 < found.fit.interval("lag")[1] + 1e-4
    assert found.fit["delay"] < 5e-4
    loop = law_of(found)
    assert loop is not None and loop.model is not None and loop.step is not None
    assert np.max(1 / np.abs(1 + loop.model.response)) == pytest.approx(1.80, abs=0.03)
    assert loop.measured.crossover == pytest.approx(loop.model.crossover, rel=0.02)
    assert loop.step.middle[-1] == pytest.approx(1.0, abs=0.02)

    found.write(tmp_path)
    page = read_page(tmp_path / "report.html")
    assert "are divided out: 12 ms at 10 Hz" in page.text("header")
    assert "The law of the log's parameters" in page.text("section")
    assert "computed from the law" in page.text("figcaption")
    stored = load_result(tmp_path)
    [filters] = stored.filters
    assert np.allclose(filters.response(AT), np.asarray(found.filters[0].response(AT)), rtol=1e-9)
    assert identify_again(tmp_path).fit.values == pytest.approx(found.fit.values, rel=1e-9)

    kept = tmp_path / "kept"
    words = ["identify", str(path), "--axis", "pitch", "--keep-gyro-filters", "--out", str(kept)]
    assert main([*words, "--quiet"]) == 0
    assert "filters are in the model, as --keep-gyro-filters asks" in capsys.readouterr().out
    result = json.loads((kept / "result.json").read_text())
    assert "gyro_filters" not in result and load_result(kept).filters == ()
    delay = next(x["value"] for x in result["fit"]["parameters"] if x["name"] == "delay")
    assert 0.009 < delay < 0.014  # s
    fits = [verify_result(each, path).fit_percent for each in (tmp_path, kept)]
    assert fits[0] > fits[1] - 0.5  # a delay stands for the filter only about


@pytest.mark.slow
@pytest.mark.parametrize("name", ["A_chirp_roll.BFL", "A_sticks.BFL"])
def test_betaflights_page_has_a_step_and_the_margins_of_its_law(log, tmp_path, name):
    """Sticks and chirp of one vehicle and one set of gains: the same loop, whatever F adds."""
    found = identify(log(name), IdentifySettings(axis="roll"))
    loop = law_of(found)
    assert loop is not None and loop.model is not None
    margin, error = loop.measured.phase_margin
    assert loop.measured.crossover == pytest.approx(40.0, rel=0.03)
    assert np.degrees(margin) == pytest.approx(48.0, abs=2) and np.degrees(error) < 2
    assert loop.model.crossover == pytest.approx(40.0, rel=0.03)
    found.write(tmp_path)
    page = read_page(tmp_path / "report.html")
    alts = [each["alt"] for each in page.of("img")]
    assert any("after a step of 1" in each for each in alts)
    assert any(hertz in page.text("dd") for hertz in ("6.3", "6.4"))
    assert "The law of the log's parameters" in page.text("section")


@pytest.mark.slow
def test_a_loop_of_ones_own_is_tuned_behind_the_filters(tmp_path):
    path = write_sweep(tmp_path / "sweep.csv")
    asked = IdentifySettings(input="M=right-left", output="q", units={"q": "rad/s"}, band=(0.5, 6))
    found = identify(path, asked)
    ahead = dataclasses.replace(found, flown=FlownLaw((CHAIN,), "as the parameters say"))
    assert ahead.filters and not found.filters
    with pytest.raises(ValueError, match="keep_gyro_filters=True"):
        tune(ahead, TuneSettings(inertia=0.01, limit=1.0))


def test_notches_that_follow_the_motors_are_divided_out_as_measured():
    """30 s at 1 kHz: random motion, through a low-pass that is known and a notch that is not."""
    known = FilterChain((PT1(250.0),), 1000.0)
    whole = FilterChain((PT1(250.0), Notch(120.0, 2.0)), 1000.0)
    raw = np.cumsum(np.random.default_rng(0).standard_normal(30000))
    raw = np.asarray(lfilter([0.01], [1.0, -0.99], raw)) - raw.mean()
    rate = raw
    for section in whole.sections():
        b0, b1, a1, b2, a2 = (0.0 if x is None else float(x) for x in section)
        rate = np.asarray(lfilter([b0, b1, b2], [1.0, a1, a2], rate))
    names = ("gyroADC[0]", "gyroUnfilt[0]")
    law = BetaflightPID(p=45, i=80, d=30, gyro=known, dt=1e-3)
    hidden = FlownLoop(law, (Message("3 RPM notches per motor on the gyro: x", "notch"),))
    flight = FlightChannels(
        (rate,), 1e-3, 0 * rate, unfiltered=(raw,), unfiltered_dt=1e-3, names=names
    )
    [measured], text = best_filters(hidden, flight, 0)
    assert text.startswith("the gyro's filters are divided out, measured: gyroADC[0] over gyroUnf")
    truth, at = np.asarray(whole.response(np.array([5.0, 10.0, 20.0]))), np.array([5.0, 10.0, 20.0])
    assert np.max(np.abs(np.asarray(measured.response(at)) / truth - 1)) < 0.01
    same = best_filters(FlownLoop(law), flight, 0)
    assert same[0] == (known,) and "pt1 250 Hz, are divided out" in same[1]
    still = dataclasses.replace(flight, unfiltered=(0 * raw,))
    chains, text = best_filters(hidden, still, 0)
    assert chains == (known,) and "3 RPM notches per motor on the gyro, which could not be" in text
