"""What the page asks for, in the worker's process: workflows, and what is shown of results."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jaxquad.workflows as workflows
from jaxquad._core import announce
from jaxquad.autopilot import (
    ADRCAutopilot,
    AutopilotProposal,
    AxesProposal,
    measured_step,
    proposed_steps,
    write_chirp_log,
)
from jaxquad.plot import StepBand
from jaxquad.records import AXES, Channel, traces
from jaxquad.report import Headline
from jaxquad.workflows import (
    AutopilotSettings,
    BatchSettings,
    Identification,
    IdentifySettings,
    in_options,
    LogView,
)

from ._shown import AxisResult, Change, Files, Light, Outcome, Step, Tuned


Tell = Callable[[str, Any], None]


def look(path: Path, flight: int | None, *, tell: Tell) -> LogView:
    return workflows.look(path, flight=flight)


def read_traces(path: Path, names: Sequence[str], *, tell: Tell) -> Mapping[str, Channel]:
    return {channel.name: channel for channel in traces(path, names)}


# "result": what sliders tune again, and files are of; by axis what was shown of which proposal.
_session: dict[str, Any] = {}


def tune(path: Path, settings: AutopilotSettings, *, tell: Tell) -> Tuned:
    """Each axis is told as soon as it is there."""
    _session.clear()
    result = workflows.autopilot(
        path, settings, listener=lambda axis, one: tell("axis", _shown_axis(axis, one))
    )
    return _kept(result)


def retune(limits: Mapping[str, float], *, tell: Tell) -> Tuned:
    """Other limits on the plants that are drawn; each axis is told as soon as it is there."""
    axes, before = _tuned_axes(), _session["result"]
    if isinstance(before, AxesProposal):
        hear = lambda axis, one: tell("axis", _shown_axis(axis, one))
        return _kept(before.retuned(hear, **limits))
    [one] = axes.values()
    return _kept(one.retuned(**limits))


def _kept(result: AxesProposal | AutopilotProposal | ADRCAutopilot) -> Tuned:
    _session["result"] = result
    if isinstance(result, ADRCAutopilot):
        one = AxisResult(result.axis, result.kind, str(in_options(result.verdict)))
        return Tuned((one,), False)
    axes = _tuned_axes()
    unread = result.unread if isinstance(result, AxesProposal) else {}
    shown = tuple(_shown_axis(axis, one) for axis, one in {**axes, **unread}.items())
    return Tuned(shown, any(one.search is not None for one in axes.values()))


def _shown_axis(axis: str, one: AutopilotProposal | str) -> AxisResult:
    if isinstance(one, str):
        return AxisResult(axis, "not this log", one)
    before, shown = _session.get(axis, (None, None))
    if before is one:
        return shown
    changes = one.changes if one.new else ()
    shown = AxisResult(
        axis, one.kind, str(in_options(one.verdict)), one.in_short,
        tuple(Change(x.parameter.name, x.old, x.new, x.parameter.unit) for x in changes),
        tuple(dict.fromkeys(x.reason for x in changes if x.reason)),
        {name: _step(band) for name, band in proposed_steps(one).items()}, _measured(axis, one),
    )  # fmt: skip
    _session[axis] = one, shown
    return shown


def _step(band: StepBand) -> Step:
    return Step(*band, band.overshoot, band.half_way, band.settled)


def _measured(axis: str, one: AutopilotProposal) -> Step | None:
    """Of the log, which sliders do not change."""
    before, shown = _session.get(f"{axis} measured", (None, None))
    if before is not one.flown.flight:
        measured = measured_step(one.flown.flight)
        shown = None if measured is None else _step(measured.step)
        _session[f"{axis} measured"] = one.flown.flight, shown
    return shown


def model(axis: str, *, tell: Tell) -> Outcome:
    """The response of an axis with its model, as an identification reports them."""
    one = _tuned_axes()[axis]
    plant = one.identification
    assert isinstance(plant, Identification)
    level = "good" if plant.fit.identifiable else "warn"
    files = _written(plant.write)
    light = Light(level, f"{axis}: response and model")
    return Outcome((light,), "", "report.html", files)


def _tuned_axes() -> Mapping[str, AutopilotProposal]:
    result = _session.get("result")
    if isinstance(result, AxesProposal):
        return result.axes
    if isinstance(result, AutopilotProposal):
        return {AXES[result.flown.axis]: result}
    raise ValueError("what was tuned is gone with what was cancelled: tune the log again")


def tuned_files(*, tell: Tell) -> Files:
    """The page and the parameter files of what was tuned last."""
    return _written(_session["result"].write)


def _written(write: Callable[[Path], object]) -> Files:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write(folder)
        paths = [path for path in sorted(folder.rglob("*")) if path.is_file()]
        return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}


def identify(path: Path, settings: IdentifySettings, *, tell: Tell) -> Outcome:
    result = workflows.identify(path, settings)
    level, word = "good", "The record determines the model"
    if not result.fit.identifiable:
        level, word = "warn", "This record does not determine the model"
    text = str(in_options(result.message()))
    return Outcome((Light(level, word),), text, "report.html", _written(result.write))


def compare(before: Path, after: Path, *, tell: Tell) -> Outcome:
    result = workflows.compare(before, after)
    heads = {axis: one.headline for axis, one in result.axes.items()}
    heads |= {axis: Headline("bad", "not compared", why) for axis, why in result.unread.items()}
    lights = (
        Light(level, f"{axis}: {word.lower()}", str(in_options(reason)))
        for axis, (level, word, reason) in heads.items()
    )
    return Outcome(tuple(lights), "", "compare.html", _written(result.write))


def batch(folder: Path, *, tell: Tell) -> Outcome:
    """All logs of a folder, each identified by what it proposes."""
    rows: list[object] = []

    def count(row: Mapping[str, object]) -> None:
        rows.append(row)
        announce(f"{len(rows)} logs are done, the last {row['log']}: {row['status']}")

    files = _written(lambda out: workflows.batch(folder, BatchSettings(), out=out, listener=count))
    return Outcome((Light("good", f"{len(rows)} logs"),), "", "summary.html", files)


def recipe(firmware: str, axis: str, *, tell: Tell) -> Mapping[str, object]:
    """Its content, and by their names the "files" to download: to set, and to go back."""
    answer = workflows.recipe(firmware, axis)
    files = answer.files(f"{firmware}_{axis}.{answer.suffix}")
    return answer.content() | {"files": {path.name: text for path, text in files.items()}}


def demo(folder: Path, *, tell: Tell) -> Path:
    """A simulated Betaflight log, whose plant is known."""
    announce("a chirp flight of a simulated quadrotor")
    return write_chirp_log(folder / "demo.bfl")
