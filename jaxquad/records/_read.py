"""Records of the channels of a file, and of its segments."""

import dataclasses
import functools as ft
import itertools
import re
import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from ._channel import (
    Channel,
    check_keys,
    clock_start,
    JITTER,
    nonuniformity,
    Number,
    repair_values,
    show_times,
    Times,
    TimeUnit,
    Valid,
    window,
    within,
    without_turns,
)
from ._edit import resample
from ._log import GapError, known_unit, located, ReadError, RecordError, warn
from ._record import as_tuple, assemble, check_distinct, Hold, Record
from ._timebase import Timebases
from .formats import load_signals


Mixes = Mapping[str, Mapping[str, Number]]
Selection = str | Sequence[str] | Mixes


def read(
    path: str | Path, *, inputs: Selection, outputs: Selection, references: Selection | None = None,
    sample_rate: Number | None = None, start: Number | None = None, stop: Number | None = None,
    time: str | None = None, time_unit: TimeUnit | None = None, dt: Number | None = None,
    time_factor: Number | None = None, max_gap: Number | None = None,
    units: Mapping[str, str] | None = None, hold: Hold = None, valid: Valid | None = None,
) -> Record:  # fmt: skip
    """Read a record from a log: ArduPilot, PX4, Betaflight, Crazyflie, or a table of arrays.

    The format is recognised by the first bytes of the file, else by its name: DataFlash .bin and
    .log, ULog, blackbox .bbl and .bfl or the tables of blackbox_decode, Crazyflie uSD, ROS 2 bags,
    MAT of versions 5 to 7.3, HDF5, Parquet, .npz, .npy, .csv. `channels` lists what a file holds.

    **Arguments:**

    - `path`: the file; for a ROS 2 bag also its folder.
    - `inputs`, `outputs`, `references`: channel names, or new names with weighted sums of channels
        and of their powers, as `{"roll": {"motor[0]": -1, "motor[1]^2": 1}}`. The columns of a 2-D
        array `x` are `x[0]`, `x[1]`, ...
    - `sample_rate`: of the record, in Hz. By default channels that share one uniform time base
        are kept bit by bit; others are resampled (see `resample`) to the lowest of their own rates,
        rounded to three digits.
    - `start`, `stop`: first and last time in s of the file's own time, which the record keeps.
        Where that is a date, they may count from the log's start, as messages do.
    - `time`: the array with the time stamps, where the format does not define them, or those with
        seconds and nanoseconds, as `"sec+nanosec"`. The time stamps of `x` are `t_x`, else those
        that `time` names, else t, time, time_s, timestamp or such a pair in the same struct, in
        those around it, in the whole file, else those of its topic (`imu_time` for `imu_x`), else
        the first column of its matrix if that rises steadily.
    - `time_unit`: of the time stamps. `None` means what the file says, else s, and then refuses
        steps of 0.25 and more, which may be milliseconds.
    - `dt`: the sampling interval in s of a table without time stamps, whose rows are equally
        spaced. Its time begins at 0.
    - `time_factor`: of the time stamps, where their clock is known to run slow or fast; `start`,
        `stop` and the record are in the corrected time. 85/84 for logs of a Crazyflie's micro-SD
        card whose firmware is older than August 2026.
    - `max_gap`: the longest gap that is interpolated, in s: of time stamps (see `resample`), and of
        values that are not finite, which by default are refused.
    - `units`: channel name of the record -> unit, for figures and tables; by default those of the
        log.
    - `hold`: how long the plant's input keeps each value, in s, as in `Record`: 0 for what was
        measured, the loop's period for a command. A record at a higher sample rate than that of the
        hold shows straight lines where the input had steps: its hold is unknown.
    - `valid`: channel name of the file -> lowest and highest value that can be true. Others count
        as missing, and are interpolated up to `max_gap`, as in `Record`.

    **Returns:** a `Record`. Overflows of the time counter are undone, up to 1 % of time stamps that
    repeat or go back are dropped with their rows, and angles that jump by a turn (360, 2 pi) go on
    instead, each with a `RecordWarning`.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format, or lacks a channel.
    - `RecordError`: where the data are unusable: gaps, NaN, an empty range.

    !!! Example

        ```python
        record = jq.read("log15.npz", inputs="M", outputs="q", references="x0", start=50, stop=76)
        ```
    """
    selections = inputs, outputs, references or ()
    roles = [_mixes(selection) for selection in selections]
    logged = _read_channels(
        path, roles, time, time_unit, dt, time_factor, max_gap=max_gap, hold=hold, valid=valid or {}
    )
    return logged.record(roles, units or {}, sample_rate, (start, stop))


