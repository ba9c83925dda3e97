"""Logs that the firmwares themselves flew end with a page, whatever they can tell."""

import pytest
from html_pages import read_page

from jaxquad.cli import main


pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("compiled_quickly")]
BETAFLIGHT = ("A_chirp_roll", "B_chirp_three_axes", "A_sticks", "A_hover")
LOGS = {f"betaflight_firmware/{name}.BFL": "roll" for name in BETAFLIGHT} | {
    "ardupilot_firmware/mixer_chirp_roll.BIN": "roll",
    "ardupilot_firmware/rate_chirp_pitch.BIN": "pitch",
}


@pytest.fixture
def identified(data, tmp_path, capsys):
    """Type `jaxquad identify LOG --axis AXIS`: exit code, page, what was printed and warned."""

    def type_in(log, axis, *more):
        path = data / log
        if not path.is_file():
            pytest.skip(f"{path} is not there")
        code = main(["identify", str(path), "--axis", axis, "--out", str(tmp_path), *more])
        return code, read_page(tmp_path / "report.html"), *capsys.readouterr()

    return type_in


@pytest.mark.parametrize(("log", "axis"), LOGS.items())
def test_a_log_of_each_kind_ends_with_a_page(identified, tmp_path, log, axis):
    code, page, _, warned = identified(log, axis)
    assert code in (0, 3) and page.errors == []
    assert "could not be" not in page.text().lower()
    assert "encountered in" not in warned and "encountered in" not in page.text()
    assert (tmp_path / "record.png").is_file() and (tmp_path / "bode.png").is_file()
    assert code == 3 if "hover" in log else True
