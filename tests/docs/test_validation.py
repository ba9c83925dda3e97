"""docs/validation.md is what the kept results of the studies say."""

import json
import sys

import pytest
from conftest import ROOT


STUDIES = ROOT / "tests" / "studies"
sys.path.append(str(STUDIES))
from page import page, studies  # noqa: E402  # pyright: ignore


def test_the_page_is_made_from_the_results():
    # Else: python tests/studies/page.py
    assert (ROOT / "docs" / "validation.md").read_text() == page()


@pytest.mark.parametrize("name", studies())
def test_every_result_names_a_command_that_is_there(name):
    found = json.loads((STUDIES / "results" / f"{name}.json").read_text())
    for table in found if isinstance(found, list) else [found]:
        python, script, *_ = table["command"].split()
        assert python == "python" and (ROOT / script).is_file()
        assert all(len(row) == len(table["columns"]) for row in table["rows"])


def test_the_readme_and_the_site_lead_to_the_page():
    assert "docs/validation.md" in (ROOT / "README.md").read_text()
    assert "validation.md" in (ROOT / "mkdocs.yml").read_text()
