import pytest

from jaxquad.cli import main


@pytest.fixture(scope="session")
def demo(tmp_path_factory):
    """The folder of `jaxquad demo`; tests only read it."""
    folder = tmp_path_factory.mktemp("demo")
    assert main(["demo", "--out", str(folder)]) == 0
    return folder
