"""A part of a page that cannot be computed says why, and costs no other part."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from jaxquad._core import is_ours, marked_text, Message


Arguments = ParamSpec("Arguments")
Part = TypeVar("Part")
FAILED = "failed"  # key of the reason, in what templates show instead of a section


class PageWarning(UserWarning):
    """A part of a result could not be computed; the rest is written."""

    def __init__(self, reason: str):
        super().__init__(Message(reason))


def reason_of(error: Exception) -> Message:
    """Why something could not be computed: the text of our errors, with the kind of all others."""
    text = " ".join(marked_text(error).split())
    if text and is_ours(type(error)):
        return Message(text)
    return Message(f"{type(error).__name__}{f': {text}' if text else ''}")


def attempt(
    compute: Callable[Arguments, Part], *args: Arguments.args, **named: Arguments.kwargs
) -> Part | dict[str, str]:
    """What `compute` returns, or the reason why it raised, which the page shows in its place."""
    try:
        return compute(*args, **named)
    except Exception as error:
        return {FAILED: reason_of(error)}
