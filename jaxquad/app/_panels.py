"""Parts of the page: lights, changes, steps, files, recipes, and the fields of settings."""

import shlex
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from nicegui import background_tasks, ui

from jaxquad.records import AXES
from jaxquad.workflows import Settings, SettingsError

from ._figures import PLOT, step_figure
from ._session import Session
from ._shown import AxisResult, Files, Step


_LIGHTS = {  # colour, sign and word of a verdict
    "proposed": ("good", "check_circle", "new gains"),
    "kept": ("good", "check_circle", "keep what flew"),
    "cannot tell": ("warn", "help", "cannot tell"),
    "not to be flown": ("bad", "cancel", "no gains"),
    "not this log": ("bad", "cancel", "not this log"),
}
_SIGNS = {"good": "check_circle", "warn": "help", "bad": "cancel"}
_FILES = {  # what the names of files begin with, in their order, and what they are
    "proposal_033": "A third of the way: load this first",
    "proposal_100": "All of it",
    "proposal_revert": "Back to what flew",
    "thrust_curve_revert": "The thrust curve that flew",
    "thrust_curve": "The thrust curve",
    "proposal.md": "Table of what changes",
    "autopilot.html": "All figures and tables as one page",
    "autopilot.json": "All numbers",
    "report.html": "The report as one page",
    "compare.html": "The comparison as one page",
    "compare.json": "All numbers",
    "summary.html": "The table as one page",
    "table.csv": "The table (CSV)",
    "result.json": "All numbers",
}
_OUTCOMES = {
    "identify": "Identification", "batch": "All logs", "compare": "Before and after",
    "model": "Response and model",
}  # fmt: skip
_TEXTS = (".txt", ".param", ".params")
_FIRMWARES = {"betaflight": "Betaflight", "ardupilot": "ArduPilot", "px4": "PX4"}


def heading(text: str, level: int, name: str = "") -> None:
    """A heading that a screen reader knows; `text` may be of a log.

    To one with a `name` the page goes when it is new.
    """
    with ui.element(f"h{level}") as element:
        ui.label(text)
    if name:
        element.props(f'id="{name}" tabindex="-1"')


def show_lights(
    session: Session, axes: Sequence[str], ask: Callable[[str], None], fly: Callable[[str], None]
) -> None:
    """A verdict for each axis with its sentence.

    One button asks for its model, another where the log cannot tell for what to fly.
    """
    with ui.element("div").classes("lights"):
        for axis in axes:
            one = session.axes.get(axis)
            if one is not None:
                level, icon, word = _LIGHTS[one.kind]
                before = session.before_slider(one)
                with _light(level, icon, f"{axis}: {word}", one.sentence, one.in_short):
                    if before is not None and before.in_short:
                        ui.label(f"Before the slider: {before.in_short}").classes("soft")
                    if session.tuned is not None and one.kind != "not this log":
                        _button("Response and model", axis, ask)
                    if one.kind in ("cannot tell", "not this log"):
                        _button("What to fly", axis, fly)
            elif session.stage and session.tuned is None:
                _light("", "hourglass_empty", axis, "is not there yet")


def _button(word: str, axis: str, use: Callable[[str], None]) -> None:
    button = ui.button(word, on_click=lambda: use(axis))
    button.props(f'flat dense no-caps aria-label="{word}, {axis}"')


def _light(level: str, icon: str, word: str, sentence: str, short: str = "") -> ui.element:
    with ui.element("article").classes(f"light {level}") as article:
        with ui.element("div").classes("word"):
            ui.icon(icon).props('aria-hidden="true"')
            heading(word, 3)
        if short:
            ui.label(short).classes("sentence short")
        if sentence:
            ui.label(f"{sentence[:1].upper()}{sentence[1:]}").classes("sentence")
    return article


def show_changes(session: Session) -> None:
    """Old and new of each parameter, and what was new before the slider; each reason once."""
    axes = [(one, session.before_slider(one)) for one in session.axes.values()]
    axes = [(one, before) for one, before in axes if one.changes or before]
    if session.tuned is None or not axes:
        return
    with ui.element("section"):
        heading("What changes", 2)
        with ui.element("div").classes("lights"):
            for one, before in axes:
                with ui.element("div"):
                    _changes(one, before)


