"""Parameters of the firmwares: stored, in a law, changed, and in files that are loaded."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import Number, write_file
from jaxquad.records import AXES
from jaxquad.records.firmware import firmware_names

from ._filters import Butterworth
from ._firmware import firmware_named, joined_lines, number_text, Parameter
from ._law import AngleLoop, FirmwareLoop, FlownLoop, RateLoop


Law = TypeVar("Law", bound=FirmwareLoop)
Part = TypeVar("Part", bound=eqx.Module)  # of a law


class _Tables(Mapping[str, Mapping[str, Parameter]]):
    def __iter__(self) -> Iterator[str]:
        return iter(firmware_names())

    def __len__(self) -> int:
        return len(firmware_names())

    def __getitem__(self, name: str) -> Mapping[str, Parameter]:
        if name not in firmware_names():
            raise KeyError(name)
        return firmware_named(name).parameters


PARAMETERS: Mapping[str, Mapping[str, Parameter]] = _Tables()
"""The parameters of each firmware by name."""


def find_parameter(firmware: str, name: str) -> Parameter:
    """The parameter of this name. Raises ValueError for one that is not in the table."""
    row = PARAMETERS[firmware].get(name)
    if row is None:
        near = [x for x in PARAMETERS[firmware] if x.lower()[:4] == name.lower()[:4]]
        raise ValueError(
            f"{name} is no parameter that is known of {firmware}"
            + (f": do you mean one of {', '.join(near[:6])}?" if near else ".")
        )
    return row


def store_parameters(firmware: str, values: Mapping[str, Number]) -> dict[str, float]:
    """What the firmware stores of values by their names: whole numbers, or single precision.

    **Raises:**

    - `ValueError`: a name is unknown, or a value is not finite.
    """
    stored = {}
    for name, value in values.items():
        if not np.isfinite(value):
            raise ValueError(f"{name} is {value}: give a finite number.")
        row = find_parameter(firmware, name)
        stored[name] = float(np.rint(value)) if row.integer else float(np.float32(value))
    return stored


def check_ranges(firmware: str, values: Mapping[str, Number]) -> tuple[str, ...]:
    """A sentence for each value beyond the range that the firmware documents."""
    beyond = []
    for name, value in values.items():
        row = find_parameter(firmware, name)
        unit = f" {row.unit}" if row.unit else ""
        if not row.low * (1 - 1e-6) <= value <= row.high * (1 + 1e-6):
            beyond.append(
                f"{name} is {value:g}{unit}, beyond its documented range of {row.low:g} to "
                f"{row.high:g}{unit}."
            )
    return tuple(beyond)


def list_parameters(law: FirmwareLoop, *, axes: Sequence[str] = AXES) -> dict[str, float]:
    """The parameters that a law amounts to, not rounded: gains, filters, those of an angle loop.

    Parameters of all axes, such as a gyro filter, are listed, too. Not listed: Betaflight's
    filters, because their parameters are ranges over the throttle.

    **Arguments:**

    - `axes`: which of roll, pitch and yaw; of a law of one axis, which that is.

    **Raises:**

    - `ValueError`: an axis is unknown, or the law is of one axis and several are named.
    """
    if unknown := set(axes) - set(AXES):
        raise ValueError(f"axes has {', '.join(sorted(unknown))}: give some of {', '.join(AXES)}.")
    listed = {}
    for row, value in _places(law):
        if row.axis >= 0 and AXES[row.axis] not in axes:
            continue
        if value.shape == (1,) and len(axes) != 1:
            raise ValueError("the law is of one axis: say which, as axes=['roll'].")
        wide = np.broadcast_to(value, (3,))
        listed[row.name] = float(wide[max(row.axis, 0)])
    return listed


def with_parameters(law: Law, values: Mapping[str, Number]) -> Law:
    """The law with these parameters, by name; others stay. A law of one axis takes any axis'.

    **Raises:**

    - `ValueError`: a parameter has no place in the law.
    """
    places = dict(_places(law))
    rows = {row.name: row for row in places}
    for name, value in values.items():
        if name not in rows:
            raise ValueError(
                f"{name} has no place in a {type(law).__name__}: give one of {', '.join(rows)}."
            )
        row, flown = rows[name], _value_at(law, rows[name].field)
        assert isinstance(flown, Array)
        if row.axis < 0 or flown.shape == (1,):  # of all axes, or of the only one
            changed = jnp.full_like(flown, value)
        else:
            changed = jnp.broadcast_to(flown, (3,)).at[row.axis].set(value)
        law = _replaced(law, row.field, changed)
    return law


def _rate_loop(law: FirmwareLoop) -> RateLoop:
    inner = law.rate if isinstance(law, AngleLoop) else law
    assert isinstance(inner, RateLoop)
    return inner


def _places(law: FirmwareLoop) -> Iterator[tuple[Parameter, Array]]:
    """The rows that have a place in a law, with what is there."""
    for row in PARAMETERS[_rate_loop(law).firmware].values():
        value = _value_at(law, row.field)
        if isinstance(value, Array):
            yield row, value


def _value_at(law: FirmwareLoop, field: str) -> object:
    """Of the angle loop, the gyro's only low-pass, or the rate loop; None where there is none."""
    part: object = _rate_loop(law)
    if field.startswith("angle."):
        part, field = (law if isinstance(law, AngleLoop) else None), field.removeprefix("angle.")
    elif field == "gyro":
        low_passes = [x for x in _rate_loop(law).gyro.filters if isinstance(x, Butterworth)]
        return low_passes[0].cutoff_hz if len(low_passes) == 1 else None
    for name in field.split("."):
        part = None if part is None else vars(part).get(name)
    return part


