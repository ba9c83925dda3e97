"""Figures of records, responses and verifications can be read."""

from typing import Any

import equinox as eqx
import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from synthetic import OMEGA, response_of

import jaxquad as jq
from jaxquad.plot import (
    bode,
    compare,
    extremes,
    headless,
    histories,
    Panels,
    plain_ticks,
    record_figure,
    resid,
    residuals_of,
    short_names,
)


TRUTH = jq.LaggedIntegrator(280.0, 0.016, 0.011)


@pytest.fixture(autouse=True)
def closed():
    """pyplot keeps what it has made."""
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def frf():
    return response_of(TRUTH, error=0.05, seed=0)


@pytest.fixture(scope="module")
def check():
    time = np.arange(400) * 0.01
    u = np.sign(np.sin(3 * time))
    y = np.asarray(jq.models.simulate_linear(TRUTH.transfer_function(), u, 0.01))
    record = jq.Record(time, u, y, output_names="q", output_units="rad/s")
    return jq.verify(jq.LaggedIntegrator(250.0, 0.016, 0.011), record)


def lines(axis) -> dict[str, Any]:
    return {line.get_label(): line for line in axis.get_lines()}


def test_a_bode_figure_names_its_axes_with_units(frf):
    magnitude, phase, coherence = bode(frf, {"truth": TRUTH})[:3]
    assert "dB" in magnitude.get_ylabel()
    assert "deg" in phase.get_ylabel()
    assert "rad/s" in coherence.get_xlabel() and coherence.get_xscale() == "log"


def test_the_band_is_the_95_per_cent_band_of_the_random_error(frf):
    magnitude = bode(frf)[0]
    (band,) = magnitude.collections
    corners = np.asarray(band.get_paths()[0].vertices)
    at_first = corners[np.isclose(corners[:, 0], OMEGA[0]), 1]
    width = 2 * 1.96 * 0.05 * 20 / np.log(10)
    assert np.ptp(at_first) == pytest.approx(width, rel=1e-9)


def test_the_model_is_drawn_on_the_branch_of_the_measured_phase():
    """A delay of many turns, and a response that starts beyond -180 deg."""
    slow = jq.LaggedIntegrator(280.0, 0.016, 1.0)
    panels = bode(response_of(slow), {"model": slow})
    measured, model = (lines(panels[1])[name] for name in ("joint estimate", "model"))
    drawn = np.interp(measured.get_xdata(), model.get_xdata(), model.get_ydata())
    assert np.max(np.abs(drawn - measured.get_ydata())) < 2  # deg, of linear interpolation


def test_points_without_coherence_are_shown_apart(frf):
    weak = eqx.tree_at(lambda f: f.coherence, frf, frf.coherence.at[:5].set(0.3))
    drawn = lines(bode(weak, {"direct": frf})[0])
    assert len(drawn["joint estimate"].get_xdata()) == OMEGA.size - 5
    assert len(drawn["joint estimate, coherence below 0.6"].get_xdata()) == 5
    assert drawn["direct"].get_marker() != drawn["joint estimate"].get_marker()
    with pytest.raises(ValueError, match=r"no response \('p', 'u0'\)"):
        bode(frf, pair=("p", "u0"))


def test_an_overlay_shows_degrees_and_the_measures(check):
    panels = compare(check)
    top, bottom = panels
    assert top.get_ylabel() == "q, deg/s" and bottom.get_xlabel() == "time, s"
    np.testing.assert_allclose(
        lines(top)["measured"].get_ydata(), np.degrees(check.measured), rtol=1e-12
    )
    assert f"{check.fit_percent:.1f} %" in panels.figure.get_suptitle()


def of_many_texts(check, frf):
    """Figures whose titles, legends and numbers take much room."""
    long = {f"{'identified with a long name'} {k}": TRUTH for k in range(5)}
    size = np.geomspace(1.0, 1e4, check.time.size)
    record = jq.Record(check.time, -12345.6 * size, 0.00012 / size, output_units="rad/s")
    return {
        "bode": bode(frf, long, {"direct estimate": frf}, title="two\nlines"),
        "overlay": compare(check, title="flight.npz"),
        "record": record_figure(record),
        "residuals": resid(TRUTH, frf),
        "histories": histories(check.time, {"x, V": {c: 1e5 * check.measured for c in "abcde"}}),
    }


