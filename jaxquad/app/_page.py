"""The page of a tab: it shows what the session works on, and asks it to work."""

from collections.abc import Coroutine
from pathlib import Path
from typing import Any

from nicegui import background_tasks, events, ui

from jaxquad.records import AXES
from jaxquad.workflows import AutopilotSettings, IdentifySettings, SettingsError

from ._figures import Span, Traces
from ._panels import (
    Form,
    heading,
    RecipePanel,
    show_changes,
    show_files,
    show_lights,
    show_outcome,
    show_steps,
)
from ._session import Session


_STYLE, _SCRIPT = (Path(__file__).with_name(name) for name in ("style.css", "page.js"))
_PARTS = {  # what is shown again when a part of the session has changed
    "stage": ("progress",),
    "log": ("log", "lights", "model", "tuning", "tuned", "files", "outcome", "compared"),
    "lights": ("lights",),
    "tuned": ("lights", "tuned", "files"),
    "files": ("files",),
    "outcome": ("outcome", "model", "compared"),
}
_CHANNELS = ("input", "output", "reference")  # of an identification, which are chosen by clicks
_MOST_FILES = 200


class Page:
    """Of one tab, on its session."""

    def __init__(self, session: Session):
        self.session, self.client = session, ui.context.client
        self._axis = ""  # whose traces are shown
        self._has_sliders = False
        self._recipe = RecipePanel(session)
        self._pair: dict[str, Path] = {}  # logs before and after
        self._seen = self._results()
        session.listeners[self.client.id] = self.refresh

    def refresh(self, part: str) -> None:
        """Show a part of the session again, and what depends on it."""
        for section in _PARTS[part]:
            getattr(self, section).refresh()
        if part == "tuned" and not self._has_sliders:  # who moves one has the focus on it
            self.sliders.refresh()
        before, self._seen = self._seen, self._results()
        for name, result in self._seen.items():
            again = name == part == "log"  # its heading is another one, without the focus
            if result and (again or result is not before.get(name)):
                self.client.run_javascript(f"jaxquad.go({name!r})")

    def _results(self) -> dict[str, object]:
        """By the names of headings; gains that a slider changes are where they were."""
        session = self.session
        return {"log": session.view, "lights": session.tuned is not None, **session.outcomes}

    def start(self, work: Coroutine[Any, Any, None]) -> None:
        """Let the session work while the page stays alive, and goes to what is new."""
        self.client.run_javascript("jaxquad.moved = false")
        background_tasks.create(work)

    def build(self) -> None:
        """All of it, as the session stands."""
        ui.add_css(_STYLE)
        self.client.run_javascript(_SCRIPT.read_text(encoding="utf-8"))
        ui.colors(primary="#0550ae")
        dark = ui.dark_mode(None)
        with ui.element("header"):
            heading("jaxquad", 1)
            ui.label("from a flight log to proven gains").classes("soft")
            ui.space()
            button = ui.button(icon="contrast", on_click=lambda: dark.set_value(not dark.value))
            button.props('flat round aria-label="light or dark"')
        with ui.element("main"):
            with ui.tabs().props("no-caps align=left").classes("tabs") as tabs:
                tune, compare, fly = map(ui.tab, ("Tune", "Compare", "What to fly"))
            tabs.on_value_change(self._change_tab)
            self._tabs, self._fly = tabs, fly
            self.progress()
            with ui.tab_panels(tabs, value=tune, animated=False, keep_alive=False):
                with ui.tab_panel(tune):
                    self._drop()
                    self.log()
                    self.outcome()
                    self.lights()
                    self.model()
                    self.tuning()
                    self.tuned()
                    self.files()
                with ui.tab_panel(compare):
                    self._drop_two()
                    self.compared()
                with ui.tab_panel(fly):
                    self._recipe.build()

    def _change_tab(self, event: events.ValueChangeEventArguments) -> None:
        """An error is of the tab on which it came; what to fly is of the log."""
        if event.value == self._fly.props["name"]:
            self._recipe.follow_log()
        if self.session.error and not self.session.stage:
            self.session.error = ""
            self.progress.refresh()

    def _show_recipe(self, axis: str) -> None:
        view = self.session.view
        assert view is not None
        self._tabs.value = self._fly
        self._recipe.choose(view.firmware, axis)
        self.client.run_javascript("jaxquad.moved = false; jaxquad.go('recipe')")

    @ui.refreshable_method
    def progress(self) -> None:
        stage, error = self.session.stage, self.session.error
        with ui.element("div").props('aria-live="polite"').classes("progress"):
            if stage:
                ui.spinner(size="1.4em")
                ui.label(f"{stage[0].upper()}{stage[1:]} ...")
                cancel = ui.button("Cancel", on_click=self.session.worker.cancel)
                cancel.props("outline dense no-caps")
            elif error:
                ui.icon("error").classes("bad")
                ui.label(error).classes("error")

    def _drop(self) -> None:
        with ui.element("section"):
            heading("Drop a flight log", 2)
            ui.label(
                "Betaflight, ArduPilot, PX4, Crazyflie, or any CSV, MAT, NPZ. Several files are "
                "identified one by one, as a table. They stay on this machine."
            ).classes("soft")
            self._upload("log", self._dropped, most=_MOST_FILES)
            demo = ui.button(
                "No log at hand? Try a simulated flight",
                on_click=lambda: self.start(self.session.open_demo()),
            )
            demo.props("flat no-caps")

    def _upload(self, what: str, use: Any, most: int = 1) -> None:
        upload = ui.upload(
            multiple=most > 1, on_multi_upload=use, auto_upload=True, max_files=most,
            label=f"Drop the {what} here, or choose it with +",
        )  # fmt: skip
        upload.props("flat bordered").classes("upload")

    async def _dropped(self, event: events.MultiUploadEventArguments) -> None:
        paths = await self._saved(event)
        if len(paths) == 1:
            self.start(self.session.open(paths[0]))
        elif paths:
            self.start(self.session.open_many(paths[0].parent))

    async def _saved(self, event: events.MultiUploadEventArguments) -> list[Path]:
        folder, paths = self.session.new_folder(), []
        for file in event.files:
            paths.append(self.session.place(file.name, folder))
            await file.save(paths[-1])
        event.sender.reset()  # pyright: ignore[reportAttributeAccessIssue]
        return paths

    @ui.refreshable_method
    def log(self) -> None:
        view = self.session.view
        if view is None:
            return
        with ui.element("section"):
            title = f"{view.path.name} ({view.title})" if view.title else view.path.name
            heading(title, 2, "log")
            if not view.can_be_tuned:
                self._choose_channels()
                return
            for flight in view.flights:
                if len(view.flights) == 1:
                    ui.label(str(flight))
                else:
                    self._flight(flight)
            self._axis = view.first_axis
            usable = [axis for axis, one in view.axes.items() if one.channels]
            toggle = ui.toggle(usable, value=self._axis, on_change=self._show_axis)
            toggle.props('no-caps aria-label="axis whose traces are shown"')
            self.traces()

    def _flight(self, flight: Any) -> None:
        view = self.session.view
        assert view is not None
        used = flight.number == view.flight
        button = ui.button(
            str(flight), icon="check" if used else "radio_button_unchecked",
            on_click=lambda: self.start(self.session.open(view.path, flight.number)),
        )  # fmt: skip
        button.props("flat no-caps align=left").classes("flight")

    def _show_axis(self, event: events.ValueChangeEventArguments) -> None:
        self._axis = event.value
        self.traces.refresh()

    @ui.refreshable_method
    def traces(self) -> None:
        view, settings = self.session.view, self.session.settings
        if view is None or self._axis not in view.axes:
            return
        one = view.axes[self._axis]
        ui.label(one.excitation).classes("soft")
        channels = {
            what: view.shown[name] for what, name in one.channels.items() if name in view.shown
        }
        if channels:
            start, stop = settings.start, settings.stop
            taken = one.span if start is None and stop is None else (start, stop)
            # Where each axis has a chirp of its own, the range of one is none of the others.
            alone = view.has_chirps_apart
            word = f"Tune {self._axis} alone on this range" if alone else "Tune on this range"
            Traces(channels, taken, word, lambda span: self._tune_on(span, alone))

    def _tune_on(self, span: Span, alone: bool) -> None:
        changes = {"start": span[0], "stop": span[1], "axis": self._axis if alone else "all"}
        self.session.settings = self.session.settings.changed(changes)
        self.start(self.session.tune())

    def _choose_channels(self) -> None:
        """Of a log whose firmware has no gains to tune: command, rate and reference to identify."""
        view, session = self.session.view, self.session
        assert view is not None
        proposal = view.axes[view.first_axis].proposal if view.first_axis else None
        names = {
            x.name: f"{x.name} ({x.samples} samples, {x.minimum:.4g} to {x.maximum:.4g} {x.unit})"
            for x in view.channels
        }
        ui.label(
            "Choose what moves the vehicle (input) and what is measured (output). Under feedback, "
            "choose a reference, too, that no feedback computes."
            if proposal is None else "The log proposes its channels; all can be changed below."
        )  # fmt: skip
        fields = {
            what: ui.select(names, label=what, with_input=True, clearable=True).classes("channel")
            for what in _CHANNELS
        }
        with ui.expansion("All settings").classes("expert"):
            form = Form(IdentifySettings, _CHANNELS)

        def identify(span: Span = (None, None)) -> None:
            ends = {key: x for key, x in zip(("start", "stop"), span, strict=True) if x is not None}
            names = {what: field.value for what, field in fields.items() if field.value}
            try:
                settings = IdentifySettings.from_mapping(ends | form.read() | names)
            except SettingsError as error:
                ui.notify(str(error), type="negative")
                return
            self.start(session.work_out("identify", view.path, settings))

        ui.button("Identify", on_click=lambda: identify()).props("no-caps")
        shown = ui.element("div")

        async def draw() -> None:
            chosen = [field.value for field in fields.values() if field.value]
            channels = await session.run("read_traces", view.path, chosen) if chosen else None
            shown.clear()
            if channels:
                with shown:
                    Traces(channels, (None, None), "Identify on this range", identify)

        for field in fields.values():
            field.on_value_change(draw)

    @ui.refreshable_method
    def outcome(self) -> None:
        for task in ("identify", "batch"):
            show_outcome(self.session, task)

    @ui.refreshable_method
    def lights(self) -> None:
        session = self.session
        if session.view is not None and session.view.can_be_tuned:
            with ui.element("section"):
                heading("Roll, pitch, yaw", 2, "lights")
                ask = lambda axis: self.start(session.show_model(axis))
                show_lights(session, AXES, ask, self._show_recipe)

    @ui.refreshable_method
    def model(self) -> None:
        show_outcome(self.session, "model")

    @ui.refreshable_method
    def tuning(self) -> None:
        session = self.session
        if session.view is None or not session.view.can_be_tuned:
            return
        with ui.element("section"):
            heading("Tune", 2)
            self.sliders()
            with ui.expansion("All settings").classes("expert"):
                form = Form(AutopilotSettings, ("start", "stop"), session.settings.content())
                button = ui.button("Tune with these", on_click=lambda: self._tune_with(form))
                button.props("no-caps")

    @ui.refreshable_method
    def sliders(self) -> None:
        session = self.session
        self._has_sliders = session.tuned is not None and session.tuned.movable
        if not self._has_sliders:
            text = "Two sliders are here when all axes are done, where one has gains."
            ui.label(text).classes("soft")
            return

        def release() -> None:
            self.start(session.retune(sharp.value, heat.value))

        with ui.element("div").classes("sliders"):
            sharp = _slider("calm", "sharp", session.sharpness, "how sharp the loop may be")
            heat = _slider("cool motors", "warm motors", session.heat, "how much noise may grow")
        words = ui.label(session.limits_text(sharp.value, heat.value)).classes("soft")
        for slider in (sharp, heat):
            slider.on_value_change(
                lambda: words.set_text(session.limits_text(sharp.value, heat.value))
            )
            slider.on("change", release)  # when it is let go

    def _tune_with(self, form: Form) -> None:
        session = self.session
        span = {"start": session.settings.start, "stop": session.settings.stop}
        try:
            session.settings = AutopilotSettings.from_mapping(span | form.read())
        except SettingsError as error:
            ui.notify(str(error), type="negative")
            return
        self.start(session.tune())

    @ui.refreshable_method
    def tuned(self) -> None:
        show_changes(self.session)
        show_steps(self.session)

    @ui.refreshable_method
    def files(self) -> None:
        show_files(self.session)

    def _drop_two(self) -> None:
        with ui.element("section"):
            heading("Two flights over each other", 2)
            ui.label(
                "The same vehicle with other gains: what has become better or worse, and by how "
                "much."
            ).classes("soft")
            with ui.element("div").classes("two"):
                for what in ("before", "after"):
                    with ui.element("div"):
                        self._drop_one(what)

    def _drop_one(self, what: str) -> None:
        async def dropped(event: events.MultiUploadEventArguments) -> None:
            [path] = await self._saved(event)
            self._pair[what] = path
            name.text = f"{what}: {path.name}"
            if len(self._pair) == 2:
                both = self._pair["before"], self._pair["after"]
                self.start(self.session.work_out("compare", *both))

        self._upload(f"log {what}", dropped)
        name = ui.label().classes("soft")

    @ui.refreshable_method
    def compared(self) -> None:
        show_outcome(self.session, "compare")


def _slider(low: str, high: str, value: float, about: str) -> Any:
    with ui.element("div").classes("slider"):
        ui.label(low)
        slider = ui.slider(min=0.0, max=1.0, step=0.05, value=value)
        slider.props(f'aria-label="{about}: {low} to {high}"')
        ui.label(high)
    return slider
