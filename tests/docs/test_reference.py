"""The reference holds everything public, in the words of its docstring."""

import importlib
import inspect
import os
import re
import subprocess
import sys

import pytest
import yaml
from conftest import ROOT

import jaxquad as jq


DOCS = ROOT / "docs"
FOLDERS = sorted(path.parent.name for path in (ROOT / "jaxquad").glob("[a-z]*/__init__.py"))
ROOMS = [room for room in FOLDERS if room not in ("app", "cli")]
ROW = re.compile(r"^\| \[`jq\.(\w+)`\]\[jaxquad\.(\w+)\.(\w+)\] \| .+ \|$", flags=re.M)


def public(room):
    """What the face of a room exports, by name."""
    module = importlib.import_module(f"jaxquad.{room}")
    names = getattr(module, "__all__", dir(module))
    found = {n: getattr(module, n) for n in names if not n.startswith("_")}
    return {n: v for n, v in found.items() if not inspect.ismodule(v)}


def documented(room):
    """Its classes and functions; constants speak for themselves."""
    whole = public(room).items()
    return {n: v for n, v in whole if inspect.isclass(v) or inspect.isfunction(inspect.unwrap(v))}


def pages(entry):
    """The files of a part of the navigation."""
    if isinstance(entry, str):
        return [entry]
    parts = entry.values() if isinstance(entry, dict) else entry
    return [page for part in parts for page in pages(part)]


@pytest.fixture(scope="module")
def navigation():
    return pages(yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"])


def test_every_room_has_a_page_made_of_its_docstrings():
    assert {path.stem for path in (DOCS / "reference").glob("*.md")} == {*ROOMS, "index"}
    for room in ROOMS:
        assert f"\n::: jaxquad.{room}\n" in (DOCS / "reference" / f"{room}.md").read_text()


def test_the_names_at_the_top_are_listed_with_their_rooms():
    rows = ROW.findall((DOCS / "reference" / "index.md").read_text())
    rest = {"__version__", "enable_compile_cache", "enable_x64", "engine"}  # of no room
    assert [name for name, *_ in rows] == sorted(set(dir(jq)) - {*ROOMS} - rest, key=str.lower)
    for name, room, original in rows:
        assert name == original
        assert getattr(jq, name) is getattr(importlib.import_module(f"jaxquad.{room}"), name)


@pytest.mark.parametrize("room", ROOMS)
def test_everything_public_has_a_docstring_that_begins_with_a_sentence(room):
    missing = []
    for name, value in documented(room).items():
        first = (inspect.getdoc(value) or "").split("\n")[0]
        inherited = inspect.isclass(value) and "__doc__" not in vars(value)
        if inherited or first.startswith(f"{name}(") or not re.search(r"([.?:]|`)$", first):
            missing.append(name)
    assert not missing


def test_the_navigation_names_every_page_and_notebook(navigation):
    expected = {path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md")}
    expected |= {f"notebooks/{path.stem}.md" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert len(navigation) == len(set(navigation)) and set(navigation) == expected


def test_the_index_leads_to_every_page_and_notebook():
    links = re.findall(r"(?<!!)\[[^]]+\]\(([\w./]+)\)", (DOCS / "index.md").read_text())
    linked = set(links)
    own = {path.name for path in DOCS.glob("*.md")} - {"index.md"}
    notebooks = {f"../notebooks/{path.name}" for path in (ROOT / "notebooks").glob("*.ipynb")}
    assert linked == own | notebooks | {"reference/index.md"}


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built with every warning as an error."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-q", "--site-dir", str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=os.environ)
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("room", ROOMS)
def test_every_class_and_function_stands_on_the_page_of_its_room(site, room):
    html = (site / "reference" / room / "index.html").read_text()
    shown = set(re.findall(rf'id="jaxquad\.{room}\.(\w+)"', html))
    assert not sorted(set(documented(room)) - shown)


@pytest.mark.slow
def test_the_site_loads_nothing_from_elsewhere(site):
    loading = re.compile(r'(?:src|href)="https?://[^"]+\.(?:js|css|woff2?)"')
    for page in site.rglob("*.html"):
        assert not loading.search(page.read_text()), page
