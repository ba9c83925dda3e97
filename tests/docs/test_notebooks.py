"""The notebooks run from a fresh kernel, show their figures, and say what they have stored."""

import json

import nbformat
import pytest
from conftest import ROOT
from notebook_runs import images, printed, run_notebook


pytestmark = pytest.mark.usefixtures("compiled_quickly")
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.slow
@pytest.mark.timeout(600)
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_run_afresh_prints_and_shows_what_it_has_stored(path, request, monkeypatch):
    if "JAXQUAD_DATA" in path.read_text():
        monkeypatch.setenv("JAXQUAD_DATA", str(request.getfixturevalue("data")))
    stored, found = nbformat.read(path, as_version=4), run_notebook(path)
    assert sum(map(images, (cell for cell in found.cells if cell.cell_type == "code"))) > 0
    for before, now in zip(stored.cells, found.cells, strict=True):
        if now.cell_type == "code":
            # Words, not digits: the last ones differ between processors.
            assert words(printed(now)) == words(printed(before))
            assert images(now) == images(before)
            assert "<Figure" not in printed(now)


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_small_ends_with_a_figure_and_shows_no_error(path):
    assert path.stat().st_size < 300_000
    cells = [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "code"]
    assert cells[0]["source"][0] == "%matplotlib inline\n"
    outputs = [o for c in cells for o in c["outputs"]]
    assert all(o["output_type"] in ("stream", "display_data") for o in outputs)
    assert all(o["name"] == "stdout" for o in outputs if o["output_type"] == "stream")
    assert any("image/png" in o.get("data", {}) for o in cells[-1]["outputs"])
    assert [c["execution_count"] for c in cells] == list(range(1, len(cells) + 1))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_one_title(path):
    cells = [c for c in json.loads(path.read_text())["cells"] if c["cell_type"] == "markdown"]
    titles = [line for c in cells for line in c["source"] if line.startswith("# ")]
    assert len(titles) == 1 and cells[0]["source"][0] == titles[0]


def words(text: str) -> list[str]:
    """Without numbers, and without the lines that name one member: another may be the worst."""
    lines = [line for line in text.splitlines() if ": member " not in line]
    return [w for line in lines for w in line.split() if not any(c.isdigit() for c in w)]
