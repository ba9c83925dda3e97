"""The pictures of the README, and the diagram of the rooms."""

from conftest import ROOT
from matplotlib.image import imread


def test_the_picture_is_wide_small_and_made_by_a_script_of_the_repository():
    picture = ROOT / "docs" / "images" / "log_to_gains.png"
    assert picture.stat().st_size < 120_000 and imread(picture).shape[:2] == (400, 1200)
    assert picture.name in (ROOT / "docs" / "site" / "figures.py").read_text()


def test_the_picture_of_the_page_is_small_and_made_by_a_script_of_the_repository():
    picture = ROOT / "docs" / "images" / "app.png"
    assert picture.stat().st_size < 160_000 and imread(picture).shape[1] == 1200
    assert picture.name in (ROOT / "docs" / "site" / "screen.py").read_text()


def test_the_diagram_shows_every_room():
    shown = (ROOT / "docs" / "images" / "rooms.svg").read_text()
    for face in (ROOT / "jaxquad").glob("*/__init__.py"):
        assert f">{face.parent.name}</text>" in shown