def _changes(one: AxisResult, before: AxisResult | None) -> None:
    heading(one.axis, 3)
    last = [] if before is None else ["before the slider"]
    both = {x.name: x for x in (*(before.changes if before else ()), *one.changes)}
    heads = ["old", *last, "new", "times", "parameter"]
    heads += ["unit"] if any(x.unit for x in both.values()) else []
    left = ("parameter", "unit")
    columns = [
        {"name": x, "label": x, "field": x, "align": "left" if x in left else "right"}
        for x in heads
    ]
    rows: list[dict[str, Any]] = []
    for name, x in both.items():
        new, earlier = one.value(x), None if before is None else before.value(x)
        rows.append({
            "old": f"{x.old:.5g}", "new": _number(new), "before the slider": _number(earlier),
            "times": f"{new / x.old:.2f}" if x.old and new is not None else "",
            "parameter": name, "unit": x.unit,
        })  # fmt: skip
    ui.table(columns=columns, rows=rows).props("dense flat hide-pagination").classes("changes")
    for reason in one.reasons:
        ui.label(reason).classes("soft")


def _number(value: float | None) -> str:
    return "none" if value is None else f"{value:.5g}"


def show_steps(session: Session) -> None:
    """The step of each axis, flown and proposed, with its numbers in words."""
    axes = [one for one in session.axes.values() if one.all_steps]
    if session.tuned is None or not axes:
        return
    with ui.element("section"):
        heading("Step of the stick", 2)
        text = "Compare what flew with the proposal: both are computed without feed-forward."
        if any(one.measured for one in axes):
            text += " The measured step has it, and all else that flew, so it is another one."
        ui.label(text).classes("soft")
        with ui.element("div").classes("lights"):
            for one in axes:
                with ui.element("div"):
                    heading(one.axis, 3)
                    PLOT(step_figure(one.all_steps)).classes("plot")
                    for text in _steps_text(one.all_steps):
                        ui.label(text)


def _steps_text(steps: Mapping[str, Step]) -> list[str]:
    texts = []
    for name, band in steps.items():
        middle, worst = (100 * x for x in band.overshoot)
        within = "within its random error" if name == "measured" else "on 95 % of the plants"
        texts.append(
            f"{name}: half way after {1e3 * band.half_way:.0f} ms, overshoot {middle:.0f} %, up to "
            f"{worst:.0f} % {within}"
        )
    return texts


def show_files(session: Session) -> None:
    """What can be taken away of what was tuned, and its page."""
    if session.tuned is None:
        return
    with ui.element("section"):
        heading("Take away", 2)
        ui.label(
            "Load the first file (Betaflight: paste it into the CLI; ArduPilot and PX4: load it as "
            "parameters), hover for half a minute, and feel the motors. Warm or noisy means: go "
            "back."
        ).classes("soft")
        if not session.files:
            ui.label("The files are being written ...").classes("soft")
            return
        _files(session, session.files)
        _inside(session, "autopilot.html")


def show_outcome(session: Session, task: str) -> None:
    """What an identification, a batch or a comparison has brought."""
    outcome = session.outcomes.get(task)
    if outcome is None:
        return
    with ui.element("section"):
        heading(_OUTCOMES[task], 2, task)
        with ui.element("div").classes("lights"):
            for level, word, sentence in outcome.lights:
                _light(level, _SIGNS[level], word, sentence)
        if outcome.text:
            ui.label(outcome.text).classes("code")
        _files(
            session, {name: x for name, x in outcome.files.items() if _place(name) < len(_FILES)}
        )
        _inside(session, outcome.page)


def _place(name: str) -> int:
    return next((k for k, start in enumerate(_FILES) if name.startswith(start)), len(_FILES))


def _files(session: Session, files: Files) -> None:
    for name in sorted(files, key=_place):
        text = next((text for start, text in _FILES.items() if name.startswith(start)), name)
        with ui.element("div").classes("file"):
            link = ui.link(text, f"/results/{session.key}/{name}?save=true")
            link.props["download"] = f"{session.stem}{name}"
            ui.label(name).classes("soft")
            if name.endswith(_TEXTS):
                copy_button(files[name].decode(), name)
        if name.endswith(_TEXTS):
            with ui.expansion("Text to paste").classes("paste"):
                ui.label(files[name].decode()).classes("code")


def copy_button(text: str, what: str) -> None:
    """A button that copies a text, and says so."""

    def copy() -> None:
        ui.clipboard.write(text)
        ui.notify("Copied", type="positive")

    button = ui.button("Copy", on_click=copy).props("outline dense no-caps")
    button.props["aria-label"] = f"copy {what}"


def _inside(session: Session, name: str) -> None:
    frame = ui.element("iframe").classes("report").props('sandbox="allow-scripts"')
    frame.props.update(src=f"/results/{session.key}/{name}", title=name)