def _mixes(selection: Selection) -> Mixes:
    if isinstance(selection, Mapping):
        return selection
    names = as_tuple(selection)
    check_distinct(names)
    return {name: {name: 1.0} for name in names}


@dataclasses.dataclass(frozen=True)
class _Logged:
    """Channels of a file, repaired, each on its own clock; what sums are of, as `m1` or `m1^2`."""

    path: str | Path
    channels: Sequence[Channel]
    powers: Mapping[str, tuple[str, int]]  # term of a sum -> channel and its power
    repaired: Mapping[str, Times]
    max_gap: Number | None
    hold: Hold

    def record(
        self, roles: Sequence[Mixes], units: Mapping[str, str], sample_rate: Number | None,
        segment: "Segment",
    ) -> Record:  # fmt: skip
        """Weighted sums of the terms in one segment, at one rate."""
        channels, hold = self.channels, self.hold
        stamps, span = channels[0].time, None
        if sample_rate is None and all(np.array_equal(stamps, c.time) for c in channels):
            span = window(stamps, *segment)
        if span is not None and nonuniformity(stamps[span]) <= JITTER:
            stamps = stamps[span]
            table = np.stack([channel.values[span] for channel in channels], axis=1)
        else:
            slowest = min(channel.rate for channel in channels)
            rate = float(f"{slowest:.3g}") if sample_rate is None else sample_rate
            start, stop = segment
            stamps, table = resample(channels, rate, start=start, stop=stop, max_gap=self.max_gap)
            # Input and output pass through one filter: a hold within a sample stays what it is.
            longest = 1.01 * (stamps[1] - stamps[0])
            hold = None if isinstance(hold, int | float) and hold > longest else hold
        names = [channel.name for channel in channels]
        columns, logged = {}, {}
        for term, (name, power) in self.powers.items():
            k = names.index(name)
            columns[term], logged[term] = table[:, k], channels[k].unit
            if power > 1:
                columns[term], logged[term] = table[:, k] ** power, ""
        mixes = {name: mix for role in roles for name, mix in role.items()}
        check_keys("a unit is given for", units, mixes)
        for name, unit in units.items():
            (source, weight), *others = mixes[name].items()
            said, stated = known_unit(unit), known_unit(logged[source])
            if said and stated and said != stated and weight == 1 and not others:
                raise RecordError(
                    f"the unit of {name!r} is given as {unit}, but the log says {logged[source]}: "
                    f"leave it out («units=»), or multiply the channel by the factor between the "
                    f"two."
                )
        agreed = {}
        for name, mix in mixes.items():
            # A single channel's factor may convert its unit.
            converted = len(mix) == 1 and any(abs(weight) != 1 for weight in mix.values())
            shared = {"" if converted else logged[source] for source in mix}
            agreed[name] = shared.pop() if len(shared) == 1 else ""
        return assemble(
            stamps, roles, lambda name: _combine(name, mixes[name], columns),
            (agreed | dict(units)).__getitem__, source=str(self.path), hold=hold,
            repaired=within(self.repaired, stamps[0], stamps[-1]),
        )  # fmt: skip


