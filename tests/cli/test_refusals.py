"""What a command cannot do is said in one line, with exit code 2, before anything is computed."""

import os
import zipfile

import numpy as np
import pytest

from jaxquad.cli import main


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("place")
    t = 0.01 * np.arange(400)
    rows = np.stack([t, np.sin(7 * t), np.cos(5 * t)], axis=1)
    np.savetxt(folder / "log.csv", rows, delimiter=",", header="t,u,q", comments="")
    rows[:, 2] = np.nan
    np.savetxt(folder / "nan.csv", rows, delimiter=",", header="t,u,q", comments="")
    with zipfile.ZipFile(folder / "log.zip", "w") as archive:
        archive.writestr("flight.bbl", "H Product:Blackbox")
    (folder / "folder").mkdir()
    return folder


def refusal(words, capsys):
    """The one line that is said."""
    assert main(words) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
    assert printed.err.startswith("jaxquad: error: ") and "Errno" not in printed.err
    return printed.err


DEVICE = pytest.param(
    "/dev/full", "which is no", marks=pytest.mark.skipif(os.name == "nt", reason="no such device")
)
DESIGN = ["design", "sweep", "--band", "1", "10", "--rate", "100", "--amplitude", "1"]


@pytest.mark.parametrize("command", ["identify", "demo", "design"])
@pytest.mark.parametrize(
    ("out", "said"),
    [("log.csv", "which is no folder"), ("log.csv/a/b", "log.csv is a file"), DEVICE],
)
def test_a_place_that_cannot_be_written_is_refused_first(
    command, out, said, place, capsys, monkeypatch
):
    monkeypatch.chdir(place)
    if command == "design":
        words = [*DESIGN, "--out", "folder" if out == "log.csv" else out]
        said = said.replace("no folder", "a folder: name a file in it")
    elif command == "demo":
        words = ["demo", "--out", out]
    else:
        words = ["identify", "log.csv", "--input", "u", "--output", "q", "--out", out]
    assert said in refusal(words, capsys)


def test_what_the_system_refuses_is_said_in_words(place, capsys, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device", "sweep.csv")

    monkeypatch.chdir(place)
    monkeypatch.setattr("jaxquad._core.write_file", full)
    assert refusal(DESIGN, capsys) == "jaxquad: error: sweep.csv: no space left on device\n"


@pytest.mark.parametrize(
    ("more", "said"),
    [
        (["--unit", "z=rad/s"], "--unit names 'z', but the channels in use are u, q"),
        (["--poles", "1", "--zeros", "3"], "--zeros is 3, above 1 --poles and 1 --integrators"),
        (["--input", "v=-u+"], "--input is 'v=-u+': cannot read '+'"),
    ],
)
def test_options_that_cannot_be_are_refused(more, said, place, capsys):
    words = ["identify", str(place / "log.csv"), "--output", "q", *more]
    assert said in refusal([*words, *([] if "--input" in more else ["--input", "u"])], capsys)


@pytest.mark.parametrize("name", ["--input", "--output", "--reference"])
def test_a_channel_is_named_once(name, place, capsys):
    with pytest.raises(SystemExit, match="2"):
        main(["identify", str(place / "log.csv"), name, "u", name, "q"])
    assert f"argument {name}: given twice" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["channels", "folder"], "folder is a folder, and no bag of ROS 2: name the file in it"),
        (["autopilot", "log.csv"], "jaxquad identify takes it all the same"),
        (["autopilot", "log.csv", "--axis", "Roll"], "jaxquad identify takes it all the same"),
        (["autopilot", "log.zip"], "it holds flight.bbl): unpack it"),
        (
            ["identify", "nan.csv", "--input", "u", "--output", "q", "--quiet"],
            "channel 'q' holds no usable number: all 400 samples are nan, or out of the range",
        ),
    ],
)
def test_files_that_do_not_hold_what_is_asked_are_refused(words, said, place, capsys, monkeypatch):
    monkeypatch.chdir(place)
    assert said in refusal(words, capsys)
