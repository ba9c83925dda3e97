"""Messages as values: what they are about, and which of their words are those of Python."""

from collections.abc import Callable, Iterable


class Message(str):
    """A text that is a value: it prints, joins and compares like any other string.

    **Arguments:**

    - `text`: words that belong to Python stand in guillemets: `"be interpolated («max_gap=»)"`.
      Another interface has its own for them. It looks them up by the words themselves, or by what
      stands before a bar: `"as «range|valid={'q': (-20, 20)}»"`.
    - `kind`: what it is about, for code that decides by it; the text is for readers alone.
    """

    marked: str  # with the guillemets
    kind: str

    def __new__(cls, text: str, kind: str = ""):
        marked = marked_text(text)
        self = super().__new__(cls, _replaced(marked, lambda term: term.rpartition("|")[2]))
        self.marked, self.kind = marked, kind or getattr(text, "kind", "")
        return self

    def __getnewargs__(self) -> tuple[str, str]:
        return self.marked, self.kind

    def in_words(self, word: Callable[[str], str]) -> "Message":
        """With the `word` of another interface for each term, which it gets with its key."""
        return Message(_replaced(self.marked, word), self.kind)


def _replaced(marked: str, word: Callable[[str], str]) -> str:
    texts = marked.replace("»", "«").split("«")
    return "".join(word(text) if k % 2 else text for k, text in enumerate(texts))


def marked_text(text: object) -> str:
    """A text, or what an error says, with its guillemets, to make another message of."""
    if isinstance(text, BaseException):
        text = text.args[0] if len(text.args) == 1 and isinstance(text.args[0], Message) else text
    return text.marked if isinstance(text, Message) else str(text)


def as_messages(texts: Iterable[str]) -> tuple[Message, ...]:
    """Each text as a message; what is one stays what it is."""
    return tuple(text if isinstance(text, Message) else Message(text) for text in texts)


def is_ours(kind: type[BaseException]) -> bool:
    """Whether a class of errors or warnings is the package's; those of NumPy, for one, are not."""
    return kind.__module__.partition(".")[0] == "jaxquad"