def _replaced(law: Part, field: str, value: Array) -> Part:
    if field.startswith("angle."):
        return dataclasses.replace(law, **{field.removeprefix("angle."): value})
    if isinstance(law, AngleLoop):
        return dataclasses.replace(law, rate=_replaced(law.rate, field, value))
    if field == "gyro" and isinstance(law, RateLoop):
        moved = lambda x: dataclasses.replace(x, cutoff_hz=value)
        filters = tuple(moved(x) if isinstance(x, Butterworth) else x for x in law.gyro.filters)
        return dataclasses.replace(law, gyro=dataclasses.replace(law.gyro, filters=filters))
    first, _, rest = field.partition(".")
    part = _replaced(vars(law)[first], rest, value) if rest else value
    return dataclasses.replace(law, **{first: part})


def flown_loop(
    firmware: str, values: Mapping[str, str], version: Sequence[int] = (), *, throttle: float = 0.3,
    tracked_hz: Mapping[int, Sequence[float]] | None = None,
) -> FlownLoop:  # fmt: skip
    """The rate loop of the parameters of a log.

    **Arguments:**

    - `values`, `version`: as `jq.records.read_settings` returns them.
    - `throttle`: 0 to 1, at which Betaflight's dynamic cutoffs and ArduPilot's notches are.
    - `tracked_hz`: as in `ardupilot_loop`.

    **Raises:**

    - `ValueError`: a gain is missing.
    """
    return firmware_named(firmware).flown_loop(
        values, version, throttle=throttle, tracked_hz=tracked_hz or {}
    )


Gains = Float[np.ndarray, " gains"]


def names_by_field(firmware: str, axis: int) -> dict[str, str]:
    """The parameters of one axis, by the field of the law that each sets."""
    return {row.field: row.name for row in PARAMETERS[firmware].values() if row.axis == axis}


def gains_of(law: RateLoop, axis: int) -> Gains:
    return np.array([float(np.broadcast_to(vars(law)[name], (3,))[axis]) for name in law.tuned])


def gains_in(law: RateLoop, axis: int, parameters: Mapping[str, Number]) -> Gains:
    """P, I and D of parameters; those that are not named stay."""
    gains, names = gains_of(law, axis), names_by_field(law.firmware, axis)
    for k, field in enumerate(law.tuned):
        gains[k] = parameters.get(names.get(field, ""), gains[k])
    return gains


def parameters_of(law: RateLoop, axis: int, gains: Gains) -> dict[str, float]:
    """The parameters that stand for these gains; a ceiling of D rises with D."""
    names = names_by_field(law.firmware, axis)
    flown = zip(law.tuned, gains, gains_of(law, axis), strict=True)
    values = {names[field]: float(gain) for field, gain, old in flown if old > 0}
    if (ceiling := law.d_ceiling(axis)) > 1:
        values[names["d_max.ceiling"]] = ceiling * float(gains[2])
    return store_parameters(law.firmware, values)


def ceiling_in(law: RateLoop, axis: int, designs: Sequence[Mapping[str, Number]]) -> float:
    """The most by which D can rise in flight under one of these stored sets of parameters."""
    name, most = names_by_field(law.firmware, axis).get("d_max.ceiling", ""), law.d_ceiling(axis)
    for design in designs:
        base = gains_in(law, axis, design)[2]
        if (top := design.get(name)) and base > 0:
            most = max(most, float(top / base))
    return most


class ParameterChange(NamedTuple):
    """One parameter, from what flew to what is proposed, as the firmware stores both."""

    parameter: Parameter
    old: float
    new: float
    reason: str = ""  # why it changes; several are lines


Changes = Sequence[ParameterChange]


class WordChange(NamedTuple):
    """A parameter of Betaflight that holds a word, such as pid_type."""

    name: str
    old: str
    new: str
    reason: str = ""  # why it changes


