"""Two flights over each other: verdicts by their errors, on values and on made flights."""

import dataclasses
import json
import re
from pathlib import Path

import numpy as np
import pytest
from html_pages import HOSTILE, is_image, Page, UNSEEN

from jaxquad.autopilot import (
    AxisComparison,
    ChangedSetting,
    ComparedQuantity,
    Estimate,
    FlightComparison,
    write_chirp_log,
)
from jaxquad.autopilot._comparison import combine
from jaxquad.autopilot._flight_qualities import MS, NOISE, PEAK, TORQUE
from jaxquad.cli import main
from jaxquad.plot import Spectrum, StepBand
from jaxquad.workflows import compare, CompareSettings


def estimate(value, error):
    """With a relative standard error."""
    far = float(np.exp(1.96 * error))
    return Estimate(float(value), value / far, value * far)


def quantity(ratio, error, name=NOISE, before=1.0):
    each = error / np.sqrt(2)
    values = estimate(before, each), estimate(ratio * before, each)
    return ComparedQuantity(name, *values, "by hand")


@pytest.mark.parametrize(
    ("ratio", "error", "verdict"),
    [
        (0.8, 0.05, "better"),  # 4.5 standard errors
        (1.25, 0.05, "worse"),
        (0.8, 0.09, "cannot tell"),  # 2.5 standard errors
        (1.25, 0.09, "cannot tell"),
        (1.08, 0.001, "same"),  # clear, but less than a pilot notices
        (1.0, 0.04, "same"),
        (1.0, 0.06, "cannot tell"),  # its interval holds 1.1
        (1.0, np.inf, "cannot tell"),
    ],
)
def test_a_verdict_asks_for_three_standard_errors_and_for_more_than_a_pilot_notices(
    ratio, error, verdict
):
    assert quantity(ratio, error).verdict == verdict


def test_the_interval_of_a_ratio_is_that_of_both_errors():
    ratio = quantity(0.8, 0.05).ratio
    assert ratio.value == pytest.approx(0.8)
    assert ratio.low == pytest.approx(0.8 * np.exp(-1.96 * 0.05))
    assert ratio.log_error == pytest.approx(0.05)


def test_less_of_what_is_harmless_is_no_better():
    assert quantity(0.8, 0.01, MS, before=1.7).verdict == "same"
    assert quantity(0.5, 0.01, MS, before=3.0).verdict == "better"
    assert quantity(1.2, 0.01, MS, before=1.7).verdict == "worse"
    assert quantity(0.95, 0.001, PEAK, before=1.08).verdict == "same"


def test_a_loop_at_the_edge_of_stability_is_worse_though_some_plants_have_no_peak():
    calm, edge = estimate(1.5, 0.02), Estimate(4.0, 3.0, float("inf"))
    worse = ComparedQuantity(MS, calm, edge, "by hand")
    assert worse.verdict == "worse" and "above" in worse.text
    assert ComparedQuantity(MS, edge, calm, "by hand").verdict == "better"
    lost = Estimate(float("inf"), 3.0, float("inf"))
    assert ComparedQuantity(MS, calm, lost, "by hand").verdict == "cannot tell"


def test_both_ways_are_a_trade_and_an_open_quantity_makes_no_verdict_by_itself():
    assert combine(["better", "same", "worse"]) == "trade"
    assert combine(["better", "cannot tell"]) == "better"
    assert combine(["same", "cannot tell"]) == combine([]) == "cannot tell"
    assert combine(["same", "same"]) == "same"


def test_noise_alone_decides_nothing_where_the_logs_do_not_show_the_loop():
    axis = comparison([quantity(0.5, 0.01)]).axes["roll"]
    assert axis.kind == "better"
    rested = dataclasses.replace(axis, doubt="before: it rests")
    assert rested.kind == "cannot tell" and rested.headline.reason == "before: it rests"


def test_a_difference_without_other_gains_is_one_of_the_vehicle():
    axis = comparison([quantity(0.5, 0.01)]).axes["roll"]
    assert axis.verdict.startswith("better: noise of the command (0.50 times")
    same_gains = dataclasses.replace(axis, changes=())
    assert same_gains.verdict.startswith("the vehicle or the air, not the gains; better: ")
    assert same_gains.headline.reason.endswith("so it is the vehicle or the air")


