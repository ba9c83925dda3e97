"""Work in a second process beside the caller's, for a command that will want two results at once.

Threads of Python take turns; a process does not, but it has to import first what it runs. So a
command line starts one early, and ends it; functions of the library use it where there is one.
"""

import contextlib
import os
import pickle
import subprocess
import sys
import threading
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any, Generic, IO, NamedTuple, ParamSpec, TypeVar

from ._garbage import collect_seldom
from ._stages import STAGES
from ._threads import available_cores


_VARIABLE = "JAXQUAD_SECOND_PROCESS"  # "off"
_ALONE = {  # it has one core, and a GPU's memory is the caller's
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "JAX_PLATFORMS": "cpu",
}
_START = "import sys; sys.path[:] = {}; from jaxquad._core._beside import serve; serve()"

Given = ParamSpec("Given")
Found = TypeVar("Found")


class Call(NamedTuple):
    """What pickles by its name, and what it is given."""

    function: Callable[..., Any]
    args: tuple[Any, ...]
    named: dict[str, Any]


class Answer(NamedTuple):
    """What became of a call: an error is raised, and warnings are given, where it is asked for."""

    found: Any = None
    error: Exception | None = None
    warned: tuple[tuple[Warning, type[Warning], str, int], ...] = ()


class Later(Generic[Found]):
    """What a function will have returned when it is asked for."""

    def __init__(self, call: Call, second: "_Second | None", *, shared: bool = True):
        self.call, self._second = call, second
        self.shared = shared  # whether the caller may compute it while it waits for another one
        self.answer: Answer | None = None

    @classmethod
    def known(cls, found: Found) -> "Later[Found]":
        """Of something that is there."""
        later = cls(Call(_same, (found,), {}), None)
        later.answer = Answer(found)
        return later

    def check(self) -> None:
        """Raise what the call has raised, if that is known by now."""
        if self.answer is not None and self.answer.error is not None:
            self.get()

    def get(self) -> Found:
        """The result; until it is there, this process computes what nobody has begun."""
        while self.answer is None:
            mine = self if self._second is None else self._second.claim(self)
            if mine is not None:
                mine.answer = _answer_here(mine.call)
        for each in self.answer.warned:
            warnings.warn_explicit(*each)
        if self.answer.error is not None:
            raise self.answer.error
        return self.answer.found


def _same(found: Found) -> Found:
    return found


def beside(
    function: Callable[Given, Found], *args: Given.args, **named: Given.kwargs
) -> Later[Found]:
    """Have the second process call `function`, or without one the first `get()` of the result.

    The function is one of a module; it, what it is given and what it returns can be pickled.
    """
    later: Later[Found] = Later(Call(function, args, named), _second)
    if _second is not None:
        _second.add(later)
    return later


def behind(
    function: Callable[Given, Found], *args: Given.args, **named: Given.kwargs
) -> Later[Found]:
    """As `beside`, for what is wanted last: the second process takes it when the caller waits.

    A caller that begins with what it wants first, and shares parts of it, would find the process
    busy. Of several, the last call is taken first.
    """
    later: Later[Found] = Later(Call(function, args, named), _second, shared=False)
    if _second is not None:
        _second.hold(later)
    return later


def has_second_process() -> bool:
    """Whether `beside` has one."""
    return _second is not None


def start_second_process() -> None:
    """Start it, if there is none.

    Nothing is started where this process may use one core, with JAXQUAD_SECOND_PROCESS=off in the
    environment, and outside of `allowed_second_process`.
    """
    global _second
    if _wanted and _second is None and available_cores() > 1 and sys.executable:
        with contextlib.suppress(OSError):
            _second = _Second()


def prepare_second_process(prepare: Callable[[], None], *, last: bool = False) -> None:
    """Have it call `prepare` next, a function of a module that imports what will be called.

    Or as `behind` does it, with `last`.
    """
    if _second is not None:
        take = _second.hold if last else _second.add
        take(Later(Call(prepare, (), {}), None, shared=False))


