"""What a tab works on: its files, its worker and its results; a reload finds them again."""

import asyncio
import re
import secrets
import shutil
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import uvicorn
from nicegui import Client

from jaxquad.workflows import AutopilotSettings, limits_of, LogView

from ._shown import AxisResult, Files, Outcome, Tuned
from ._worker import Cancelled, TaskError, Worker


_KEPT = 30.0  # s for which what a tab works on waits for its reload
_MIDDLE = 0.5  # of a slider
_PAUSE, _REST = 0.2, 1.0  # s after a slider was moved: for further moves, before files are written


class Session:
    """Of one tab. Who shows it is in `listeners`, and is told which part has changed."""

    def __init__(self, folder: Path, worker: Worker):
        self.folder, self.worker = folder, worker
        self.listeners: dict[str, Callable[[str], None]] = {}  # by the client
        self.key = secrets.token_urlsafe(16)  # of its files' addresses
        self.view: LogView | None = None
        self.settings = AutopilotSettings()
        self.sharpness = self.heat = _MIDDLE  # where the sliders stand
        self._modelled = ""  # the axis whose response and model are shown
        self.axes: dict[str, AxisResult] = {}
        self._before: dict[str, AxisResult] = {}  # as proposed before any slider was moved
        self.tuned: Tuned | None = None
        self.outcomes: dict[str, Outcome] = {}  # by the task: identify, batch or compare
        self.files: Files = {}  # of what was tuned
        self.stage = ""  # of the task that runs; empty: none
        self.error = ""
        self.empty_since = time.monotonic()
        self._era = self._running = 0  # tasks of earlier eras are not heard; those that run or wait
        self._wanted: Mapping[str, float] | None = None  # limits that sliders ask for

    def changed(self, part: str) -> None:
        for listener in list(self.listeners.values()):
            listener(part)

    def place(self, name: str, folder: Path) -> Path:
        """A new place for a file that was dropped, under a name that no file system minds."""
        plain = re.sub(r"[^\w.()+ -]", "_", Path(name.replace("\\", "/")).name).strip(". ")[-80:]
        path = folder / (plain or "log")
        return path.with_name(f"{secrets.token_hex(2)}-{path.name}") if path.exists() else path

    def new_folder(self) -> Path:
        """For what is dropped at once."""
        folder = self.folder / secrets.token_hex(4)
        folder.mkdir(parents=True)
        return folder

    async def run(self, task: str, *args: object) -> Any:
        """A task's result, None where it failed or was cancelled; `error` says why.

        It waits for those that were asked for before.
        """
        mine, error = self._era, ""

        def hear(kind: str, value: Any) -> None:
            if self._era != mine:  # it was cancelled, and is still being read
                return
            if kind == "stage":
                self.stage = value
                self.changed("stage")
            elif kind == "axis":
                self.axes[value.axis], self.files = value, {}
                self.changed("lights" if self.tuned is None else "tuned")

        self._running += 1
        self.stage, self.error = self.stage or "starting", ""
        self.changed("stage")
        try:
            return await self.worker.run(task, *args, listener=hear)
        except TaskError as raised:
            error = re.sub(rf"{re.escape(str(self.folder))}/\w+/", "", raised.said)  # names alone
        except Cancelled:
            error = "cancelled"
        finally:
            if self._era == mine:
                self._running -= 1
                self.stage = self.stage if self._running else ""
                self.error = error or self.error
                self.changed("stage")

    def _make_way(self) -> None:
        """What is asked for now counts, not what still runs: another era begins."""
        if self._running:
            self._era, self._running, self.stage = self._era + 1, 0, ""
            self.worker.cancel()

    async def open(self, path: Path, flight: int | None = None) -> None:
        """Read a log, and tune it where its firmware is known; else what was there stays."""
        self._make_way()
        view = await self.run("look", path, flight)
        if view is None:
            return
        self.view, self.axes, self.tuned, self.files = view, {}, None, {}
        for task in ("identify", "batch", "model"):
            self.outcomes.pop(task, None)
        self.settings = AutopilotSettings(flight=flight)
        self.changed("log")
        if view.can_be_tuned:
            await self.tune()

    async def open_many(self, folder: Path) -> None:
        """Identify each log of a folder."""
        self._make_way()
        self.view, self.axes, self.tuned, self.files = None, {}, None, {}
        self.changed("log")
        await self.work_out("batch", folder)

    async def open_demo(self) -> None:
        """As `open`, of a simulated flight."""
        self._make_way()
        path = await self.run("demo", self.new_folder())
        if path is not None:
            await self.open(path)

    async def tune(self) -> None:
        """All axes of the log with the settings."""
        self._make_way()
        if self.view is not None:
            self.axes, self._before, self.tuned, self.files = {}, {}, None, {}
            self.sharpness = self.heat = _MIDDLE
            self.changed("log")
            self._show_tuned(await self.run("tune", self.view.path, self.settings))
            await self._write_files()

    def limits_text(self, sharpness: float, heat: float) -> str:
        """In words."""
        limits = limits_of(sharpness, heat)
        return (
            f"Worst Ms at most {limits['sensitivity']:.2f}, peak of the response at most "
            f"{limits['resonance']:.2f}, noise of the command at most {limits['noise']:.2f} times "
            "what flew. Calm limits the overshoot; cool limits the noise, and with it the gains."
        )

    async def retune(self, sharpness: float, heat: float) -> None:
        """The same plants within the limits of the sliders; the last ones that were asked for."""
        self.sharpness, self.heat = sharpness, heat
        busy, self._wanted = self._wanted is not None, limits_of(sharpness, heat)
        self._before = self._before or dict(self.axes)
        while not busy and self._wanted is not None:
            await asyncio.sleep(_PAUSE)
            limits = self._wanted
            tuned = await self.run("retune", limits)
            if self._wanted is limits or tuned is None:
                self._wanted = None
                self._show_tuned(tuned)
        if not busy:
            await asyncio.sleep(_REST)
            await self._write_files()

    def _show_tuned(self, tuned: Tuned | None) -> None:
        if tuned is not None:
            self.tuned, self.files = tuned, {}
            self.axes = {one.axis: one for one in tuned.axes}
            self.changed("tuned")

    def before_slider(self, one: AxisResult) -> AxisResult | None:
        """What was proposed for the axis before any slider was moved, where it differs."""
        before = self._before.get(one.axis)
        if before is None or (before.kind, before.changes) == (one.kind, one.changes):
            return None
        return before

    async def _write_files(self) -> None:
        """Of what was tuned last, unless a slider was moved meanwhile."""
        tuned = self.tuned
        if tuned is None or self.files or self._wanted is not None:
            return
        files = await self.run("tuned_files")
        if files is not None and self.tuned is tuned:
            self.files = files
            self.changed("files")

    async def work_out(self, task: str, *args: object) -> None:
        """An identification, a batch or a comparison."""
        self._make_way()
        self.outcomes.pop(task, None)
        self.changed("outcome")
        outcome = await self.run(task, *args)
        if outcome is not None:
            self.outcomes[task] = outcome
        self.changed("outcome")

    @property
    def stem(self) -> str:
        """What the names of its files begin with when they are saved: that of the log."""
        return "" if self.view is None else f"{self.view.path.stem}_"

    async def show_model(self, axis: str) -> None:
        """Response and model of an axis that was tuned; asked for again, they go."""
        again = self.outcomes.pop("model", None) is not None and self._modelled == axis
        self._modelled = axis
        self.changed("outcome")
        if again:
            return
        outcome = await self.run("model", axis)
        if outcome is not None:
            self.outcomes["model"] = outcome
            self.changed("outcome")

    def file(self, name: str) -> bytes | None:
        """What a task wrote."""
        files = [self.files, *(outcome.files for outcome in self.outcomes.values())]
        return next((x[name] for x in files if name in x), None)

    def close(self) -> None:
        self.worker.cancel()
        shutil.rmtree(self.folder, ignore_errors=True)


