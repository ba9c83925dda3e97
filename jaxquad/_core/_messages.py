"""Messages as values; numbers that a user gives, refused at once, by name and with the remedy."""

import functools as ft
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import ArrayLike


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


Number = float | int
Value = Number | ArrayLike  # of NumPy or JAX
_PLAIN = float | int | np.ndarray | np.generic


def is_concrete(x: object) -> bool:
    """Whether `x` has values to check, which a tracer under jit, vmap or grad has not."""
    if isinstance(x, _PLAIN):
        return True
    return not isinstance(x, _tracer())


@ft.cache
def _tracer() -> type:
    from jax.core import Tracer  # Designs and lists of channels need no JAX, nor its 0.3 s.

    return Tracer


def require_vector(name: str, value: Value, length: int) -> None:
    """Raise ValueError unless `value` is `[length]` or `[length, members]`."""
    shape = np.shape(value)
    if not shape or shape[0] != length:
        raise ValueError(
            f"{name} has shape {shape}, but it must be ({length},), or ({length}, members) "
            "for an ensemble: give one value for each axis."
        )


def require_finite(name: str, value: Value) -> None:
    """Raise ValueError for an inf or nan in `value`."""
    _require(name, value, np.isfinite, "finite", "look for the NaN or inf in it")


def require_positive(name: str, value: Value, remedy: str = "") -> None:
    """Raise ValueError unless all of `value` is above 0 and finite."""
    _require(name, value, lambda x: (x > 0) & np.isfinite(x), "above 0 and finite", remedy)


def require_nonnegative(name: str, value: Value, remedy: str = "") -> None:
    """Raise ValueError unless all of `value` is 0 or above, and finite."""
    _require(name, value, lambda x: (x >= 0) & np.isfinite(x), "0 or above and finite", remedy)


def require_all_positive(**values: Value) -> None:
    """`require_positive` for each of the named values."""
    for name, value in values.items():
        require_positive(name, value)


def require_all_nonnegative(**values: Value) -> None:
    """`require_nonnegative` for each of the named values."""
    for name, value in values.items():
        require_nonnegative(name, value)


def _require(
    name: str, value: Value, valid: Callable[[np.ndarray], np.ndarray], limit: str, remedy: str
) -> None:
    if is_concrete(value) and not np.all(valid(np.asarray(value))):
        text = f"{name} is {value}, but it must be {limit}"
        raise ValueError(f"{text}: {remedy}." if remedy else f"{text}.")


def require_band(omega_min: Number, omega_max: Number, sample_rate: Number) -> None:
    """Raise ValueError unless 0 < omega_min < omega_max < Nyquist (rad/s, Hz)."""
    require_all_positive(omega_min=omega_min, omega_max=omega_max, sample_rate=sample_rate)
    if omega_max <= omega_min:
        raise ValueError(
            f"omega_max {omega_max:.6g} rad/s is not above omega_min {omega_min:.6g} rad/s."
        )
    nyquist = np.pi * sample_rate
    if omega_max >= nyquist:
        raise ValueError(
            f"omega_max {omega_max:.6g} rad/s is not below {nyquist:.6g} rad/s, half the "
            f"sample_rate of {sample_rate:.6g} Hz: sample faster (25 times omega_max is the rule)."
        )


def whole_samples(name: str, seconds: Number, sample_rate: Number, *, fewest: int = 1) -> int:
    """The number of samples in `seconds`. Raises ValueError unless that is a whole number."""
    count = seconds * sample_rate
    if not np.isfinite(count):
        raise ValueError(f"{name} is {seconds} s at {sample_rate} Hz: it has to be finite.")
    rounded = round(count)
    if rounded < fewest or abs(count - rounded) > 1e-6:
        below = max(fewest, int(np.floor(count)))
        raise ValueError(
            f"{name} of {seconds:.9g} s is {count:.6g} samples at {sample_rate:.6g} Hz, not "
            f"a whole number of at least {fewest}: the nearest are {below / sample_rate:.9g} s and "
            f"{(below + 1) / sample_rate:.9g} s."
        )
    return rounded
