"""Every text that the package can show, collected from its source by AST."""

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

from conftest import ROOT


PACKAGE = ROOT / "jaxquad"


@functools.cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    """Of the syntax of a file: to walk all of them takes a second for the package."""
    return tuple(ast.walk(ast.parse(path.read_text())))


@functools.cache
def messages() -> tuple[tuple[str, str], ...]:
    """Every text of four words or more that is neither a docstring nor an annotation."""
    found = []
    for path in sorted(PACKAGE.rglob("*.py")):
        silent = {id(node) for each in nodes(path) for node in _silent(each)}
        for node in nodes(path):
            if isinstance(node, ast.expr) and id(node) not in silent:
                place, text = f"{path.relative_to(ROOT)}:{node.lineno}", _text(node)
                found += [(place, text)] if len(text.split()) >= 4 else []
    return tuple(found)


def _silent(node: ast.AST) -> Iterator[ast.AST]:
    """What is not shown: docstrings, annotations (shapes), and the pieces of an f-string."""
    if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
        yield node.value
    if isinstance(node, ast.Subscript):
        yield from ast.walk(node.slice)
    if isinstance(node, ast.JoinedStr):
        yield from (each for value in node.values for each in ast.walk(value))


def _text(node: ast.AST) -> str:
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        parts = [v.value if isinstance(v, ast.Constant) else "X" for v in node.values]
        return "".join(map(str, parts))
    return ""
