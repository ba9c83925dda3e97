"""The page of a proposal for an autopilot: whole, harmless, and of the numbers it was given."""

import dataclasses
import re

import numpy as np
import pytest
from html_pages import HOSTILE, Page, UNSEEN

import jaxquad.plot
import jaxquad.report
from jaxquad.autopilot import (
    _page,
    FilterChain,
    PilotPage,
    propose_changes,
    PT1,
    write_pilot_page,
)
from jaxquad.autopilot._proposal import at_limit
from jaxquad.plot import FlownAgain, Spectrum, StepBand
from jaxquad.report import Headline, provenance, Table
from jaxquad.workflows import AutopilotSettings


FLOWN = {
    "gyro": (FilterChain((PT1(200.0),), 8000.0), FilterChain((PT1(90.0),), 4000.0)),
    "D term": (FilterChain((PT1(100.0),), 4000.0),),
}


def page(name: str) -> PilotPage:
    hertz, time = np.linspace(2.0, 400.0, 200), np.linspace(0.0, 1.0, 100)
    rise = 1.2 - 1.2 * np.exp(-20 * time)
    noise = Spectrum(hertz, 1e-4 / hertz)
    return PilotPage(
        title=name,
        headlines=[Headline("good", "PROPOSED", name), Headline("warn", "FILTERS", name)],
        filters={"flown": FLOWN},
        remarks=[name],
        gyro={"before the filters": noise, "flown": noise},
        derivative={"flown": noise},
        noise=name,
        steps={"flown": StepBand(time, rise, rise - 0.1, rise + 0.1)},
        terms={"P": 3.0, "I": 1.0, "D": 2.0, "F": 0.0},
        terms_are="as logged",
        motors=[("motor 1", 0.0125, 0.25)],
        changes=Table("From what flew", ("parameter", "old", "new"), [["p_roll", "28", "40"]]),
        unit="pidsum",
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["flight.bbl", *HOSTILE])
def test_any_name_leaves_the_page_whole_and_without_strangers(tmp_path, name):
    text = write_pilot_page(tmp_path / "page.html", page(name)).read_text(encoding="utf-8")
    found = Page(text)
    assert not found.errors and not re.search(UNSEEN, text)
    assert len(found.of("script")) == 1 and len(found.of("img")) == 4
    assert all(each["src"].startswith("data:image/") for each in found.of("img"))


def test_the_page_says_the_shares_of_the_delay_and_of_the_motors(tmp_path):
    text = write_pilot_page(tmp_path / "page.html", page("roll")).read_text(encoding="utf-8")
    cells = [words.strip() for _, words in Page(text).texts if words.strip()]
    late = [float(each.delay_ms([10.0])[0]) for each in FLOWN["gyro"]]
    assert cells[cells.index("all of the gyro's") + 2] == f"{sum(late):.2f}"
    assert cells[cells.index("pt1 90 Hz") + 2] == f"{late[1]:.2f}"
    assert cells[cells.index("motor 1") + 1 :][:2] == ["1.25", "25.00"]
    row = cells.index("Step responses")
    assert "20" in cells[row:]  # % of overshoot, of the median
    assert cells[cells.index("p_roll") + 1 :][:2] == ["28", "40"]


def test_old_and_new_are_beside_the_name_and_each_reason_stands_once_below(tmp_path):
    """A wide column of reasons would move the numbers off the screen of a phone."""
    old = {"p_roll": 45.0, "i_roll": 80.0, "d_roll": 30.0}
    new = {"p_roll": 97.0, "i_roll": 240.0, "d_roll": 43.0}
    reasons = dict.fromkeys(new, "less effect of torque") | {
        "i_roll": "less effect of torque\nat the limit"
    }
    table = _page.change_rows(propose_changes("betaflight", old, new, reasons=reasons))
    shown = dataclasses.replace(page("roll"), changes=table)
    text = write_pilot_page(tmp_path / "page.html", shown).read_text(encoding="utf-8")
    cells = [words.strip() for _, words in Page(text).texts if words.strip()]
    assert cells[cells.index("i_roll") + 1 :][:2] == ["80", "240"]
    assert max(len(cell) for row in table.rows for cell in row[1:]) < 12
    assert text.count("less effect of torque") == 1
    assert "p_roll, i_roll, d_roll: less effect of torque" in cells
    assert "i_roll: at the limit" in cells


def test_files_are_linked_and_their_texts_are_there_to_paste(tmp_path):
    files = {"proposal_033.txt": "set p_roll = 62\nsave\n", "proposal_revert.txt": "<b>&"}
    two = [page("roll"), page("pitch")]
    for pages in (two[:1], two):
        path = write_pilot_page(tmp_path / "page.html", *pages, files=files)
        shown = Page(path.read_text(encoding="utf-8"))
        assert not shown.errors
        links = [each["href"] for each in shown.of("a") if "download" in each]
        assert links == list(files)
        assert [words for within, words in shown.texts if within[-1:] == ("pre",)] == [
            *files.values()
        ]