def comparison(quantities, name="roll", folder=None, text="set-point rests"):
    time, hertz = np.linspace(0, 1, 50), np.linspace(4.0, 400.0, 50)
    rise = 1 - np.exp(-20 * time)
    steps = {x: StepBand(time, rise, rise - 0.1, rise + 0.1) for x in ("before", "after")}
    noise = {x: Spectrum(hertz, 1e-3 / hertz) for x in steps}
    axis = AxisComparison(
        name, tuple(quantities), (ChangedSetting(text, "45", "54"),), (text,), "pidsum", steps,
        noise, noise,
    )  # fmt: skip
    before, after = ((folder or Path()) / f"{x}.bfl" for x in steps)
    settings, unread = CompareSettings(), {"yaw": text}
    return FlightComparison(before, after, "Betaflight", settings, {name: axis}, unread)


def test_the_report_fits_a_terminal_and_its_json_holds_what_is_shown():
    result = comparison([quantity(0.8, 0.05), quantity(1.3, 0.05, TORQUE, before=7e-3)])
    assert max(map(len, str(result).splitlines())) <= 80
    first, *_ = str(result).partition("\n\n")  # a sentence for each axis
    assert result.kind == "trade" and first.startswith("roll: A TRADE: better: noise of the")
    assert "worse: effect of a torque step (1.30 times" in " ".join(first.split())
    assert first.splitlines()[-1] == "yaw: not compared: set-point rests"
    content = json.loads(json.dumps(result.content()))
    axis = content["axes"]["roll"]
    assert [x["verdict"] for x in axis["quantities"]] == ["better", "worse"]
    assert len(axis["steps"]["before"]["middle"]) == 50 and axis["command_spectra"]["after"]


@pytest.mark.parametrize("name", HOSTILE)
def test_the_page_is_whole_and_holds_no_markup_of_a_log(tmp_path, name):
    for file in ("before.bfl", "after.bfl"):
        (tmp_path / file).write_bytes(b"log")
    result = comparison([quantity(0.8, 0.05)], folder=tmp_path, text=name)
    written = result.write(tmp_path / "out")
    assert [path.name for path in written] == ["compare.html", "compare.json"]
    text = written[0].read_text()
    page = Page(text)
    assert page.errors == [] and all(is_image(*each) for each in page.figures())
    assert len(page.of("img")) == 2 and not re.search(UNSEEN, text)
    assert json.loads(written[1].read_text())["provenance"]["files"]


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    """Chirps of one vehicle: the same gains twice, and a third more D."""
    folder = tmp_path_factory.mktemp("flights")
    gains = {"first": (45, 80, 30), "again": (45, 80, 30), "more": (45, 80, 40)}
    return {
        name: write_chirp_log(folder / f"{name}.bfl", seed, roll=pid)
        for seed, (name, pid) in enumerate(gains.items())
    }


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_the_same_gains_flown_twice_are_never_better_or_worse(flights):
    result = compare(flights["first"], flights["again"], CompareSettings(axis="roll"))
    assert result.kind in ("same", "cannot tell"), result.verdict
    axis = result.axes["roll"]
    assert not axis.changes and any("no gain or filter differs" in x for x in axis.remarks)


@pytest.mark.slow
@pytest.mark.usefixtures("compiled_quickly")
def test_other_gains_are_a_difference_with_its_size(flights, tmp_path, capsys):
    words = ["compare", str(flights["first"]), str(flights["more"]), "--axis", "roll"]
    code = main([*words, "--out", str(tmp_path), "--json", "--quiet"])
    content = json.loads(capsys.readouterr().out)
    axis = content["axes"]["roll"]
    ratios = {x["name"]: x["ratio"] for x in axis["quantities"]}
    assert {x["name"]: (x["before"], x["after"]) for x in axis["changes"]}["d_roll"] == ("30", "40")
    # P makes noise, too: the command's grows by less than D.
    assert 1.1 < ratios[NOISE]["low"] < 40 / 30 and ratios[PEAK]["value"] < 1
    verdicts = {x["name"]: x["verdict"] for x in axis["quantities"]}
    assert verdicts[NOISE] == "worse" and "better" not in verdicts.values()
    assert code == 0 and content["kind"] == "worse" and (tmp_path / "compare.html").exists()


def test_a_missing_file_is_named(tmp_path, capsys):
    assert main(["compare", str(tmp_path / "a.bbl"), str(tmp_path / "b.bbl")]) == 2
    assert "a.bbl" in capsys.readouterr().err
