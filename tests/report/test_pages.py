"""What pages are made of: escaping, names in figures, what is left out, files."""

import hashlib
import os

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from html_pages import HOSTILE, is_image, Page, read_page, TRUTH
from synthetic import response_of

import jaxquad as jq
from jaxquad._core import write_file
from jaxquad.report import Cell, provenance, render_page, Table, write_report


def silent(frf):
    """The fit of a response that is coherent nowhere."""
    return jq.fit(TRUTH, eqx.tree_at(lambda f: f.coherence, frf, 0.1 * frf.coherence))


def test_a_figure_draws_any_name(tmp_path):
    time = np.arange(100) * 0.01
    waves = np.sin(np.outer(time, 1 + np.arange(len(HOSTILE))))
    record = jq.Record(time, waves, waves[:, 0], input_names=HOSTILE)
    frf = response_of(TRUTH, seed=0)
    page = read_page(write_report(tmp_path / "r.html", fit=silent(frf), frf=frf, record=record))
    assert page.errors == [] and all(is_image(*each) for each in page.figures())
    for attributes in page.of("img"):
        assert set(attributes) == {"alt", "width", "height", "src"}


def test_what_is_filled_in_is_escaped_and_made_visible():
    rows = [[Cell("<b>&", link='logs/"><x.html'), "'\"\ud800\u202eb", Cell("<i>", high=True)]]
    table = Table("<u>", ["<h>", Cell("{{ head }}"), "x"], rows)
    text = render_page(
        "summary.html", title="</title><script>", folder="<b>", count=1, counts="",
        parts=[{"key": '"><a', "title": "&", "table": table}],
    )  # fmt: skip
    page = Page(text)
    assert page.errors == [] and "script" not in {name for name, _ in page.elements}
    assert [each["href"] for each in page.of("a")] == ["table.csv", 'logs/"><x.html']
    shown = page.text("table")
    assert all(part in shown for part in ("<b>&", "'\"\ufffd\ufffdb", "<i>", "<u>", "{{ head }}"))


@pytest.mark.parametrize("code", [0, 8, 0x1B, 0x202E, 0x2066])
def test_no_control_character_reaches_a_page(code):
    text = render_page(
        "summary.html", title=chr(code), folder=f"a{chr(code)}b", count=0, counts="", parts=[]
    )
    assert not any(chr(code) == each for each in text) and "a\ufffdb" in text


class Wide(eqx.Module):
    """Two outputs of four inputs."""

    def frequency_response(self, omega):
        return jnp.tile(TRUTH.frequency_response(omega).reshape(-1, 1, 1), (1, 2, 4))


@pytest.mark.slow
def test_what_is_not_drawn_is_counted(tmp_path):
    fit, wide = silent(response_of(TRUTH, seed=0)), response_of(Wide(), seed=0)
    page = read_page(write_report(tmp_path / "r.html", fit=fit, frf=wide))
    assert len(page.of("img")) == 6 and "2 more responses are not drawn." in page.text("section")


def test_a_file_is_whole_or_not_there(tmp_path, monkeypatch):
    path = write_file(tmp_path / "report.html", "before")

    def full(_):
        raise OSError("no space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="no space left"):
        write_file(path, "after")
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]


def test_a_folder_is_hashed_by_the_order_of_its_names(tmp_path):
    for name in ("b", "a", "c"):
        (tmp_path / name).write_text(name)
    [source] = provenance(tmp_path).files
    assert source.sha256 == hashlib.sha256(b"abc").hexdigest() and source.size == 3
    assert provenance(tmp_path).files[0].name == tmp_path.name
    with pytest.raises(OSError):
        provenance(tmp_path / "none")