@contextlib.contextmanager
def allowed_second_process() -> Iterator[None]:
    """Allow a second process within, which ends with it; with the outer one, within another."""
    global _wanted
    if _wanted:
        yield
        return
    _wanted = os.environ.get(_VARIABLE) != "off"
    try:
        yield
    finally:
        _wanted = False
        end_second_process()


def end_second_process() -> None:
    """From here on there is none; what it had not finished is computed when it is asked for."""
    global _second
    if _second is not None:
        _second.end()
    _second = None


class _Second:
    def __init__(self):
        self._waiting: deque[Later] = deque()
        self._held: deque[Later] = deque()  # until the caller waits
        self._released: deque[Later] = deque()  # held before: behind all that waits
        self._idle = False  # then the first that waits is the process's
        self._changed = threading.Condition()
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START.format(sys.path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | _ALONE,
            start_new_session=True,  # an interrupt is for the caller's process
        )
        self._ended = False
        self._feeding = threading.Thread(target=self._feed, daemon=True)
        self._feeding.start()

    def add(self, later: Later) -> None:
        with self._changed:
            self._waiting.append(later)
            self._changed.notify_all()

    def hold(self, later: Later) -> None:
        with self._changed:
            self._held.appendleft(later)

    def claim(self, wanted: Later) -> Later | None:
        """What the caller computes while it waits: the result itself, or the last that waits."""
        with self._changed:
            self._released.extend(self._held)
            self._held.clear()
            self._changed.notify_all()
            self._changed.wait_for(lambda: wanted.answer or self._mine(wanted))
            if wanted.answer:
                return None
            mine = self._mine(wanted)[-1]
            (self._waiting if mine in self._waiting else self._released).remove(mine)
            return mine

    def _mine(self, wanted: Later) -> list[Later]:
        free = [*self._waiting, *self._released][self._idle :]
        return [wanted] if wanted in free else [each for each in free if each.shared]

    def end(self) -> None:
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        with contextlib.suppress(OSError), self._process:  # which closes its pipes
            self._process.kill()
            self._feeding.join()

    def _feed(self) -> None:
        """Hand one call after the other to the process; without it, leave them to the caller."""
        assert self._process.stdin is not None and self._process.stdout is not None
        later = None
        try:
            while (later := self._next()) is not None:
                _send(later.call, self._process.stdin)
                answer = pickle.load(self._process.stdout)
                with self._changed:
                    later.answer = answer
                    self._changed.notify_all()
        except Exception:  # whatever it was: where it happens again, the caller sees it
            STAGES.debug("no second process from here on", exc_info=True)
            with self._changed:
                self._waiting.extendleft([] if later is None else [later])
                self._changed.notify_all()

    def _next(self) -> Later | None:
        with self._changed:
            self._idle = True
            self._changed.wait_for(lambda: self._waiting or self._released or self._ended)
            self._idle = False
            return None if self._ended else (self._waiting or self._released).popleft()


_wanted = False
_second: _Second | None = None


def _send(what: object, file: IO[bytes]) -> None:
    file.write(pickle.dumps(what, pickle.HIGHEST_PROTOCOL))
    file.flush()


def _answer_here(call: Call) -> Answer:
    try:
        return Answer(call.function(*call.args, **call.named))
    except Exception as error:
        return Answer(error=error)


def _answer_there(call: Call) -> Answer:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        answer = _answer_here(call)
    warned = tuple((w.message, w.category, w.filename, w.lineno) for w in caught)
    return answer._replace(warned=warned)  # pyright: ignore[reportArgumentType]


def serve() -> None:
    """Answer the calls on stdin, until it ends: what is printed must not come among the answers."""
    collect_seldom()
    calls, answers = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    with contextlib.suppress(EOFError, BrokenPipeError):
        while True:
            _send(_answer_there(pickle.load(calls)), answers)
