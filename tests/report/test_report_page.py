"""One page that tells all of a fit, and that nothing in a log can turn into something else."""

import base64
import dataclasses
import hashlib
import json
import re
from datetime import datetime, UTC
from importlib.metadata import version

import equinox as eqx
import numpy as np
import pytest
from html_pages import (
    ERROR,
    flown_by_hand,
    HOSTILE,
    is_image,
    read_page,
    record_of,
    TRUTH,
    tuned_by_hand,
    UNSEEN,
)
from synthetic import response_of

import jaxquad as jq
from jaxquad.identify import UndeterminedError
from jaxquad.report import (
    _report,
    provenance,
    reason_of,
    write_report,
)


ORIGIN = provenance(command="jaxquad identify flight.csv")


@pytest.fixture(scope="module")
def frf():
    return response_of(TRUTH, error=ERROR, seed=0)


@pytest.fixture(scope="module")
def fit(frf):
    return jq.fit(TRUTH, frf)


@pytest.fixture(scope="module")
def record():
    return record_of(("M", "q", "r"), ("V", "rad/s", ""))


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "flight & <sweep>.csv"
    path.write_bytes(bytes(range(256)) * 9)
    return path


@pytest.fixture(scope="module")
def whole(tmp_path_factory, frf, fit, record, log):
    """A page with everything in it."""
    path = tmp_path_factory.mktemp("page") / "new" / "report.html"
    assert path == write_report(
        path,
        fit=fit,
        frf=frf,
        others={"direct estimate": frf},
        record=record,
        checks={"other.csv": jq.verify(TRUTH, record)},
        derived=[fit.derived(lambda m: m.lag + m.delay, "lag + delay")],
        tuned=tuned_by_hand(),
        flights={"nominal": flown_by_hand()},
        provenance=provenance(log, command="jaxquad identify 'a & b.csv' --input M"),
        formula="q / M = K e^(-delay s) / (s (lag s + 1))",
    )
    return path


def test_the_page_is_well_formed_and_holds_every_section(whole):
    page = read_page(whole)
    assert page.errors == [] and page.of("html") == [{"lang": "en"}]
    names = [attributes["id"] for attributes in page.of("section")]
    assert names == [
        "answers", "tuned", "response", "parameters", "identifiability", "verification", "record",
        "provenance",
    ]  # fmt: skip
    links = [attributes["href"] for attributes in page.of("a")]
    assert links == [f"#{name}" for name in names]
    assert len(page.of("h1")) == 1
    assert "could not be" not in page.text().lower()


