"""Messages are plain: none contains a word that the house style bans (collected by AST)."""

import ast
import re
from collections.abc import Iterator

import pytest
from conftest import ROOT


PACKAGE = ROOT / "jaxquad"
BANNED = (
    r"\brigs?\b", r"\brooms?\b", r"\btold\b", r"\bCE\b", r"\bbuys?\b", r"\bnobody\b",
    r"\bjudge", r"\bmeans? nothing\b", r"\btaken back\b", r"\brefuses its\b", r"\bknobs?\b",
    r"\bis open\b", r"\bleaves? open\b", r"\bNote that\b", r"\bwhich ended at\b", r"\bwants?\b",
    r"\bas lines in the noise do\b", r"\bformerly\b", r"\bno longer\b(?! fall)",
)  # fmt: skip
DEFINED = {  # words that need a definition, and where a reader of the command line finds it
    "Newton decrement": ("docs/first_steps.md", r"- \*\*Newton decrement\*\*: half of"),
    "condition": ("docs/first_steps.md", r"- \*\*condition\*\*: how much worse"),
    "member": ("jaxquad/cli/_tune.py", r"A member is one plant"),
}


def messages() -> Iterator[tuple[str, str]]:
    """Every text of four words or more that is neither a docstring nor an annotation."""
    for path in sorted(PACKAGE.rglob("*.py")):
        tree = ast.parse(path.read_text())
        silent = {id(node) for each in ast.walk(tree) for node in _silent(each)}
        for node in ast.walk(tree):
            text = "" if id(node) in silent else _text(node)
            if isinstance(node, ast.expr) and len(text.split()) >= 4:
                yield f"{path.relative_to(ROOT)}:{node.lineno}", text


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


@pytest.fixture(scope="module")
def found():
    return list(messages())


def test_the_messages_are_found(found):
    texts = [text for _, text in found]
    assert len(texts) > 800
    assert any(text.startswith("channel X has a gap of X ms") for text in texts)


@pytest.mark.parametrize("word", BANNED)
def test_no_message_contains_a_banned_word(found, word):
    assert not [(place, text) for place, text in found if re.search(word, text)]


@pytest.mark.parametrize("word", DEFINED)
def test_a_term_that_messages_use_is_defined(found, word):
    assert any(word in text for _, text in found)
    path, definition = DEFINED[word]
    assert re.search(definition, (ROOT / path).read_text())