def test_a_gain_at_the_limit_of_change_says_so():
    old, new = {"p": 10.0, "i": 80.0, "d": 30.0}, {"p": 29.9, "i": 15.0, "d": 40.0}
    said = at_limit(old, new, 3.0)
    assert said.keys() == {"p", "i"}
    assert said["p"].startswith("at the limit") and said["i"].startswith("beyond the limit")


def test_overshoot_and_the_growth_of_noise_are_said_in_words():
    said = _page.limits_text(AutopilotSettings(resonance=1.3, noise=2.0, change=4.0))
    assert "overshoot of up to about 30 %" in said
    assert "noise, which heats the motors, may grow 2 times" in said and "4 times" in said


def test_what_a_log_does_not_hold_has_no_section(tmp_path):
    bare = PilotPage("roll", [Headline("bad", "THIS LOG CANNOT TELL", "fly more")], {"flown": {}})
    text = write_pilot_page(tmp_path / "page.html", bare).read_text(encoding="utf-8")
    ids = [each["id"] for each in Page(text).of("section")]
    assert ids == ["changes", "filters"] and "holds what flew" in text


def test_the_page_of_several_axes_has_each_of_them_behind_its_verdict(tmp_path):
    time = np.linspace(0.0, 1.0, 200)
    again = FlownAgain(time, np.sin(time), np.sin(time), np.sin(time - 0.01))
    pages = [dataclasses.replace(page(x), again=again, again_text=f"{x} again") for x in "ab"]
    pages[0] = dataclasses.replace(pages[0], overview="firmware 1, rate loops")
    shown = Page(write_pilot_page(tmp_path / "page.html", *pages).read_text(encoding="utf-8"))
    ids = [each["id"] for each in shown.of("section")]
    assert not shown.errors and len(set(ids)) == len(ids)
    assert {"axis-1", "axis-2", "steps-1", "again-2"} <= set(ids)
    links = {each["href"] for each in shown.of("a") if "href" in each}
    assert {"#axis-1", "#axis-2"} <= links
    assert "firmware 1, rate loops" in shown.text("h1")
    assert all(f"{x} again" in shown.text("section") for x in "ab")


@pytest.mark.parametrize("name", sorted(_page.SECTIONS))
def test_a_section_that_raises_says_why_and_costs_no_other(tmp_path, monkeypatch, name):
    stubs = dict.fromkeys(_page.SECTIONS, lambda _: {"failed": "left out here"})
    stubs[name] = lambda _: {}["rate"]
    monkeypatch.setattr(_page, "SECTIONS", stubs)
    text = write_pilot_page(tmp_path / "page.html", page("roll")).read_text(encoding="utf-8")
    shown = Page(text)
    assert not shown.errors and "p_roll" in shown.text("section")
    assert shown.text("section").count("Could not be computed: left out") == len(stubs) - 1
    assert shown.text("section").count("Could not be computed: KeyError: 'rate'") == 1


def test_provenance_and_figures_may_fail_too(tmp_path, monkeypatch):
    monkeypatch.setattr(jaxquad.plot, "steps_figure", lambda *_, **__: 1 / 0)
    monkeypatch.setattr(jaxquad.report, "provenance_section", lambda _: 1 / 0)
    whole = dataclasses.replace(page("roll"), provenance=provenance())
    text = write_pilot_page(tmp_path / "page.html", whole).read_text(encoding="utf-8")
    shown = Page(text)
    assert not shown.errors and len(shown.of("img")) == 3
    assert "figure could not be drawn: ZeroDivisionError" in shown.text("section")
    assert "Could not be computed: ZeroDivisionError" in shown.text("section")
    assert "Step responses" in shown.text("section")  # its table


def test_the_step_of_the_log_itself_stands_beside_those_of_the_plants(tmp_path):
    time = np.linspace(0.0, 1.0, 100)
    rise = 1 - np.exp(-40 * time)
    measured = StepBand(time, rise, rise - 0.05, rise + 0.05)
    for steps in (page("roll").steps, {}):  # of a log that does not determine the plant
        both = dataclasses.replace(page("roll"), steps=steps, measured=measured)
        text = write_pilot_page(tmp_path / "page.html", both).read_text(encoding="utf-8")
        shown = Page(text)
        assert not shown.errors and "Step responses" in shown.text("section")
        assert "measured" in shown.text("table")


def test_what_the_caller_could_not_compute_is_said_where_it_would_stand(tmp_path):
    lost = dataclasses.replace(page("roll"), steps={}, failures={"steps": "no plant is stable"})
    text = write_pilot_page(tmp_path / "page.html", lost).read_text(encoding="utf-8")
    assert "Could not be computed: no plant is stable" in Page(text).text("section")
