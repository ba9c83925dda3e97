"""Imports go from higher subjects to lower ones, and through their faces; names say something."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest
from conftest import ROOT
from package_messages import nodes, PACKAGE

from jaxquad.records.firmware import firmware_log


ORDER = (
    "_core", "_xla", "_compile", "records", "datasets", "excitation", "models", "spectra",
    "identify", "design", "control", "loops", "simulation", "ensembles", "tuning",
    "export", "plot", "report", "autopilot", "workflows", "app", "cli",
)  # fmt: skip
FILES = sorted(path for path in PACKAGE.rglob("*.py") if path.parent != PACKAGE)
FIRMWARES = {
    path.stem.strip("_")
    for path in PACKAGE.glob("autopilot/firmwares/*.py")
    if "\nFIRMWARE = " in path.read_text()
}


def imports(path: Path) -> Iterator[tuple[str, ...]]:
    """The absolute names of the modules of this package that a file imports."""
    own = path.relative_to(ROOT).with_suffix("").parts
    package = own[:-1]
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            yield (*base, *(node.module or "").split(".")) if node.module else base
        elif isinstance(node, ast.Import):
            yield from (tuple(name.name.split(".")) for name in node.names)


def test_the_list_of_rooms_is_that_of_the_folders():
    folders = {path.parent.relative_to(PACKAGE).parts[0] for path in FILES}
    assert folders == set(ORDER), "enter a new room in ORDER, docs/design.md and its diagram"


@pytest.mark.parametrize("room", ORDER)
def test_a_room_imports_lower_ones_only_and_through_their_faces(room):
    for path in (path for path in FILES if path.relative_to(PACKAGE).parts[0] == room):
        for name in imports(path):
            if name[0] != "jaxquad" or name[1:2] == (room,):
                continue
            assert len(name) > 1, f"{path} imports the package as a whole"
            line = f"{path.relative_to(ROOT)} imports {'.'.join(name)}"
            before = ORDER[: ORDER.index(room)]
            assert name[1] in before, f"{line}: a room imports only those before it in ORDER"
            private = [part for part in name[2:] if part.startswith("_")]
            assert not private, f"{line}: export it in the face of {name[1]}"


def test_what_knows_the_compilers_has_one_door():
    outside = [x for x in FILES if x.relative_to(PACKAGE).parts[0] not in ("_xla", "_compile")]
    for path in outside:
        names = {".".join(name[:2]) for name in imports(path)}
        assert "jaxquad._xla" not in names, f"{path} imports jaxquad._xla"


def test_no_file_but_its_own_asks_whether_a_firmware_is_the_one():
    for path in (path for path in FILES if "formats" not in path.parts):
        others = FIRMWARES - ({*path.stem.split("_")} if "firmwares" in path.parts else set())
        for node in nodes(path):
            if isinstance(node, ast.Compare):
                words = {x.value for x in ast.walk(node) if isinstance(x, ast.Constant)}
                line = f"{path.relative_to(ROOT)}:{node.lineno}"
                assert not others & words, f"{line}: ask a method or field of Firmware instead"


def test_the_file_format_of_a_firmware_of_the_package_is_among_the_formats():
    for name in FIRMWARES:
        log = firmware_log(name)
        assert log is not None, f"enter {name} in _LOGS of jaxquad/__init__.py"
        assert log.reader is None, f"enter the reader of {name} in READERS of records/formats"


TESTS = ROOT / "tests"
LOCAL = {path.stem: path for path in TESTS.glob("*.py")}
MEASURED = sorted(
    path for name in ("benchmarks", "studies") for path in (TESTS / name).glob("*.py")
)


def reached(path: Path, seen: frozenset[Path] = frozenset()) -> frozenset[Path]:
    """A file of the tests, and the files of the tests that it imports."""
    local = LOCAL | {other.stem: other for other in path.parent.glob("*.py")}
    for name in imports(path) if path not in seen else ():
        if len(name) == 1 and name[0] in local:
            seen = reached(local[name[0]], seen | {path})
    return seen | {path}


@pytest.mark.parametrize("path", MEASURED, ids=lambda path: path.name)
def test_what_pages_quote_is_measured_through_public_calls(path):
    for file in reached(path):
        names = [*imports(file), *names_of_imports(file), *attributes(file)]
        private = [".".join(name) for name in names if is_private(name)]
        line = f"{path.relative_to(ROOT)} needs {private} in {file.relative_to(ROOT)}"
        assert not private, f"{line}: measure what a user calls"


def names_of_imports(path: Path) -> Iterator[tuple[str, ...]]:
    for node in nodes(path):
        if isinstance(node, ast.ImportFrom) and not node.level:
            yield from ((*(node.module or "").split("."), name.name) for name in node.names)


def attributes(path: Path) -> Iterator[tuple[str, ...]]:
    """As `jq.room._file`."""
    for node in nodes(path):
        if isinstance(node, ast.Attribute):
            name = ast.unparse(node).split(".")
            yield ("jaxquad", *name[1:]) if name[0] == "jq" else tuple(name)


def is_private(name: tuple[str, ...]) -> bool:
    return name[0] == "jaxquad" and any(part.startswith("_") for part in name[1:])


VAGUE = {
    "found", "known", "given", "each", "own", "whole",
    "beside", "made", "told", "asked", "apart", "held",
}  # fmt: skip


def bindings(path: Path) -> Iterator[tuple[int, str]]:
    """The line and name of all that a file binds: variables, fields, arguments, functions."""
    for node in nodes(path):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.Attribute(attr=name, ctx=ast.Store()):
                yield node.lineno, name
            case ast.arg(arg=name) | ast.FunctionDef(name=name) | ast.ClassDef(name=name):
                yield node.lineno, name
            case ast.alias(asname=str(name)):
                yield node.lineno, name


def test_a_name_says_what_a_value_is():
    vague = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for path in FILES
        for line, name in (*bindings(path), (0, path.stem))
        if name.strip("_") in VAGUE
    ]
    assert not vague, "\n".join(["name the value by the field's noun:", *vague])
