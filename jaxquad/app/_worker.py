"""A process that computes for one tab, so that the page stays alive and a task can be cancelled."""

import asyncio
import contextlib
import logging
import multiprocessing
import signal
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any

from jaxquad._core import Message, STAGES
from jaxquad.workflows import in_options


Listener = Callable[[str, Any], None]  # what is told: "stage" with words, or the name of a part
_SPAWN = multiprocessing.get_context("spawn")  # JAX has threads, which do not survive a fork


class TaskError(Exception):
    """What a task raised, as it is `said`."""

    def __init__(self, said: str):
        super().__init__(said)
        self.said = said


class Cancelled(Exception):
    """The task was ended by `Worker.cancel`."""


class Worker:
    """Runs one task at a time: functions of `jaxquad.app._tasks`, in one process that stays warm.

    What a task leaves in its module, the next one finds there.
    """

    def __init__(self):
        self._process: BaseProcess | None = None
        self._connection: Connection | None = None
        self._turn = asyncio.Lock()

    def start(self) -> None:
        """Start the process, if none runs; it imports what tasks need."""
        if self._process is not None and self._process.is_alive():
            return
        self._connection, theirs = _SPAWN.Pipe()
        self._process = _SPAWN.Process(target=_serve, args=(theirs,))  # a batch has children
        self._process.start()
        theirs.close()  # or the end of the process would not show on ours

    async def run(self, task: str, *args: object, listener: Listener) -> Any:
        """What the task returns; the listener hears what it tells meanwhile.

        Raises TaskError for what it raises, and Cancelled.
        """
        async with self._turn:
            self.start()
            connection = self._connection
            assert connection is not None
            try:
                connection.send((task, args))
                while True:
                    kind, value = await asyncio.to_thread(connection.recv)
                    if kind == "returned":
                        return value
                    if kind == "raised":
                        raise TaskError(value)
                    listener(kind, value)
            except (EOFError, OSError) as error:  # the process has ended
                self._process = None
                if self._connection is None:
                    raise Cancelled from error
                raise TaskError(
                    "the process that computes has ended, most likely for lack of memory: close "
                    "other programs, or use a shorter range of the log"
                ) from error

    def cancel(self) -> None:
        """End the process, and with it the task."""
        process, self._connection = self._process, None
        if process is not None and process.is_alive():
            process.kill()


def _serve(connection: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # of the terminal, for the server alone
    import matplotlib

    from jaxquad._compile import enable_compile_cache, share_programs
    from jaxquad._core import enable_x64

    from . import _tasks

    matplotlib.use("Agg")
    enable_x64()
    enable_compile_cache()

    def tell(kind: str, value: object) -> None:
        connection.send((kind, value))

    STAGES.addHandler(_Told(tell))
    STAGES.setLevel(logging.INFO)
    STAGES.propagate = False
    with contextlib.suppress(EOFError, OSError):  # the server has ended
        while True:
            name, args = connection.recv()
            try:
                answer = "returned", getattr(_tasks, name)(*args, tell=tell)
            except (ValueError, OSError) as error:
                answer = "raised", str(in_options(error))
            except Exception as error:
                traceback.print_exc()
                answer = "raised", f"{type(error).__name__}: {error}"
            connection.send(answer)
            share_programs()  # not at the end: the process is killed


class _Told(logging.Handler):
    """Tells each stage."""

    def __init__(self, tell: Listener):
        super().__init__()
        self._tell = tell

    def emit(self, record: logging.LogRecord) -> None:
        self._tell("stage", str(Message(record.getMessage())))