def _combine(name: str, weights: Mapping[str, Number], columns: Mapping[str, Times]) -> Times:
    """The weighted sum that makes the channel `name`; a single weight of 1 changes no bit."""
    if not weights:
        raise RecordError(f"the sum {name!r} is empty: give it channels and their weights.")
    for source, weight in weights.items():
        if not np.isfinite(weight):
            raise RecordError(
                f"the weight of {source!r} in the sum {name!r} is {weight}: use a finite number."
            )
    return ft.reduce(np.add, (weight * columns[source] for source, weight in weights.items()))


def _power(term: str, channels: Collection[str]) -> tuple[str, int]:
    """The channel and the power in a term of a sum: `m1^2` is `m1` and 2, if it is no channel."""
    channel, sign, power = term.rpartition("^")
    is_power = term not in channels and sign and channel and power in set("23456789")
    return (channel, int(power)) if is_power else (term, 1)


def _read_channels(
    path: str | Path, roles: Sequence[Mixes], time: str | None, time_unit: TimeUnit | None,
    dt: Number | None, time_factor: Number | None, *, max_gap: Number | None, hold: Hold,
    valid: Valid,
) -> _Logged:  # fmt: skip
    terms = dict.fromkeys(term for role in roles for mix in role.values() for term in mix)
    signals = load_signals(path)
    if not terms:
        raise ReadError(f"{path}: no channels are named. Name them («inputs=», «outputs=»).")
    try:
        timebases = Timebases(signals, time, time_unit, dt, time_factor)
        powers = {term: _power(term, {*timebases.names, *signals.titles}) for term in terms}
        names = list(dict.fromkeys(name for name, _ in powers.values()))
        logged = [timebases.channel(name) for name in names]
    except ReadError as error:
        raise located(error, path) from error
    check_keys("«valid=» names", valid, names)
    channels, repaired = [], {}
    for channel in logged:
        name, limits = channel.name, valid.get(channel.name)
        values, times = repair_values(name, channel.time, channel.values, limits, max_gap)
        unit = known_unit(channel.unit) or channel.unit
        values, jumps, period = without_turns(values, unit)
        if jumps:
            turn = "360" if period == 360 else "2 pi"
            count = "once" if jumps == 1 else f"{jumps} times"
            warn(
                f"channel {name!r} jumps by {turn} {count}, as an angle does at the end of "
                f"its range: it is taken as one that goes on."
            )
        channels.append(Channel(name, channel.time, values, channel.unit))
        repaired[name] = times
    return _Logged(path, channels, powers, repaired, max_gap, hold)


Mix = dict[str, dict[str, float]]  # name -> channel, or its power `m1^2`, -> weight

_NAME = r"(?![\d.])(?:\[[^\]]*\]|[^\s+*\[\]^-])+"  # a channel; brackets may hold anything
_NUMBER = r"(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_TERM = re.compile(rf"\s*([+-]?)\s*(?:({_NUMBER})\s*\*\s*)?({_NAME})\s*(\^\s*[2-9](?![\d.]))?\s*")


class MixError(ValueError):
    """A weighted sum that cannot be read, and the `reason` without its text."""

    def __init__(self, text: str, reason: str):
        super().__init__(f"{text!r}: {reason}")
        self.reason = reason


def parse_mix(text: str) -> Mix:
    """Parse the name of a channel, or a weighted sum of channels and of their powers.

    **Arguments:**

    - `text`: `M`, `roll=-m1-m2+0.5*m[4]` or `thrust=0.02*m1+0.1*m1^2`.

    **Returns:** name -> channel -> weight, as `read_segments` takes it.

    **Raises:**

    - `ValueError`: for anything else.
    """
    name, sign, terms = (part.strip() for part in text.partition("="))
    weights: dict[str, float] = {} if sign or not name else {name: 1.0}
    place = 0
    while place < len(terms):
        term = _TERM.match(terms, place)
        if not term or (place and not term[1]):
            raise MixError(
                text, f"cannot read {terms[place:]!r}; write NAME=-a+b+0.5*c, or 0.1*c^2"
            )
        power = f"^{term[4][1:].strip()}" if term[4] else ""
        weight, channel = float(f"{term[1]}{term[2] or 1}"), f"{term[3]}{power}"
        weights[channel] = weights.get(channel, 0.0) + weight
        place = term.end()
    if not name or not weights:
        raise ValueError(f"{text!r} names no channel; write CHANNEL, or NAME=-a+b+0.5*c")
    return {name: weights}


