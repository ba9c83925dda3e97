"""The documents run: their Python and shell blocks, and what they print; their links resolve."""

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from conftest import ROOT
from flight_logs import ardupilot, px4
from made_flights import write_flights
from test_notebooks import words


pytestmark = pytest.mark.usefixtures("compiled_quickly")
PAGES = sorted((ROOT / "docs").rglob("*.md"))
RUN = (
    "first_steps.md",
    "how_to.md",
    "limits.md",
    "measured.md",
    "own_log.md",
    "own_parts.md",
    "ten_tasks.md",
)
LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)\s]*)?\)")
BLOCK = re.compile(r"(?:<!-- (.*?) -->\n)?```(\w*)\n(.*?)```", flags=re.S)
EVERY = re.compile(r"^<!-- all blocks read (.*?) -->$", flags=re.M)
MARK = "--- printed by the next block ---"


class Block(NamedTuple):
    """Code, and what the plain block right after it says that it prints."""

    kind: str
    place: str  # the log it reads, or an empty string
    code: str
    printed: str


def blocks(page):
    """Those that run; a page's shell blocks come after its Python."""
    text = (ROOT / "docs" / page).read_text()
    found, every, kept = BLOCK.findall(text), EVERY.search(text), []
    for k, (remark, kind, code) in enumerate(found):
        if kind in ("python", "sh") and remark != "fragment":
            place = remark.removeprefix("reads ") or (every[1] if every else "")
            follows = k + 1 < len(found) and found[k + 1][1] == ""
            kept.append(Block(kind, place, code, found[k + 1][2] if follows else ""))
    return kept


CASES = [(page, place) for page in RUN for place in dict.fromkeys(b.place for b in blocks(page))]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "place"), CASES)
def test_the_blocks_of_a_page_run_and_print_what_it_shows(page, place, tmp_path, request):
    mine = [block for block in blocks(page) if block.place == place]
    lay_out(place, tmp_path, request)
    python = [block for block in mine if block.kind == "python"]
    parts = [f"print({MARK!r})\n{block.code}" for block in python]
    printed = run([sys.executable, "-c", "\n".join(parts)], tmp_path).split(f"{MARK}\n")[1:]
    shells = [block for block in mine if block.kind == "sh"]
    printed += [run(["bash", "-ec", block.code], tmp_path) for block in shells]
    for block, text in zip([*python, *shells], printed, strict=True):
        if block.printed:
            # Words, not digits: the last ones differ between processors.
            assert words(text) == words(block.printed)


def lay_out(place, folder, request):
    """The log that the blocks read, by the name that they have for it."""
    made = {
        "a made ArduPilot log": lambda: ardupilot(folder, 10),
        "a made PX4 log": lambda: px4(folder, state=2),
        "two made flights": lambda: write_flights(folder),
    }
    if place in made:
        made[place]()
    elif place:
        for path in sorted((request.getfixturevalue("data") / place).iterdir()):
            (folder / path.name).symlink_to(path.resolve())


def run(command, folder):
    scripts = Path(sys.executable).parent
    data = Path(os.environ.get("JAXQUAD_DATA", ROOT / ".." / "shared" / "data")).resolve()
    path = f"{scripts}{os.pathsep}{os.environ['PATH']}"
    environment = os.environ | {"PATH": path, "JAXQUAD_DATA": str(data)}
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, env=environment)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    "page", [*PAGES, ROOT / "README.md", ROOT / "CONTRIBUTING.md"], ids=lambda page: page.stem
)
def test_links_resolve(page):
    for target in LINK.findall(page.read_text()):
        if not target.startswith(("http:", "https:", "mailto:")):
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", RUN)
def test_every_block_of_code_runs_or_is_called_a_fragment(page):
    found = BLOCK.findall((ROOT / "docs" / page).read_text())
    assert all(kind in ("python", "sh", "") for _, kind, _ in found)
    assert all(
        remark == "fragment" or remark.startswith("reads ") for remark, *_ in found if remark
    )
    assert any(kind == "python" for _, kind, _ in found)


def test_each_of_the_ten_tasks_takes_six_lines_at_most():
    _, *tasks = re.split(r"^## ", (ROOT / "docs" / "ten_tasks.md").read_text(), flags=re.M)
    assert [task.partition(".")[0] for task in tasks] == [str(k) for k in range(1, 11)]
    for task in tasks:
        ((_, kind, code),) = [found for found in BLOCK.findall(task) if found[1]]
        assert kind == "python" and len([line for line in code.splitlines() if line.strip()]) <= 6
