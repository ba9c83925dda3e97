"""What documents, notebooks and fits/ name exists, without running them."""

import ast
import json
import re
from functools import reduce

import pytest
from conftest import ROOT

import jaxquad as jq


PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
FITS = sorted((ROOT / "fits").rglob("*.py"))
NAME = re.compile(r"(?<![\w.`/\]\[\"'])jq((?:\.[A-Za-z_]\w*)+)|`jq((?:\.[A-Za-z_]\w*)+)")
PYTHON = re.compile(r"```python\n(.*?)```", flags=re.S)
MACHINE = re.compile(r"(?<![\w.])/(?:work|tmp|home|root)/")


def text_of(path):
    """A page as it is, a notebook's cells."""
    if path.suffix != ".ipynb":
        return path.read_text()
    return "\n".join("".join(cell["source"]) for cell in json.loads(path.read_text())["cells"])


def exists(dotted):
    """Whether the part of `dotted` that modules and classes can answer for is there."""
    try:
        reduce(getattr, dotted.strip(".").split(".")[:3], jq)
    except AttributeError:
        return False
    return True


@pytest.mark.parametrize("path", [*PAGES, *NOTEBOOKS, *FITS], ids=lambda path: path.name)
def test_every_name_of_the_library_exists(path):
    named = {a or b for a, b in NAME.findall(text_of(path))}
    assert not sorted(name for name in named if not exists(name))


@pytest.mark.parametrize("path", [*PAGES, *NOTEBOOKS, *FITS], ids=lambda path: path.name)
def test_files_that_are_named_exist_and_are_no_place_of_one_machine(path):
    text = text_of(path)
    for named in re.findall(r"`((?:docs|fits|notebooks|tests|jaxquad)/[\w/.]+\.\w+)`", text):
        assert (ROOT / named).exists(), named
    assert not MACHINE.search(text)


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_blocks_of_python_are_python(path):
    for block in PYTHON.findall(path.read_text()):
        ast.parse(block)


@pytest.mark.parametrize("path", [*PAGES, ROOT / "CHANGELOG.md"], ids=lambda path: path.name)
def test_lines_fit_a_screen(path):
    assert not [line for line in path.read_text().splitlines() if len(line) >= 120]


@pytest.mark.parametrize("path", PAGES, ids=lambda path: path.name)
def test_functions_are_in_the_files_that_a_page_names(path):
    for file, name in re.findall(r"`([\w/]+\.py):(\w+)`", path.read_text()):
        folder = ROOT if file.startswith("tests/") else ROOT / "jaxquad"
        source = (folder / file).read_text()
        assert re.search(rf"^\s*(?:def|class) {name}\b", source, flags=re.M), f"{file}:{name}"