Segment = tuple[Number | None, Number | None]  # start and stop in the file's time, s
_MOST_GAPS = 30  # in a segment
_SHORTEST = 1.0  # s, of a part between two gaps


def read_segments(
    path: Path, segments: Sequence[Segment], *, inputs: Mix, outputs: Mix,
    references: Mix | None = None, sample_rate: Number | None = None, time: str | None = None,
    time_unit: TimeUnit | None = None, dt: Number | None = None, time_factor: Number | None = None,
    units: Mapping[str, str] | None = None, hold: Hold = None, max_gap: Number | None = None,
    valid: Valid | None = None,
) -> list[Record]:  # fmt: skip
    """Read several segments of a file as records with one sample rate.

    **Arguments:**

    - `path`: the file.
    - `segments`: pairs of start and stop in s of the file's own time.
    - `inputs`, `outputs`, `references`: name -> channel or its power (`m1^2`) -> weight, as
        `parse_mix` returns it.
    - `sample_rate`: in Hz; by default that of the slowest segment.
    - `time`, `time_unit`, `dt`, `time_factor`, `units`, `hold`, `max_gap`, `valid`: as in `read`.

    **Returns:** a `Record` for each segment; several where samples are missing for longer than
    `max_gap`, by default 10 samples or 0.05 s: a segment is cut there, and parts shorter than 1 s
    are left out, with a `RecordWarning`. Each warning about the file is given once.

    **Raises:**

    - `RecordError`: for segments that overlap, are empty or leave the file's time, and for more
        than 30 gaps in one of them.
    - `ReadError`: as `read` raises it.
    """
    if len(segments) > 1:
        for begin, end in segments:
            if begin is None or end is None or not begin < end:
                raise RecordError(
                    f"the segment {begin} .. {end} s is empty: give START:STOP with START before "
                    f"STOP."
                )
        ordered = sorted((begin, end) for begin, end in segments if begin is not None)
        for (begin, end), (after, last) in itertools.pairwise(ordered):
            if end is not None and after < end:
                raise RecordError(
                    f"the segments {begin:.6g} .. {end:.6g} s and {after:.6g} .. {last:.6g} s "
                    f"overlap, so samples would count twice. Choose segments that do not overlap."
                )
    roles, units = (inputs, outputs, references or {}), units or {}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        logged = _read_channels(
            path, roles, time, time_unit, dt, time_factor, max_gap=max_gap, hold=hold,
            valid=valid or {},
        )  # fmt: skip
        recorded = lambda segment, rate: logged.record(roles, units, rate, segment)
        cut = [_without_gaps(lambda span: recorded(span, sample_rate), x) for x in segments]
        parts = [part for several in cut for part in several]
        records = [record for _, record in parts]
        slowest = min(record.sample_rate for record in records)
        if max(record.sample_rate for record in records) > (1 + 1e-6) * slowest:
            rate = float(f"{slowest:.3g}")
            records = [recorded(segment, rate) for segment, _ in parts]
    for warning in {str(warning.message): warning for warning in caught}.values():
        warnings.warn(str(warning.message), warning.category, stacklevel=2)
    return records


