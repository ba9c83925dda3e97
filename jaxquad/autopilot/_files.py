"""Parameter files that a ground station or a command line loads into a flight controller."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from jaxquad._core import Number, write_file
from jaxquad.records import AXES

from ._firmware import firmware_named, joined_lines, number_text, Parameter
from ._parameters import check_ranges, PARAMETERS, store_parameters


class ParameterChange(NamedTuple):
    """One parameter, from what flew to what is proposed, as the firmware stores both."""

    parameter: Parameter
    old: float
    new: float
    reason: str = ""  # why it changes


class WordChange(NamedTuple):
    """A parameter of Betaflight that holds a word, such as pid_type."""

    name: str
    old: str
    new: str
    reason: str = ""  # why it changes


def propose_changes(
    firmware: str,
    old: Mapping[str, Number],
    new: Mapping[str, Number],
    *,
    share: Number = 1.0,
    reasons: Mapping[str, str] | None = None,
    beyond: Sequence[str] = (),
    at_once: Sequence[str] = (),
) -> tuple[ParameterChange, ...]:
    """What changes between two sets of parameters once both are stored by the firmware.

    The changes are in the order of the firmware's table, without those that rounding undoes.

    **Arguments:**

    - `old`: what flew, by name; `new`: what is wanted. Names that are in `old` alone stay.
    - `share`: how much of the way to go, above 0 and at most 1: 1/3 for a first flight.
    - `reasons`: by name.
    - `beyond`: names that may lie beyond their documented range.
    - `at_once`: names that go all of the way at any share, such as a notch that is switched on.

    **Raises:**

    - `ValueError`: a name is unknown or not in `old`, or a value is beyond its documented range.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share is {share}: give the part of the way, above 0 and at most 1.")
    unknown = [name for name in new if name not in old]
    if unknown:
        raise ValueError(
            f"{', '.join(unknown)} would change, but what flew is not known: give it in `old`, so "
            "that the change can be reverted."
        )
    part = lambda name: 1.0 if name in at_once else share
    wanted = {name: old[name] + part(name) * (value - old[name]) for name, value in new.items()}
    stored = store_parameters(firmware, wanted)
    outside = {name: value for name, value in stored.items() if name not in beyond}
    if said := check_ranges(firmware, outside):
        raise ValueError(f"{' '.join(said)} Allow it with beyond=, or change it.")
    before, why = store_parameters(firmware, {name: old[name] for name in new}), reasons or {}
    return tuple(
        ParameterChange(row, before[name], stored[name], why.get(name, ""))
        for name, row in PARAMETERS[firmware].items()
        if stored.get(name) != before.get(name)
    )


def parameter_file(
    firmware: str,
    changes: Sequence[ParameterChange],
    *,
    revert: bool = False,
    version: tuple[int, ...] = (2025, 12),
    profile: int | None = 0,
    raised: Sequence[str] = ("roll", "pitch", "yaw"),
    title: str = "",
    words: Sequence[WordChange] = (),
) -> str:
    """The text to load: Betaflight's CLI, PX4's .params, ArduPilot's .param, Crazyflie's YAML.

    The other value of each parameter is in a comment where the format allows it.

    **Arguments:**

    - `revert`: whether to write the old values, to go back to what flew.
    - `version`: of Betaflight, whose names differ: until 4.5 d is d_min, and the maximum d.
    - `profile`: of Betaflight, the PID profile that is changed; None is the one in use.
    - `raised`: of Betaflight until 4.5, the axes on which d_min is in use; on others d is d.
    - `title`: comment; its lines begin the file.
    - `words`: of Betaflight, what changes beside numbers; set last.

    **Raises:**

    - `ValueError`: a parameter does not exist in this version of Betaflight, or another firmware
        is to change words.
    """
    kind = firmware_named(firmware)
    if words and not kind.words:
        raise ValueError(f"{words[0].name} is a word, and {firmware} stores numbers alone.")
    values = [(x.parameter, *((x.old, x.new) if revert else (x.new, x.old))) for x in changes]
    pairs = [(x.name, *((x.old, x.new) if revert else (x.new, x.old))) for x in words]
    return kind.parameter_file(
        values, title, version=version, profile=profile, raised=raised, words=pairs
    )


def change_table(changes: Sequence[ParameterChange], words: Sequence[WordChange] = ()) -> str:
    """The changes as a table in Markdown: old, new, unit, documented range and reason."""
    rows = ["| parameter | old | new | unit | range | reason |", "|---|---|---|---|---|---|"]
    for row, old, new, reason in changes:
        numbers = f"{number_text(old, row.integer)} | {number_text(new, row.integer)}"
        rows.append(f"| {row.name} | {numbers} | {row.unit} | {row.range_text} | {reason} |")
    rows += [f"| {name} | {old} | {new} |  |  | {reason} |" for name, old, new, reason in words]
    return joined_lines(rows)


class ParameterFiles(NamedTuple):
    """Where a staged proposal was written."""

    stages: tuple[Path, ...]  # a file for each share of the way, the smallest first
    revert: Path  # back to what flew, from any of them
    table: Path  # old, new, unit, range and reason, for each stage


def write_parameter_files(
    folder: str | Path,
    firmware: str,
    old: Mapping[str, Number],
    new: Mapping[str, Number],
    *,
    stem: str = "proposal",
    shares: Sequence[Number] = (1 / 3, 1.0),
    reasons: Mapping[str, str] | None = None,
    beyond: Sequence[str] = (),
    at_once: Sequence[str] = (),
    version: tuple[int, ...] = (2025, 12),
    profile: int | None = 0,
) -> ParameterFiles:
    """Write a staged proposal, a file that reverts it, and a table of what changes.

    **Arguments:**

    - `stem`: begins the files' names; the share in percent follows.
    - `shares`: of the way, each in a file of its own.
    - the others: as in `propose_changes` and `parameter_file`.

    **Raises:**

    - `ValueError`: as in `propose_changes` and `parameter_file`, or nothing changes.
    """
    folder, suffix = Path(folder), firmware_named(firmware).suffix
    raised = [x for x in AXES if old.get(f"d_max_{x}", 0.0) > old.get(f"d_{x}", 0.0)]
    text = lambda changes, title, back=False: parameter_file(
        firmware, changes, revert=back, version=version, profile=profile, raised=raised, title=title
    )
    stages, table, changes = [], [], ()
    for share in sorted(shares):
        changes = propose_changes(
            firmware, old, new, share=share, beyond=beyond, at_once=at_once,
            reasons=reasons if share >= 1 else {x: f"on the way to {new[x]:.5g}" for x in new},
        )  # fmt: skip
        percent = round(100 * share)
        title = f"{percent} % of the way from what flew to the proposal"
        stages.append((folder / f"{stem}_{percent:03d}.{suffix}", text(changes, title)))
        table.append(f"## {title}\n\n{change_table(changes)}")
    if not changes:
        raise ValueError(
            "Nothing changes: what is proposed is stored as the values that flew. Propose more, or "
            "leave the files out."
        )
    back = write_file(folder / f"{stem}_revert.{suffix}", text(changes, "what flew", True))
    written = tuple(write_file(path, content) for path, content in stages)
    return ParameterFiles(written, back, write_file(folder / f"{stem}.md", "\n".join(table)))
