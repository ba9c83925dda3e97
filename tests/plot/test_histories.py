from typing import Any

import numpy as np
import pytest

from jaxquad.plot import headless, histories


@pytest.fixture(autouse=True)
def without_pyplot():
    with headless():
        yield


TIME = np.linspace(0, 1, 50)


def lines(panels) -> dict[str, Any]:
    return {line.get_label(): line for axis in panels for line in axis.get_lines()}


def test_curves_differ_in_their_lines_and_the_target_lies_behind():
    names = ["set-point", "a", "b", "c", "d", "e"]
    found = lines(histories(TIME, {"roll, deg": dict.fromkeys(names, TIME)}, target="set-point"))
    dashes = {repr((line._unscaled_dash_pattern, line.get_linestyle())) for line in found.values()}
    assert len(dashes) == 5  # the target is solid like one of them, but wide
    assert found["set-point"].get_linewidth() > 2 * found["a"].get_linewidth()
    assert found["set-point"].get_zorder() < min(found[name].get_zorder() for name in "abcde")


def test_a_name_has_one_line_in_all_panels_and_one_entry_in_the_legend():
    panels = histories(TIME, {"roll": {"x": TIME, "y": TIME}, "pitch": {"y": 2 * TIME}})
    roll, pitch = panels
    assert pitch.get_lines()[0].get_linestyle() == roll.get_lines()[1].get_linestyle() == "--"
    assert [text.get_text() for text in panels.figure.legends[0].get_texts()] == ["x", "y"]
    assert [axis.get_ylabel() for axis in panels] == ["roll", "pitch"]


def test_what_is_not_finite_is_left_out_and_limits_hold():
    wild = np.where(TIME > 0.5, np.inf, TIME)
    panels = histories(TIME, {"roll": {"x": wild}}, limits={"roll": (-1.0, 2.0)})
    assert not np.isinf(np.asarray(lines(panels)["x"].get_ydata(), float)).any()
    assert panels[0].get_ylim() == (-1.0, 2.0)


def test_too_many_curves_and_unknown_panels_are_refused():
    with pytest.raises(ValueError, match="is curve 6, too many to be distinguished, 5 is the most"):
        histories(TIME, {"roll": {str(k): TIME for k in range(6)}})
    with pytest.raises(ValueError, match=r"limits for \['pitch'\].*\['roll'\]"):
        histories(TIME, {"roll": {"x": TIME}}, limits={"pitch": (0.0, 1.0)})
