"""The reference names everything public, once, in the words of its docstring."""

import importlib
import importlib.util
import re
import runpy
import subprocess
import sys

import pytest
from conftest import ROOT

import jaxquad as jq


SCRIPT = ROOT / "docs" / "reference.py"
REFERENCE = runpy.run_path(str(SCRIPT))
ROOMS, public = REFERENCE["ROOMS"], REFERENCE["public"]
ENTRY = re.compile(r"^- \[`(\w+)`\]\((.+?)\): (.*)$", flags=re.M)


def test_the_page_says_what_the_docstrings_say():
    page = REFERENCE["page"]()
    written = (ROOT / "docs" / "reference.md").read_text()
    assert written == page, "run: python docs/reference.py > docs/reference.md"


def test_every_public_name_stands_in_it_once():
    names = [name for name, *_ in ENTRY.findall(REFERENCE["page"]())]
    assert len(names) == len(set(names))
    rooms = [public(importlib.import_module(f"jaxquad.{room}")) for room in ROOMS]
    assert set(names) == set(public(jq)).union(*rooms)


def test_every_room_has_a_part():
    folders = {path.parent.name for path in (ROOT / "jaxquad").glob("[a-z]*/__init__.py")}
    assert folders == set(ROOMS)


def test_every_name_has_a_sentence_and_a_source():
    for name, path, text in ENTRY.findall(REFERENCE["page"]()):
        assert re.search(r"([.?]|`)$", text) and len(text) <= 120, name
        assert not text.startswith(f"{name}("), f"{name} has no docstring of its own"
        assert (ROOT / "docs" / path).is_file(), name


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("pdoc") is None, reason="pdoc makes the HTML: [docs]")
def test_it_becomes_html_without_warnings(tmp_path):
    done = subprocess.run(
        [sys.executable, SCRIPT, tmp_path], capture_output=True, text=True, cwd=ROOT
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    for room in ROOMS:
        html = (tmp_path / "jaxquad" / f"{room}.html").read_text()
        for name in public(importlib.import_module(f"jaxquad.{room}")):
            assert f'id="{name}"' in html, name
        assert "jaxlib" not in html


def test_the_index_leads_to_every_page_and_notebook():
    index = (ROOT / "docs" / "index.md").read_text()
    linked = set(re.findall(r"\]\((?:\.\./notebooks/)?([\w.]+)\)", index))
    pages = {path.name for path in (ROOT / "docs").glob("*.md")} - {"index.md"}
    assert linked == pages | {path.name for path in (ROOT / "notebooks").glob("*.ipynb")}