@pytest.mark.slow
def test_nothing_is_cut_off_and_no_legend_lies_on_an_axis(check, frf):
    """The layout is fixed: it counts lines instead of measuring texts."""
    for name, panels in of_many_texts(check, frf).items():
        figure = panels.figure
        renderer = FigureCanvasAgg(figure).get_renderer()
        figure.draw(renderer)
        inked, size = figure.get_tightbbox(renderer), figure.get_size_inches()
        assert inked.x0 > 0 and inked.y0 > 0, name
        assert inked.x1 < size[0] and inked.y1 < size[1], name
        below = figure.axes[-1].xaxis.get_tightbbox(renderer)
        assert below is not None
        for legend in figure.legends:
            assert legend.get_window_extent(renderer).y1 < below.y0, name


def test_logarithmic_axes_have_few_ticks_at_round_numbers():
    for low, high in ((4.4, 75.4), (0.5, 3.0), (1e-5, 2.0), (6.1, 6.9), (1e-9, 1e9)):
        panel = Figure().subplots()
        panel.set(xscale="log", xlim=(low, high))
        plain_ticks(panel.xaxis)
        ticks = panel.get_xticks()
        assert 2 <= ((ticks >= low) & (ticks <= high)).sum() and ticks.size <= 8
        assert not panel.get_xticks(minor=True).size


def test_every_channel_of_a_record_is_drawn():
    time = np.arange(100) * 0.01
    record = jq.Record(time, np.sin(time), np.cos(time), np.sin(2 * time), output_units="rad")
    panels = record_figure(record)
    assert [axis.get_title("left") for axis in panels] == ["reference: r", "input: u", "output: y"]
    assert [axis.get_ylabel() for axis in panels] == ["", "", "deg"]


def test_short_names_stay_distinct():
    names = ["a" * 50, "a" * 25 + "b" + "a" * 25, "x\n y", "", "q"]
    short = short_names(names)
    assert len(set(short)) == len(names) and max(map(len, short)) <= 29
    assert short[2:] == ("x y", "(no name)", "q")


def test_residuals_are_in_units_of_the_random_error():
    """The truth leaves white residuals of size 1; a model of half the gain is 6 dB off."""
    many = [residuals_of(response_of(TRUTH, error=0.02, seed=k), TRUTH, 0, 0) for k in range(20)]
    values = np.concatenate([np.concatenate([one.magnitude, one.phase]) for one in many])
    assert np.std(values) == pytest.approx(1.0, abs=0.08)  # 3 sigma of 1200 samples: 0.06
    assert np.mean([one.outside for one in many]) == pytest.approx(0.05, abs=0.025)
    half = residuals_of(
        response_of(TRUTH, error=0.005, seed=0), jq.LaggedIntegrator(140.0, 0.016, 0.011), 0, 0
    )
    assert np.mean(half.decibels) == pytest.approx(20 * np.log10(2), abs=0.2)
    np.testing.assert_allclose(half.degrees, np.degrees(half.phase * 0.005), rtol=1e-9)


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
    one = jq.identify.Agreement("q", "", 0.1, 0.05, 90.0, 99.0)
    none = np.zeros(0)
    check = jq.identify.Verification(
        time, measured, simulated, 0.1, 0.05, 90.0, 99.0, (one,), none, none, none, 0, None
    )
    top, bottom = compare(check)
    drawn = lines(top)["measured"]
    assert len(drawn.get_xdata()) < 3000 and np.isin(drawn.get_xdata(), time).all()
    assert np.ptp(drawn.get_ydata()) == np.ptp(measured)
    assert np.ptp(bottom.get_lines()[0].get_ydata()) == np.ptp(measured - simulated)


def test_figures_are_those_of_pyplot_unless_they_are_headless(frf):
    bode(frf)
    before = plt.get_fignums()
    with headless():
        assert isinstance(bode(frf), Panels)
    assert len(before) == 1 and plt.get_fignums() == before


def test_what_is_drawn_goes_into_the_axes_that_are_given(frf, check):
    figure, axes = plt.subplots(3)
    assert tuple(bode(frf, {"truth": TRUTH}, ax=axes)) == tuple(axes)
    assert "truth" in lines(axes[0]) and axes[0].get_legend() and not figure.legends
    figure, axes = plt.subplots(2)
    compare(check, ax=list(axes))
    assert len(figure.axes) == 2 and "measured" in lines(axes[0])
    with pytest.raises(ValueError, match="ax holds 2 axes, but this plot draws 3"):
        bode(frf, ax=axes)


def test_a_notebook_prints_nothing_beside_a_figure(frf):
    """IPython asks for this method, and shows no text of what has it."""
    assert bode(frf)._ipython_display_() is None