SECTIONS = {
    "answers": (_report, "answer_section"), "step": (_report, "step_section"),
    "loop": (_report, "loop_section"), "tuned": (_report, "tuned_section"),
    "response": (_report, "response_section"), "parameters": (_report, "parameter_section"),
    "identifiability": (_report, "identifiability_section"),
    "verification": (_report, "check_section"), "spectrum": (_report, "spectrum_section"),
    "record": (_report, "record_section"), "provenance": (_report, "provenance_section"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", SECTIONS)
def test_a_section_that_raises_says_why_and_costs_no_other(tmp_path, frf, fit, monkeypatch, name):
    record = record_of(("u0", "y0", "r"), ("V", "rad/s", "V"))
    drawn = ("step", "loop", "response", "spectrum", "record")  # which takes long
    for section in drawn:
        monkeypatch.setattr(*SECTIONS[section], lambda *_: {"failed": "left out here"})
    monkeypatch.setattr(*SECTIONS[name], lambda *_: 1 / 0)
    path = write_report(
        tmp_path / "report.html", fit=fit, frf=frf, record=record, tuned=tuned_by_hand(),
        checks={"other.csv": jq.verify(TRUTH, record)}, provenance=ORIGIN,
    )  # fmt: skip
    page = read_page(path)
    assert page.errors == []
    assert [each["id"] for each in page.of("section")] == list(SECTIONS)
    shown = page.text("section")
    assert shown.count("Could not be computed: ZeroDivisionError: division by zero") == 1
    assert shown.count("Could not be computed: left") == 5 - (name in drawn)


def test_errors_of_the_package_speak_for_themselves():
    assert reason_of(UndeterminedError("too few\npoints")) == "too few points"
    assert reason_of(KeyError("rate")) == "KeyError: 'rate'"


@pytest.mark.slow
def test_a_figure_that_cannot_be_drawn_leaves_its_section(tmp_path, frf, fit, record, monkeypatch):
    monkeypatch.setattr(jq.plot, "record_figure", lambda *_: 1 / 0)
    page = read_page(write_report(tmp_path / "report.html", fit=fit, frf=frf, record=record))
    assert page.errors == [] and len(page.of("img")) == 2  # of the response
    assert "figure could not be drawn: ZeroDivisionError" in page.text("section")
    assert "4000 samples" in page.text("section")


def test_the_verdict_is_the_first_that_is_read(whole, fit):
    page = read_page(whole)
    assert page.text().split()[:3] == ["\u2713", "IDENTIFIED", "y0"]
    assert page.text("title").startswith("IDENTIFIED: y0 / u0")
    first = page.text("header")
    assert f"gain = {fit.values[0]:.4g}" in first and "VERIFIED other.csv" in first
    assert "STABILITY FAILS Ms, worst, at most 1.5: 2, missed" in first
    assert "PERFORMANCE 12 of 12 members" in first and "CONVERGENCE 2 gradients" in first


def test_the_tuned_gains_are_shown_in_flight(whole):
    texts = [attributes["alt"] for attributes in read_page(whole).of("img")]
    assert "Angle with its set-point, command and disturbing torque over time: nominal." in texts


def test_nothing_is_fetched_and_no_script_runs_but_the_one_of_the_page(whole):
    page = read_page(whole)
    assert whole.stat().st_size < 1_500_000
    assert page.of("script") == [{}]
    for name, attributes in page.elements:
        assert not any(key.startswith("on") for key in attributes), name
        assert all(key not in attributes for key in ("srcset", "data", "action")), name
    assert all(a["src"].startswith("data:image/") for a in page.of("img"))
    assert all(a["href"].startswith("#") for a in page.of("a")) and not page.of("link")
    assert not re.search(r"url\(|@import|https?:", whole.read_text())
    [policy] = [a["content"] for a in page.of("meta") if "http-equiv" in a]
    assert policy.startswith("default-src 'none'; img-src data:;")
    digest = hashlib.sha256(page.text("script").encode()).digest()
    assert policy.endswith(f"script-src 'sha256-{base64.b64encode(digest).decode()}'")


def test_a_pointer_reads_the_numbers_that_are_drawn(whole, frf):
    figures = [json.loads(a["data-curves"]) for a in read_page(whole).of("figure")]
    magnitude = next(f for f in figures if f and f[0]["up"].endswith("dB"))[0]
    name, omega, decibels = magnitude["series"][0]
    assert name == "joint estimate" and magnitude["x"][2] is True
    np.testing.assert_allclose(omega, np.asarray(frf.omega), rtol=1e-3)
    np.testing.assert_allclose(decibels, frf.magnitude_db[:, 0, 0], rtol=1e-3)
    left, top, width, height = magnitude["box"]
    assert 0 < left < left + width < 1 and 0 < top < top + height < 1


def test_figures_are_images_with_a_text_for_those_who_cannot_see_them(whole):
    page = read_page(whole)
    assert len(page.of("img")) == 7
    assert all(is_image(*each) for each in page.figures())
    assert all(len(attributes["alt"]) > 30 for attributes in page.of("img"))
    assert any("reference r, input M, output q" in each["alt"] for each in page.of("img"))


def test_numbers_are_those_of_the_fit(whole, fit):
    text = read_page(whole).text("section")
    for k, name in enumerate(fit.names):
        low, high = fit.interval(name)
        assert (
            f"{name}{fit.values[k]:.5g}{fit.standard_errors[k]:.2g}{low:.5g} .. {high:.5g}" in text
        )
        assert f"{fit.cramer_rao[k]:.2f}{fit.insensitivity[k]:.2f}" in text
    assert f"lag{fit.correlation[1, 0]:.2f}1{fit.correlation[1, 2]:.2f}" in text


def test_tuned_gains_stand_beside_their_certificate(whole):
    text = read_page(whole).text("section")
    assert "ladrc.wc5.25" in text and "a remark of the tuner" in text
    assert "unstable, %found016.7" in text and "unstable, % (95 % confidence)at most" in text
    assert "ITAE, deg s^2mean840" in text and "Ms, worst, at most 1.5: 2, missed by 0.5" in text


def test_the_source_can_be_checked_and_made_again(whole, log):
    text = read_page(whole).text("section")
    assert f"{log.name}, 2304 bytes, SHA-256 {hashlib.sha256(log.read_bytes()).hexdigest()}" in text
    assert "jaxquad identify 'a & b.csv' --input M" in text
    assert f"jaxquad {version('jaxquad')}, jax {version('jax')}" in text
    assert f"numpy {np.__version__}" in text


def test_equal_results_give_equal_bytes(tmp_path, frf, fit, log):
    origin = provenance(log, date=datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC))
    assert origin.date == "2026-01-02T03:04:05+00:00"
    pages = [write_report(tmp_path / name, fit=fit, frf=frf, provenance=origin) for name in "ab"]
    assert pages[0].read_bytes() == pages[1].read_bytes()


@pytest.mark.slow
def test_names_from_a_log_are_shown_and_not_obeyed(tmp_path, frf, fit, whole):
    """Every name, unit, remark, file name and command is hostile, each in another way."""
    u, y, r, unit, source, words = HOSTILE
    record = record_of((u, y, r), (unit, source, words), source=source)
    named = dataclasses.replace(
        frf, input_names=(u,), output_names=(y,), remarks=(jq.spectra.Remark(words),)
    )
    outside = dataclasses.replace(
        fit, remarks=tuple(map(jq.spectra.Remark, HOSTILE)), names=(r, u, "delay")
    )
    path = write_report(
        tmp_path / "report.html", fit=outside, frf={unit: named}, others={source: named},
        record=record, checks={words: jq.verify(TRUTH, record)}, title=r, formula=u,
        derived=[jq.identify.Combination(unit, 1.0, 0.1)],
        provenance=provenance(command=y, settings={words: source}),
    )  # fmt: skip
    page, known = read_page(path), read_page(whole)
    assert page.errors == []
    assert {name for name, _ in page.elements} <= {name for name, _ in known.elements}
    assert len(page.of("img")) == 5 and all(is_image(*each) for each in page.figures())
    assert not re.search(UNSEEN, path.read_bytes().decode())
    shown = page.text("section")
    assert all(name in shown for name in (u, y, unit))
    assert "\ufffdcod.exe\u200f \u05d0\u05d1 \ufffdx" in page.text("h1")


def test_not_identifiable_comes_first_and_marks_its_numbers(tmp_path, frf):
    """One record tells L K_t / J_x of an attitude axis, and neither of the two."""
    axis = jq.models.AttitudeAxis(L=0.2, K_t=0.1, J_x=0.05, lag=0.02, delay=0.0)
    response = response_of(axis, error=0.02, seed=1)
    fit = jq.fit(axis, response, free=("J_x", "K_t", "lag"))
    page = read_page(write_report(tmp_path / "report.html", fit=fit, frf=response))
    assert page.text().split()[:3] == ["\u2717", "NOT", "IDENTIFIABLE"]
    assert "individually: J_x and K_t; only L K_t / J_x = " in page.text("header")
    tables, text = page.text("table"), page.text("section")
    assert tables.count("not determined") == 2 and "nan" not in text
    assert "Null directions" in text and "direction 1" in text and "jq.identify.Prior" in text


@pytest.mark.slow
def test_what_could_not_be_fitted_has_a_page_too(tmp_path, frf, record):
    weak = eqx.tree_at(lambda f: f.coherence, frf, frf.coherence * 0.1)
    blind = eqx.tree_at(
        lambda f: (f.response, f.random_error),
        weak,
        (weak.response.at[3:].set(np.nan), weak.random_error.at[3:].set(np.inf)),
    )
    none = jq.fit(TRUTH, weak)
    page = read_page(write_report(tmp_path / "r.html", fit=none, frf=blind, record=record))
    assert page.errors == [] and all(is_image(*each) for each in page.figures())
    words = page.text("header").split()
    assert words[:6] == ["\u2717", "NOT", "IDENTIFIABLE", "y0", "/", "u0"]
    assert "parameters" not in [attributes["id"] for attributes in page.of("section")]


def header_of(tmp_path, **content):
    """The words at the top of a page."""
    return read_page(write_report(tmp_path / "r.html", **content)).text("header")


def test_a_misfit_and_a_failed_verification_are_in_the_header(tmp_path, frf, fit, record):
    off = dataclasses.replace(
        fit, chi_squared=16.0, remarks=(jq.spectra.Remark("the misfit is 4.0 times"),)
    )
    check = jq.verify(jq.LaggedIntegrator(-280.0, 0.016, 0.011), record)
    header = header_of(tmp_path, fit=off, frf=frf, checks={"b": check})
    assert "! IDENTIFIED, but the misfit is 4.0 times the random error" in header
    assert "\u2717 VERIFICATION FAILS b: fit" in header and "the misfit is 4.0 times" in header


def test_remarks_and_missing_certificates_are_in_the_header(tmp_path, frf, fit):
    remarked = dataclasses.replace(
        fit, remarks=(jq.spectra.Remark("one"), jq.spectra.Remark("two"))
    )
    tuned = dataclasses.replace(tuned_by_hand(), certificate=None)
    header = header_of(tmp_path, fit=remarked, frf=frf, tuned=tuned)
    assert "! IDENTIFIED, with 2 remarks" in header and "! NOT CERTIFIED" in header


def test_a_fit_without_a_minimum_is_no_result(tmp_path, frf, fit):
    stopped = dataclasses.replace(fit.verdict, kind="no minimum")
    header = header_of(tmp_path, fit=dataclasses.replace(fit, verdict=stopped), frf=frf)
    assert header.split()[:3] == ["\u2717", "NO", "MINIMUM"]


@pytest.mark.slow
def test_several_responses_have_a_part_each(tmp_path, frf, fit):
    both = {"empty": frf, "loaded": frf}
    models = {"loaded": jq.LaggedIntegrator(140.0, 0.016, 0.011)}
    page = read_page(write_report(tmp_path / "r.html", fit=fit, frf=both, models=models))
    assert len(page.of("img")) == 4
    with pytest.raises(ValueError, match=r"models of no response: \['x'\]; .*'empty', 'loaded'"):
        write_report(tmp_path / "r.html", fit=fit, frf=both, models={"x": TRUTH})
    with pytest.raises(ValueError, match="frf is empty"):
        write_report(tmp_path / "r.html", fit=fit, frf={})
