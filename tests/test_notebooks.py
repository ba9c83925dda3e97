"""The notebooks run, and their stored outputs say what running them says."""

import json

import matplotlib
import pytest
from conftest import ROOT


NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_prints_what_it_shows(path, capsys):
    matplotlib.use("Agg")
    space: dict = {}
    for cell in json.loads(path.read_text())["cells"]:
        if cell["cell_type"] != "code":
            continue
        exec(compile("".join(cell["source"]), path.name, "exec"), space)
        stored = "".join(t for o in cell["outputs"] for t in o.get("text", []))
        # Words, not digits: the last ones differ between processors.
        assert _words(capsys.readouterr().out) == _words(stored)


def _words(text: str) -> list[str]:
    return [word for word in text.split() if not any(c.isdigit() for c in word)]