class Sessions:
    """Those of all tabs; one worker is started before it is needed."""

    def __init__(self, folder: Path, log: Path | None):
        self._folder, self._log = folder, log
        self._of: dict[str, Session] = {}
        self._spare = Worker()

    def of_tab(self, client: Client) -> Session:
        """The session of a client's tab, new for a new tab."""
        tab = str(client.tab_id)
        if tab not in self._of:
            worker, self._spare = self._spare, Worker()
            worker.start()
            self._of[tab] = Session(self._folder / secrets.token_hex(8), worker)
        session = self._of[tab]
        client.on_delete(lambda: self._left(session, client.id))
        return session

    def _left(self, session: Session, client: str) -> None:
        session.listeners.pop(client, None)
        session.empty_since = time.monotonic()

    def take_log(self) -> Path | None:
        """The file of the command line, for the first tab alone."""
        log, self._log = self._log, None
        return log

    def file(self, key: str, name: str) -> bytes | None:
        """What a task wrote; nothing else of the disk has an address."""
        for session in self._of.values():
            if secrets.compare_digest(session.key.encode(), key.encode()):
                return session.file(name)
        return None

    async def watch(self, server: uvicorn.Server, first: float, after: float) -> None:
        """Forget closed tabs, and end the server when there has been none for some time."""
        self._spare.start()
        empty, limit = time.monotonic(), first
        while True:
            await asyncio.sleep(0.5)
            now = time.monotonic()
            for tab, session in list(self._of.items()):
                if session.listeners:
                    empty, limit = now, after
                elif now - session.empty_since > min(_KEPT, after):
                    self._of.pop(tab).close()
            if now - empty > limit:
                server.should_exit = True
                return

    def close(self) -> None:
        for session in self._of.values():
            session.close()
        self._spare.cancel()
