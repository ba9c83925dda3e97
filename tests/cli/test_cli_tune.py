"""`jaxquad tune`: from the folder of an identification to certified gains in C."""

import json

import pytest

from jaxquad.cli import main


PLANT = ["--inertia", "0.01", "--limit", "0.2"]
SMALL = ["--noise", "0.05", "--members", "8", "--fresh", "32", "--duration", "1.6"]


@pytest.mark.slow
def test_a_result_becomes_gains_with_a_certificate(demo, tmp_path, capsys):
    code = main(["tune", str(demo), *PLANT, *SMALL, "--out", str(tmp_path), "--json"])
    printed = json.loads(capsys.readouterr().out)
    # Whichever way it falls, the code says what the certificate says.
    assert code == (0 if printed["holds"] else 4)
    assert printed["holds"] == printed["certificate"]["holds"] and printed["stabilised"]
    assert {"ladrc.wc", "ladrc.wo"} <= {name.partition("[")[0] for name in printed["values"]}
    assert printed["settings"]["inertia"] == 0.01
    assert json.loads((tmp_path / "tuned.json").read_text())["values"] == printed["values"]
    assert "attitude" in (tmp_path / "attitude.h").read_text()
    page = (tmp_path / "report.html").read_text()
    assert "Tuned gains" in page and "SHA-256" in page
    assert (tmp_path / "certificate.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("more", "complaint"),
    [
        (["--spread", "3", "0.5"], "--spread is [3.0, 0.5]: give two numbers above 0"),
        (["--step", "0"], "--step is 0.0: give a number above 0"),
    ],
)
def test_what_cannot_be_tuned_is_one_line(demo, capsys, more, complaint):
    assert main(["tune", str(demo), *PLANT, *more]) == 2
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1 and complaint in printed


def test_an_output_of_unknown_unit_is_refused(demo, tmp_path, capsys):
    """Gains in the wrong unit would be 57 times too large or too small."""
    content = json.loads((demo / "result.json").read_text())
    content["settings"]["units"] = {}
    (tmp_path / "result.json").write_text(json.dumps(content))
    assert main(["tune", str(tmp_path), *PLANT]) == 2
    assert "the unit of q is not known" in capsys.readouterr().err
