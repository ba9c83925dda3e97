"""Figures of certificates, fronts and tunes can be read without colour."""

from typing import Any

import numpy as np
import pytest
from certificates_by_hand import certificate, front, INERTIA, judged, missed

from jaxquad.plot import certificate_figure, convergence_figure, front_figure, headless
from jaxquad.tuning import Evaluation


@pytest.fixture(autouse=True, scope="module")
def without_pyplot():
    with headless():
        yield


def lines(panel) -> dict[str, Any]:
    return {line.get_label(): line for line in panel.get_lines()}


def evaluation(phase, cost, stable):
    cost = np.asarray(cost, float)
    none = np.full(cost.shape, np.nan)
    return Evaluation(phase, none[:, None], cost, none, np.asarray(stable, float), none, {}, 0.0)


@pytest.fixture(scope="module")
def shown():
    designs = {"tuned": judged(8.0, 2.0), "other": judged(40.0, 50.0, unstable=(2, 7))}
    return certificate_figure(certificate(designs, [missed("sensitivity_peak", 1.5, 2.0)]))


def test_the_verdict_stands_above_and_the_axes_have_units(shown):
    title = shown.figure.get_suptitle().replace("\n", " ")
    assert title.startswith(
        "CERTIFICATE FAILS on 12 fresh members, not to be flown: STABILITY FAIL STABILITY: Ms, "
        "worst, at most 1.5: 2"
    )
    stability, itae, peak = shown
    assert itae.get_ylabel() == "ITAE, deg s²" and peak.get_ylabel().startswith("Ms")
    assert "J / J0" in peak.get_xlabel() and peak.get_xscale() == "log"
    texts = [label.get_text() for label in stability.get_yticklabels()]
    assert texts == ["tuned: 0 % unstable", "other: 16.7 % unstable"]


def test_unstable_members_have_a_cross_and_no_ms(shown):
    _, itae, peak = shown
    np.testing.assert_allclose(lines(itae)["linearly unstable"].get_xdata(), INERTIA[[2, 7]])
    assert "linearly unstable" not in lines(peak)
    assert lines(peak)["other"].get_xdata().size == INERTIA.size - 2
    np.testing.assert_array_equal(lines(peak)["other"].get_ydata(), 30.0)  # where the picture ends
    np.testing.assert_allclose(lines(itae)["tuned"].get_ydata(), 8.0)


def test_designs_differ_in_their_marks_and_limits_are_lines(shown):
    _, itae, peak = shown
    drawn = lines(itae)
    assert drawn["tuned"].get_marker() != drawn["other"].get_marker()
    assert [line.get_ydata()[0] for line in peak.get_lines() if line.get_ls() == "--"] == [1.5]
    assert "worst at most 1.5" in [text.get_text() for text in peak.texts]


def test_a_design_that_does_not_exist_is_refused_and_so_are_too_many():
    designs = {f"design {k}": judged() for k in range(8)}
    with pytest.raises(ValueError, match="no designs \\['nothing'\\]"):
        certificate_figure(certificate(designs), designs=["nothing"])
    with pytest.raises(ValueError, match="8 designs are too many to be distinguished"):
        certificate_figure(certificate(designs))


def test_a_front_shows_mean_worst_and_peers_with_their_unstable_share():
    points = [
        judged(np.linspace(4, 8, 12), 2.0, 1.0),
        judged(3.0, 2.0, 10.0),
        judged(9.0, 2.0, 5.0),
    ]
    panel = front_figure(front(points, peers={"bad": judged(20.0, 2.0, 3.0, (1, 2, 3))}))[0]
    drawn = lines(panel)
    np.testing.assert_allclose(drawn["front, mean"].get_ydata(), [6.0, 3.0])
    np.testing.assert_allclose(drawn["front, worst member"].get_ydata(), [8.0, 3.0])
    np.testing.assert_allclose(drawn["not on the front"].get_xdata(), [5.0])
    assert drawn["bad"].get_marker() != drawn["front, mean"].get_marker()
    assert "25 % unstable" in [text.get_text() for text in panel.texts]
    assert "u²/s" in panel.get_xlabel()


def test_a_peer_without_ms_stands_beyond_all_others():
    points = [judged(4.0, 2.0), judged(3.0, 3.0)]
    found = front(points, over="sensitivity_peak", peers={"bad": judged(1.0, 2.0, unstable=(0,))})
    panel = front_figure(found)[0]
    assert lines(panel)["bad"].get_xdata()[0] > 3.0
    assert "no Ms" in [text.get_text() for text in panel.texts]


def test_convergence_is_drawn_from_where_flights_begin():
    history = [evaluation("stabilise", [3.0, 2.0], [0.2, 0.5])]
    history += [
        evaluation("optimise", [1.0, 0.5], [1, 1]),
        evaluation("optimise", [0.1, 0.6], [1, 1]),
    ]
    top, bottom = convergence_figure(history)
    first, second = lines(top)["start 1"], lines(top)["start 2"]
    np.testing.assert_array_equal(first.get_xdata(), [2, 3])
    np.testing.assert_allclose(first.get_ydata(), [0.9, 1e-5])
    np.testing.assert_allclose(second.get_ydata(), 0.4)  # what was best until then
    assert first.get_linestyle() != second.get_linestyle()
    np.testing.assert_allclose(np.asarray(bottom.get_lines()[0].get_ydata()), [20, 100, 100])
    assert bottom.get_xlabel() == "gradient evaluation"
    with pytest.raises(ValueError, match="the history is empty"):
        convergence_figure([])
