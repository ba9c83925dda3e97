"""Messages are plain: none contains a word that the house style bans (collected by AST)."""

import re

import pytest
from conftest import ROOT
from package_messages import messages


BANNED = (
    r"\brigs?\b", r"\brooms?\b", r"\btold\b", r"\bCE\b", r"\bbuys?\b", r"\bnobody\b",
    r"\bjudge", r"\bmeans? nothing\b", r"\btaken back\b", r"\brefuses its\b", r"\bknobs?\b",
    r"\bis open\b", r"\bleaves? open\b", r"\bNote that\b", r"\bwhich ended at\b", r"\bwants?\b",
    r"\bas lines in the noise do\b", r"\bformerly\b", r"\bno longer\b(?! fall)",
)  # fmt: skip
DEFINED = {  # words that need a definition, and where a reader of the command line finds it
    "Newton decrement": ("docs/first_steps.md", r"- \*\*Newton decrement\*\*: half of"),
    "condition": ("docs/first_steps.md", r"- \*\*condition\*\*: how much worse"),
    "member": ("jaxquad/cli/_logs.py", r"A member is one plant"),
}


@pytest.fixture(scope="module")
def found():
    return messages()


@pytest.mark.slow
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
