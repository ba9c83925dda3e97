"""Run notebooks as Jupyter does, from a fresh kernel; as a script, store what they print and draw.

PYTHONPATH=. python tests/notebook_runs.py notebooks/*.ipynb
"""

import os
import sys
import tempfile
from pathlib import Path

import nbformat
from nbconvert.preprocessors import ExecutePreprocessor


def run_notebook(path: Path, timeout: int = 600) -> nbformat.NotebookNode:
    """The notebook with what its cells print and draw now."""
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = []
    runner = ExecutePreprocessor(timeout=timeout, kernel_name="python3")
    done, _ = runner.preprocess(notebook, {"metadata": {"path": str(path.parent)}})
    return done


def printed(cell: nbformat.NotebookNode) -> str:
    """What a cell prints, standard error included."""
    return "".join(each.text for each in cell.outputs if each.output_type == "stream")


def images(cell: nbformat.NotebookNode) -> int:
    """How many images it shows."""
    return sum("image/png" in each.get("data", {}) for each in cell.outputs)


_DPI = 80  # of the stored figures: a notebook stays below 300 kB


def store(path: Path) -> None:
    """Run a notebook and write it, without what differs between runs: times and versions."""
    with tempfile.NamedTemporaryFile("w", suffix="matplotlibrc") as settings:
        settings.write(f"figure.dpi: {_DPI}\n")
        settings.flush()
        os.environ["MATPLOTLIBRC"] = settings.name
        notebook = run_notebook(path)
    for cell in notebook.cells:
        cell.metadata = {}
        if cell.cell_type == "code":
            cell.outputs = _joined(cell.outputs)
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    nbformat.write(notebook, path)


def _joined(outputs: list[nbformat.NotebookNode]) -> list[nbformat.NotebookNode]:
    """Pieces of one stream together: where it breaks depends on the time."""
    joined: list[nbformat.NotebookNode] = []
    for each in outputs:
        if joined and each.output_type == joined[-1].output_type == "stream":
            joined[-1].text += each.text
        else:
            joined.append(each)
    return joined


if __name__ == "__main__":
    for name in sys.argv[1:]:
        store(Path(name))
