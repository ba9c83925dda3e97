"""What the command line writes where, and how it shows the way."""

import json
import re

import numpy as np
import pytest
from sweep_logs import GAIN, write_sweep

from jaxquad.cli import main
from jaxquad.workflows import free_folder, IdentifySettings


ORDER = [
    "demo",
    "app",
    "recipe",
    "design",
    "channels",
    "identify",
    "verify",
    "tune",
    "autopilot",
    "compare",
    "report",
    "batch",
]


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    return write_sweep(tmp_path_factory.mktemp("log") / "sweep.csv")


def identify(*words):
    given = ["--input", "M=right-left", "--output", "q", "--unit", "q=rad/s", "--quiet"]
    return main(["identify", *map(str, words), *given])


def printed_help(capsys, *words):
    with pytest.raises(SystemExit) as stop:
        main([*words, "--help"])
    assert stop.value.code == 0
    return capsys.readouterr().out


def test_without_a_command_three_lines_show_the_way(capsys):
    assert main([]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[1] for line in lines] == ["demo", "identify", "tune"]


def test_help_lists_each_command_in_order_of_use_with_an_example(capsys):
    listed = re.findall(r"^  ([a-z]+) +\S.*\n +jaxquad ([a-z]+)", printed_help(capsys), flags=re.M)
    assert listed == [(name, name) for name in ORDER]


@pytest.mark.parametrize(
    ("command", "groups"),
    [
        ("identify", ["the record", "the estimate", "the model", "a second record", "output"]),
        ("verify", ["the record", "the estimate", "output"]),
        ("tune", ["the vehicle", "the simulated flight", "the controller", "the plants", "output"]),
        ("design", ["the signal", "output"]),
    ],
)
def test_options_stand_in_groups(command, groups, capsys):
    heads = re.findall(r"^([a-z ]+):$", printed_help(capsys, command), flags=re.M)
    assert [head for head in heads if head in groups] == groups
    assert set(heads) - set(groups) <= {"positional arguments", "options", "examples", "example"}


def test_a_folder_of_logs_is_for_batch(tmp_path, capsys):
    assert identify(tmp_path) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and f"jaxquad batch {tmp_path} identifies each log" in said


def test_a_result_of_other_settings_or_logs_keeps_its_folder(tmp_path, log):
    wanted, settings = tmp_path / "flight", IdentifySettings(input="u", output="y", band=(1, 2))
    same = {"settings": settings.content()}

    def written(content, source):
        folder = free_folder(wanted, "result.json", content, sources=[source])
        folder.mkdir(exist_ok=True)
        from jaxquad._core import plain_content
        from jaxquad.report import provenance

        origin = {"provenance": provenance(source).content()}
        (folder / "result.json").write_text(json.dumps(plain_content({**content, **origin})))
        return folder.name

    assert written(same, log) == "flight"
    assert written(same, log) == "flight"
    others = {"settings": settings.changed({"lag": False}).content()}
    assert [written(others, log) for _ in range(2)] == ["flight-2", "flight-2"]
    copy = tmp_path / "copy.csv"
    copy.write_bytes(log.read_bytes() + b"\n")
    assert written(same, copy) == "flight-3"
    assert written(same, log) == "flight"
    (wanted / "result.json").write_text("no JSON")
    assert written(same, log) == "flight-4"


@pytest.mark.slow
def test_the_command_line_numbers_folders_unless_forced(tmp_path, log, capsys):
    out, band = tmp_path / "out", ["--band-rad", "3", "12", "--no-lag"]
    assert identify(log, "--out", out, *band) == 0
    first = (out / "result.json").read_bytes()
    assert identify(log, "--out", out, *band, "--cost", "coherence") == 0
    assert f"! {out} holds the result of other settings" in capsys.readouterr().err
    assert (out / "result.json").read_bytes() == first
    assert json.loads((tmp_path / "out-2" / "result.json").read_text())["settings"]["cost"] != "ml"
    assert identify(log, "--out", out, *band, "--cost", "coherence", "--force") == 0
    assert not capsys.readouterr().err
    assert json.loads((out / "result.json").read_text())["settings"]["cost"] == "coherence"


@pytest.mark.slow
def test_two_logs_together_are_one_result_with_smaller_errors(tmp_path, log, capsys):
    """Half the variance from twice the data, within what the two noises differ by."""
    again = write_sweep(tmp_path / "again.csv", seed=1)
    band = ["--band", "0.5", "6", "--out"]
    assert identify(log, *band, tmp_path / "one") == 0
    assert identify(log, again, *band, tmp_path / "two") == 0
    assert "sweep.csv and 1 more" not in capsys.readouterr().err
    one, two = (json.loads((tmp_path / n / "result.json").read_text()) for n in ("one", "two"))
    rows = [result["fit"]["parameters"][0] for result in (one, two)]
    errors = [row["noise_standard_error"] for row in rows]
    assert errors[1] == pytest.approx(errors[0] / np.sqrt(2), rel=0.15)
    assert abs(rows[1]["value"] - GAIN) < 3 * rows[1]["standard_error"]
    assert rows[1]["unit"] == "rad/s^2 per M"
    files = [file["name"] for file in two["provenance"]["files"]]
    assert files == ["sweep.csv", "again.csv"]
    assert two["provenance"]["command"].split()[2:4] == [str(log), str(again)]
    page = (tmp_path / "two" / "report.html").read_text()
    assert "again.csv, t = " in page and "rad/s^2 per M" in page
    assert main(["report", str(tmp_path / "two"), "--quiet"]) == 0
    assert "holds the result of other" not in capsys.readouterr().err


def test_logs_of_different_units_are_not_taken_together(tmp_path, capsys):
    h5py = pytest.importorskip("h5py")
    for name, unit in (("a", "rad/s"), ("b", "deg/s")):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file["t"], file["u"] = np.arange(400) / 100, np.sin(np.arange(400) / 9)
            file["q"] = file["u"][()]
            file["q"].attrs["units"] = unit
    logs = [str(tmp_path / f"{name}.h5") for name in "ab"]
    assert main(["identify", *logs, "--input", "u", "--output", "q", "--quiet"]) == 2
    said = capsys.readouterr().err
    assert "the unit of q is rad/s in" in said and "but deg/s in" in said
    assert main(["identify", *logs, "--quiet"]) == 2
    assert "several logs need --input and --output" in capsys.readouterr().err
