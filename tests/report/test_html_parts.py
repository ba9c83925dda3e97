"""What pages are made of: escaping, names in figures, residuals, long signals, files."""

import dataclasses
import hashlib

import numpy as np
import pytest
from html_pages import ERROR, HOSTILE, is_image, Page, TRUTH
from matplotlib.figure import Figure
from synthetic import response_of

import jaxquad as jq
from jaxquad.plot import short_names
from jaxquad.plot._record import extremes
from jaxquad.plot._residuals import residuals_of
from jaxquad.report import provenance
from jaxquad.report._html_checks import _thinned
from jaxquad.report._html_figure import figure
from jaxquad.report._html_page import write_page
from jaxquad.report._html_response import _left_out, _pairs
from jaxquad.report._html_text import element, escaped


@pytest.fixture(scope="module")
def frf():
    return response_of(TRUTH, error=ERROR, seed=0)


@pytest.mark.parametrize("name", HOSTILE, ids=range(len(HOSTILE)))
def test_a_figure_draws_any_name(name):
    def draw():
        drawn = Figure(figsize=(2, 2))
        drawn.text(0.1, 0.5, short_names([name])[0])
        return drawn

    page = Page(figure(draw, alt=name))
    [attributes] = page.of("img")
    assert page.errors == [] and all(is_image(*each) for each in page.figures())
    assert set(attributes) == {"alt", "width", "height", "src"}


def test_what_is_not_html_is_escaped():
    text = element("p", "<b>&", element("i", "'\""), attributes={"title": '"><x'})
    assert text == '<p title="&quot;&gt;&lt;x">&lt;b&gt;&amp;<i>&#x27;&quot;</i></p>'
    assert escaped("a\ud800\u202eb\nc") == "a\ufffd\ufffdb\nc"


def test_short_names_stay_distinct():
    names = ["a" * 50, "a" * 25 + "b" + "a" * 25, "x\n y", "", "q"]
    short = short_names(names)
    assert len(set(short)) == len(names) and max(map(len, short)) <= 29
    assert short[2:] == ("x y", "(no name)", "q")


def test_residuals_are_in_units_of_the_random_error(frf):
    """The truth leaves white residuals of size 1; a model of half the gain is 6 dB off."""
    many = [residuals_of(response_of(TRUTH, error=0.02, seed=k), TRUTH, 0, 0) for k in range(20)]
    values = np.concatenate([np.concatenate([one.magnitude, one.phase]) for one in many])
    assert np.std(values) == pytest.approx(1.0, abs=0.08)  # 3 sigma of 1200 samples: 0.06
    assert np.mean([one.outside for one in many]) == pytest.approx(0.05, abs=0.025)
    half = residuals_of(frf, jq.LaggedIntegrator(140.0, 0.016, 0.011), 0, 0)
    assert np.mean(half.decibels) == pytest.approx(20 * np.log10(2), abs=0.2)
    np.testing.assert_allclose(half.degrees, np.degrees(half.phase * ERROR), rtol=1e-9)


def test_no_peak_of_a_long_record_is_lost():
    values = np.random.default_rng(0).standard_normal(1_000_003)
    values[[123_456, 1_000_002]] = 50.0, -60.0
    kept = extremes(values)
    assert kept.size <= 2 * 1201 and np.all(np.diff(kept) > 0)
    assert {123_456, 1_000_002} <= set(kept.tolist())
    np.testing.assert_array_equal(extremes(values[:2000]), np.arange(2000))


def test_a_long_verification_keeps_the_extremes_of_every_curve():
    time, noise = np.arange(200_001) * 0.01, np.random.default_rng(1).standard_normal(200_001)
    simulated = np.sin(time)
    measured = simulated + 0.1 * noise
    one = jq.identify.Agreement("q", "rad/s", 0.1, 0.05, 90.0, 99.0)
    none = np.zeros(0)
    check = jq.identify.Verification(
        time, measured, simulated, 0.1, 0.05, 90.0, 99.0, (one,), none, none, none, 0, None
    )
    thin = _thinned(check)
    assert thin.time.size < 8000 and np.isin(thin.time, time).all()
    apart = thin.measured - thin.simulated
    assert np.ptp(apart) == np.ptp(measured - simulated)
    assert np.ptp(thin.measured) == np.ptp(measured)


def test_what_is_not_drawn_is_counted(frf):
    wide = dataclasses.replace(frf, input_names=tuple("abcd"), output_names=("x", "y"))
    assert _pairs(wide, 3) == [(0, 0), (0, 1), (0, 2)]
    assert _left_out(wide, 3) == "<p>5 more responses are not drawn.</p>"
    assert _left_out(frf, 3) == ""


def test_a_page_is_whole_or_not_there(tmp_path, monkeypatch):
    path = write_page(tmp_path / "report.html", "before")

    def full(_):
        raise OSError("no space left on device")

    monkeypatch.setattr("jaxquad.report._html_page.os.fsync", full)
    with pytest.raises(OSError, match="no space left"):
        write_page(path, "after")
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]


def test_a_folder_is_hashed_by_the_order_of_its_names(tmp_path):
    for name in ("b", "a", "c"):
        (tmp_path / name).write_text(name)
    [source] = provenance(tmp_path).files
    assert source.sha256 == hashlib.sha256(b"abc").hexdigest() and source.size == 3
    assert provenance(tmp_path).content()["files"][0]["name"] == tmp_path.name
    with pytest.raises(OSError):
        provenance(tmp_path / "none")