def propose_changes(
    firmware: str, old: Mapping[str, Number], new: Mapping[str, Number], *, share: Number = 1.0,
    reasons: Mapping[str, str] | None = None, beyond: Sequence[str] = (),
    at_once: Sequence[str] = (),
) -> tuple[ParameterChange, ...]:  # fmt: skip
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
    firmware: str, changes: Sequence[ParameterChange], *, revert: bool = False,
    version: tuple[int, ...] = (2025, 12), profile: int | None = 0,
    raised: Sequence[str] = ("roll", "pitch", "yaw"), title: str = "",
    words: Sequence[WordChange] = (),
) -> str:  # fmt: skip
    """The text to load: Betaflight's CLI, PX4's .params, ArduPilot's .param, Crazyflie's YAML.

    What flew of each parameter is in a comment where the format allows it.

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
    values = [(x.parameter, x.old if revert else x.new, x.old) for x in changes]
    pairs = [(x.name, x.old if revert else x.new, x.old) for x in words]
    return kind.parameter_file(
        values, title, version=version, profile=profile, raised=raised, words=pairs
    )


def change_table(changes: Sequence[ParameterChange], words: Sequence[WordChange] = ()) -> str:
    """The changes in Markdown: a table of old, new, unit and documented range, then the reasons."""
    rows = ["| parameter | old | new | unit | range |", "|---|---|---|---|---|"]
    for row, old, new, _ in changes:
        numbers = f"{number_text(old, row.integer)} | {number_text(new, row.integer)}"
        rows.append(f"| {row.name} | {numbers} | {row.unit} | {row.range_text} |")
    rows += [f"| {name} | {old} | {new} |  |  |" for name, old, new, _ in words]
    reasons = [f"- {reason}" for reason in list_reasons(changes, words)]
    return joined_lines([*rows, *([""] if reasons else []), *reasons])


def list_reasons(changes: Sequence[ParameterChange], words: Sequence[WordChange] = ()) -> list[str]:
    """Each reason once, behind the names of the parameters that it is of."""
    names: dict[str, list[str]] = {}
    pairs = [(x.parameter.name, x.reason) for x in changes] + [(x.name, x.reason) for x in words]
    for name, reasons in pairs:
        for reason in reasons.splitlines():
            names.setdefault(reason, []).append(name)
    return [f"{', '.join(of)}: {reason}" for reason, of in names.items()]


class ParameterFiles(NamedTuple):
    """Where a staged proposal was written."""

    stages: tuple[Path, ...]  # a file for each share of the way, the smallest first
    revert: Path  # back to what flew, from any of them
    table: Path  # old, new, unit, range and reason, for each stage


def write_parameter_files(
    folder: str | Path, firmware: str, old: Mapping[str, Number], new: Mapping[str, Number], *,
    stem: str = "proposal", shares: Sequence[Number] = (1 / 3, 1.0),
    reasons: Mapping[str, str] | None = None, beyond: Sequence[str] = (),
    at_once: Sequence[str] = (), version: tuple[int, ...] = (2025, 12), profile: int | None = 0,
    log: str = "",
) -> ParameterFiles:  # fmt: skip
    """Write a staged proposal, a file that reverts it, and a table of what changes.

    **Arguments:**

    - `stem`: begins the files' names; the share in percent follows.
    - `shares`: of the way, each in a file of its own.
    - `log`: the name of the log that they come from, for a comment in each.
    - the others: as in `propose_changes` and `parameter_file`.

    **Raises:**

    - `ValueError`: as in `propose_changes` and `parameter_file`, or nothing changes.
    """
    raised = [x for x in AXES if old.get(f"d_max_{x}", 0.0) > old.get(f"d_{x}", 0.0)]
    text = lambda changes, title, revert: parameter_file(
        firmware, changes, revert=revert, version=version, profile=profile, raised=raised,
        title=title,
    )  # fmt: skip
    on_the_way = {name: f"on the way to {value:.5g}" for name, value in new.items()}
    stages = {
        round(100 * share): propose_changes(
            firmware, old, new, share=share, beyond=beyond, at_once=at_once,
            reasons=reasons if share >= 1 else on_the_way,
        )
        for share in sorted(shares)
    }  # fmt: skip
    if not any(stages.values()):
        raise ValueError(
            "Nothing changes: what is proposed is stored as the values that flew. Propose more, or "
            "leave the files out."
        )
    texts = stage_texts(stem, firmware_named(firmware).suffix, stages, text, log=log)
    *written, back, table = (write_file(Path(folder) / name, x) for name, x in texts.items())
    return ParameterFiles(tuple(written), back, table)


def stage_texts(
    stem: str, suffix: str, stages: Mapping[int, Changes],
    text: Callable[[Changes, str, bool], str], words: Sequence[WordChange] = (), log: str = "",
) -> dict[str, str]:  # fmt: skip
    """Files of changes by their percent of the way, what reverts them, and a table, by name."""
    flew = what_flew(log)
    titles = {k: f"{k} % of the way from {flew} to the proposal" for k in stages}
    texts = {f"{stem}_{k:03d}.{suffix}": text(stages[k], titles[k], False) for k in stages}
    texts[f"{stem}_revert.{suffix}"] = text(stages[max(stages)], flew, True)
    table = (f"## {titles[k]}\n\n{change_table(stages[k], words)}" for k in stages)
    return texts | {f"{stem}.md": "\n".join(table)}


def what_flew(log: str) -> str:
    """In words, with the name of the log in one line, whatever the name holds."""
    name = "".join(x if x.isprintable() else "?" for x in log)
    return f"what flew in {name}" if name else "what flew"
