"""Every module of fits/ imports, and so finds what it needs of the library."""

import importlib

import pytest
from conftest import ROOT


FITS = ROOT / "fits"
MODULES = sorted(
    ".".join(path.relative_to(FITS).with_suffix("").parts)
    for path in FITS.rglob("*.py")
    if path.name != "__init__.py"
)


@pytest.fixture(scope="module", autouse=True)
def searched():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(FITS))
        yield


@pytest.mark.parametrize("name", MODULES)
def test_it_imports(name):
    importlib.import_module(name)