class RecipePanel:
    """The recipe of a firmware and an axis, which are chosen."""

    def __init__(self, session: Session):
        self.session, self.recipe, self._followed = session, None, None
        self.firmware: Any = None
        self.axis: Any = None

    def build(self) -> None:
        """Both choices, and below what they give."""
        with ui.element("section"):
            heading("What to fly, so that a log can be tuned", 2, "recipe")
            with ui.element("div").classes("two"):
                self.firmware = ui.select(_FIRMWARES, label="firmware")
                self.axis = ui.select(["all", *AXES], value="all", label="axis")
            for field in (self.firmware, self.axis):
                field.on_value_change(lambda: background_tasks.create(self._ask()))
            self.shown()
        self.follow_log()

    def follow_log(self) -> None:
        """Choose the firmware of a log that is new."""
        view = self.session.view
        if view is not None and view is not self._followed and view.firmware in _FIRMWARES:
            self._followed: Any = view
            self.firmware.value = view.firmware

    def choose(self, firmware: str, axis: str) -> None:
        """Show the recipe of an axis."""
        self.firmware.value, self.axis.value = firmware, axis

    async def _ask(self) -> None:
        if self.firmware.value is not None:
            self.recipe: Any = await self.session.run(
                "recipe", self.firmware.value, self.axis.value
            )
            self.shown.refresh()

    @ui.refreshable_method
    def shown(self) -> None:
        recipe = self.recipe
        if recipe is None:
            return
        files = iter(recipe["files"].items())
        for title, step in (("Before", "before"), ("In flight", "flight"), ("Abort", "abort"),
                            ("After", "after")):  # fmt: skip
            heading(title, 3)
            ui.label(recipe["steps"][step]).classes("sentence")
            if step == "before":
                _paste("Paste", recipe["paste"], *next(files))
        _paste("Paste to go back", recipe["back"], *next(files))


def _paste(title: str, text: str, name: str, file: str) -> None:
    with ui.element("div").classes("file"):
        heading(title, 3)
        copy_button(text, title)
        button = ui.button(f"Download {name}", on_click=lambda: ui.download.content(file, name))
        button.props("outline dense no-caps")
    ui.label(text.strip()).classes("code")


class Form:
    """A field for each setting of a class, in its groups; `read` gives what differs from a default.

    **Arguments:**

    - `settings`: the class.
    - `without`: keys that the page asks for elsewhere.
    - `values`: with which the fields begin.
    """

    def __init__(
        self, settings: type[Settings], without: tuple[str, ...] = (),
        values: Mapping[str, Any] | None = None,
    ):  # fmt: skip
        self._fields: dict[str, Any] = {}
        self._options = {k: o for k, o in settings.options().items() if k not in without}
        values, defaults, group = values or {}, settings.defaults(), None
        for key, option in self._options.items():
            if option.group != group:
                group = option.group
                ui.label(group.capitalize()).classes("group")
            kind, value, name = option.kind, values.get(key), key.replace("_", " ")
            if kind.words == 0:
                switched = defaults[key] if value is None else value
                field = ui.switch(name, value=bool(switched))
            elif kind.choices:
                field = ui.select(
                    list(kind.choices), value=value, label=name, clearable=True
                ).props("options-dense")
            else:
                shown = value if isinstance(value, tuple | list) else [value]
                text = "" if value is None else " ".join(map(kind.write, shown))
                field = ui.input(name, value=text)
            field.classes("setting")
            ui.label(option.help).classes("soft setting")
            self._fields[key] = field

    def read(self) -> dict[str, Any]:
        """What was filled in. Raises SettingsError for what is no number, or too few of them."""
        filled: dict[str, Any] = {}
        for key, field in self._fields.items():
            kind, value = self._options[key].kind, field.value
            if kind.words == 0:
                filled[key] = bool(value)
            elif kind.choices and value:
                filled[key] = value
            elif not kind.choices and (value or "").strip():
                filled[key] = _typed(key, kind, value)
        return filled


def _typed(key: str, kind: Any, text: str) -> Any:
    try:
        words = [kind.read(word) for word in shlex.split(text)]
    except ValueError as error:
        raise SettingsError(f"`{key}` is {text!r}: {error}") from error
    if kind.repeated:
        return words
    if len(words) != kind.words:
        raise SettingsError(f"`{key}` is {text!r}: give {kind.words} of them")
    return tuple(words) if kind.words > 1 else words[0]
