"""What a user of a response should know, with the frequencies and the pair that it is about."""

import functools as ft
import itertools
from collections.abc import Callable, Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxquad._core import Message

from ._checks import in_hertz


Pair = tuple[str, str]  # output, input
DOMINATED, EARLY = "feedback-dominated", "output before input"  # kinds of remarks


class Remark(Message):
    """A sentence about a response that knows which frequencies it is about.

    It is the text itself, so it prints, joins and compares like any other string.

    **Arguments:**

    - `text`: what happened, the number, and what to do. `{where}` stands for the frequencies.
    - `omega`: the frequencies that it is about, in rad/s; none for the response as a whole.
    - `pair`: names of the output and the input that it is about; `None` for all pairs.
    - `kind`: what it is about, such as "leakage" or "nonlinear", for code that decides by it.
    """

    text: str
    omega: tuple[float, ...]
    pair: Pair | None

    def __new__(
        cls,
        text: str,
        omega: Sequence[float] | Float[np.ndarray, " points"] = (),
        pair: Pair | None = None,
        kind: str = "",
    ) -> "Remark":
        points = tuple(float(x) for x in omega)
        sentence = text.replace("{where}", _place(points))
        self: Remark = super().__new__(cls, sentence, kind)  # pyright: ignore[reportAssignmentType]
        self.text, self.omega, self.pair = text, points, pair
        return self

    def __getnewargs__(self) -> tuple[str, tuple[float, ...], Pair | None, str]:
        return self.text, self.omega, self.pair, self.kind

    def within(self, omega: Float[np.ndarray, " used"]) -> "Remark | None":
        """The same about those of its frequencies that are in `omega`; `None` for none of them."""
        if not self.omega:
            return self
        kept = [x for x in self.omega if np.any(np.abs(omega - x) <= 1e-9 * x)]
        return Remark(self.text, kept, self.pair, self.kind) if kept else None


class Remarks(Sequence[Remark]):
    """Remarks that are found when they are first looked at: tests take longer than an estimate."""

    def __init__(self, find: Callable[[], tuple[Remark, ...]]):
        self._find = find

    @ft.cached_property
    def _remarks(self) -> tuple[Remark, ...]:
        remarks = self._find()
        del self._find  # and with it the records
        return remarks

    def __len__(self) -> int:
        return len(self._remarks)

    def __getitem__(self, place):
        return self._remarks[place]

    def __iter__(self) -> Iterator[Remark]:
        return iter(self._remarks)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, tuple | Remarks) and self._remarks == tuple(other)

    def __hash__(self) -> int:
        return hash(self._remarks)

    def __repr__(self) -> str:
        return repr(self._remarks)

    def __reduce__(self) -> tuple[type[tuple], tuple[tuple[Remark, ...]]]:
        return tuple, (self._remarks,)


def _place(omega: tuple[float, ...]) -> str:
    if len(omega) <= 1:
        return f"near {in_hertz(np.array(omega))}" if omega else "everywhere"
    return f"at {len(omega)} frequencies, {in_hertz(np.array(omega))}"


def remarks_on_used(
    remarks: Sequence[Remark],
    omega: Float[np.ndarray, " frequencies"],
    used: Bool[np.ndarray, "frequencies outputs inputs"],
    outputs: Sequence[str],
    inputs: Sequence[str],
) -> tuple[Remark, ...]:
    """Those of the remarks that concern the points in use, each once."""
    kept = []
    for remark in remarks:
        mine = np.any(used, axis=(1, 2))
        if remark.pair is not None:
            mine = used[:, outputs.index(remark.pair[0]), inputs.index(remark.pair[1])]
        part = remark.within(omega[mine]) if np.any(mine) else None
        kept += [] if part is None else [part]
    return tuple(dict.fromkeys(kept))


def points_dominated(
    remarks: Sequence[Remark],
    omega: Float[np.ndarray, " frequencies"],
    outputs: Sequence[str],
    inputs: Sequence[str],
) -> Bool[np.ndarray, "frequencies outputs inputs"]:
    """Points that remarks name as dominated by feedback."""
    dominated = np.zeros((omega.size, len(outputs), len(inputs)), bool)
    for remark in remarks:
        if remark.kind != DOMINATED:
            continue
        here = np.isin(omega, remark.omega)
        pairs = [remark.pair] if remark.pair else itertools.product(outputs, inputs)
        for output, source in pairs:
            dominated[here, outputs.index(output), inputs.index(source)] = True
    return dominated