def _without_gaps(
    recorded: Callable[[Segment], Record], segment: Segment
) -> list[tuple[Segment, Record]]:
    """The parts of a segment between gaps that are too long to be interpolated."""
    try:
        return [(segment, recorded(segment))]
    except GapError as error:
        gaps = error.gaps
        begins, ends = (segment[0], *(b for _, b in gaps)), (*(a for a, _ in gaps), segment[1])
        spans = [
            (a, b)
            for a, b in zip(begins, ends, strict=True)
            if a is None or b is None or b - a >= _SHORTEST
        ]
        if len(gaps) > _MOST_GAPS or not spans:
            raise
        parts: list[tuple[Segment, Record]] = []
        for span in spans:
            try:
                several = _without_gaps(recorded, span)
            except RecordError:  # too few samples between two gaps
                continue
            parts += [part for part in several if part[1].duration >= _SHORTEST]
        if not parts:
            raise
    records = [record for _, record in parts]
    origin = min(clock_start(record.time) for record in records)
    *others, last = [(float(record.time[0]), float(record.time[-1])) for record in records]
    texts = [f"{a - origin:.6g} .. {b - origin:.6g}" for a, b in others]
    (left, right) = max(gaps, key=lambda gap: gap[1] - gap[0])
    warn(
        f"samples are missing in {'one place' if len(gaps) == 1 else f'{len(gaps)} places'}, for "
        f"up to {1e3 * (right - left):.4g} ms at t = {show_times(left, start=origin)}: the record "
        f"is cut there into {len(parts)} segments, t = "
        f"{', '.join([*texts, show_times(*last, start=origin)])}. "
        f"A gap up to a length in s is bridged instead where that is allowed («max_gap=»)."
    )
    return parts


_AXES = [
    words.split()
    for words in (
        "roll pitch yaw", "aileron elevator rudder throttle", "ail ele rud thr",
        "lateral longitudinal pedal collective", "lat lon ped col", "x y z", "l m n", "r p y",
        "a e r t", "da de dr dt", "mx my mz",
    )
]  # fmt: skip
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+")
_PAIRS = ((1, 1, -1, -1), (1, -1, 1, -1), (1, -1, -1, 1))  # of the motors that turn an axis


def other_axes(command: Mix, names: Iterable[str]) -> list[Mix]:
    """Commands of other axes, by their names: `pitch_cmd` beside `roll_cmd`, `u[1]` beside `u[0]`.

    **Arguments:**

    - `command`: that of one axis, as `parse_mix` returns it; of four motors, others are the two
        that turn them in other pairs.
    - `names`: of all channels.
    """
    names, mixes = set(names), dict[tuple[str, ...], Mix]()
    [(name, weights)] = command.items()
    siblings = [_siblings(channel, names) for channel in weights]
    for key in dict.fromkeys(key for one in siblings for key in one):
        channels = tuple(one[key] for one in siblings if key in one)
        if len(set(channels)) == len(weights):
            title = _siblings(name, None).get(key, f"other{len(mixes) + 1}")
            title = channels[0] if list(weights.values()) == [1.0] else title
            mixes[channels] = {title: dict(zip(channels, weights.values(), strict=True))}
    signs = tuple(np.sign(list(weights.values())))
    if not mixes and len(weights) == 4 and len(set(map(abs, weights.values()))) == 1:
        others = [pair for pair in _PAIRS if signs not in (pair, tuple(-x for x in pair))]
        for k, pair in enumerate(others if sum(signs) == 0 else (), 1):
            mixed = zip(weights, pair, strict=True)
            mixes[f"other{k}",] = {f"other{k}": {channel: float(x) for channel, x in mixed}}
    return list(mixes.values())


def _siblings(name: str, names: set[str] | None) -> dict[tuple[int, str], str]:
    """What a channel is called with another axis' word, or another number at its end, by that."""
    words, renamed = list(_WORD.finditer(name)), dict[tuple[int, str], str]()
    numbers = [word for word in words if word[0].isdigit()][-1:]
    for word in words:
        groups = [(k, axes) for k, axes in enumerate(_AXES) if word[0].lower() in axes]
        groups += [(-1, "0123456789")] if word in numbers else []
        for k, axes in groups:
            for axis in axes:
                case = str.upper if word[0].isupper() else str.title if word[0].istitle() else str
                other = f"{name[: word.start()]}{case(axis)}{name[word.end() :]}"
                if other != name and (names is None or other in names):
                    renamed.setdefault((k, axis), other)
    return renamed
