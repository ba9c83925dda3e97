"""The notebooks run, and their stored outputs say what running them says."""

import json

import matplotlib
import pytest
from conftest import ROOT


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_prints_what_it_shows(path, capsys, request, monkeypatch):
    if "JAXQUAD_DATA" in path.read_text():
        monkeypatch.setenv("JAXQUAD_DATA", str(request.getfixturevalue("data")))
    matplotlib.use("Agg")
    space: dict = {}
    for cell in json.loads(path.read_text())["cells"]:
        if cell["cell_type"] != "code":
            continue
        exec(compile("".join(cell["source"]), path.name, "exec"), space)
        stored = "".join(t for o in cell["outputs"] for t in o.get("text", []))
        # Words, not digits: the last ones differ between processors.
        assert words(capsys.readouterr().out) == words(stored)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_small_ends_with_a_figure_and_shows_no_error(path):
    assert path.stat().st_size < 300_000
    cells = [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
    assert all(o["output_type"] in ("stream", "display_data") for c in cells for o in c["outputs"])
    assert any("image/png" in o.get("data", {}) for o in cells[-1]["outputs"])
    assert [c["execution_count"] for c in cells] == list(range(1, len(cells) + 1))


def words(text: str) -> list[str]:
    """Without numbers, and without the lines that name one member: another may be the worst."""
    lines = [line for line in text.splitlines() if ": member " not in line]
    return [w for line in lines for w in line.split() if not any(c.isdigit() for c in w)]
