import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Literal, TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ._channel import (
    as_float64,
    Channel,
    check_keys,
    clock_start,
    Number,
    repair_values,
    show_times,
    Times,
    TimeUnit,
    uniform_stamps,
    Valid,
)
from ._log import mend_holes, RecordError, unknown_name, warn


if TYPE_CHECKING:
    import pandas


Names = str | Sequence[str] | None
Hold = Number | Literal["dt"] | None
_MOST_REPAIRED = 0.01  # of a channel, without a warning
_CHANGES = 50  # mean times between changes of an input: no filter smears a hold so far
_ATTRIBUTES = "jaxquad"  # entry of `DataFrame.attrs` with what columns cannot say
_SMALLEST = 1e-20  # of a channel's size: high powers of it are still numbers


@dataclasses.dataclass(frozen=True, eq=False)
class Record:
    """Uniformly sampled inputs, outputs and references of one run.

    **Arguments:**

    - `time`: time stamps in s, uniform within 2 % of a sample; at least 16. Dates (datetime64)
        become s since the first, durations (timedelta64) s.
    - `inputs`, `outputs`: shape `(samples, channels)`, or `(samples,)` for a single channel. What
        is masked counts as NaN.
    - `references`: likewise; external signals that no feedback changes, such as an injected sweep.
        A record may have none.
    - `input_names`, `output_names`, `reference_names`: by default `u`, `y`, `r`, with numbers from
        1 where there are several.
    - `input_units`, `output_units`, `reference_units`: empty where unknown.
    - `source`: where the data come from, such as a path.
    - `hold`: how long the plant's input keeps each value, in s. 0 for a continuous quantity that
        was measured, such as a rotor speed or a surface's deflection; the loop's period for a
        command, which is often the sample interval, `"dt"`. `None` where nobody said. With it a fit
        tells the hold from the plant's own delay.
    - `time_unit`: of the time stamps: `"s"`, `"ms"`, `"us"` or `"ns"`. `None` means s, and refuses
        steps of 0.25 and more, which may be milliseconds.
    - `valid`: channel name -> lowest and highest value that can be true. Others count as missing.
    - `max_gap`: the longest gap in s, between good neighbours, that is interpolated where values
        are missing. By default nothing is, except in channels with a `valid` range: there 10
        samples, or 0.05 s if that is longer.
    - `repaired`: channel name -> times in s at which values were interpolated before.

    **Raises:**

    - `RecordError`: for arrays of unequal length, NaN that are not repaired, structured arrays,
        time stamps that are not uniform or may not be in s, names that occur twice, and a `hold`
        below 0. A channel that never changes, or of which more than 1 % is repaired, gives a
        `RecordWarning`.
    """

    time: Float[np.ndarray, " samples"]  # s
    inputs: Float[np.ndarray, "samples inputs"]
    outputs: Float[np.ndarray, "samples outputs"]
    references: Float[np.ndarray, "samples references"]
    input_names: tuple[str, ...]
    output_names: tuple[str, ...]
    reference_names: tuple[str, ...]
    input_units: tuple[str, ...]
    output_units: tuple[str, ...]
    reference_units: tuple[str, ...]
    source: str
    hold: float | None  # s; of the inputs
    repaired: dict[str, Float[np.ndarray, " repaired"]]  # s; when values were interpolated

    def __init__(
        self, time: ArrayLike, inputs: ArrayLike, outputs: ArrayLike,
        references: ArrayLike | None = None, *, input_names: Names = None,
        output_names: Names = None, reference_names: Names = None, input_units: Names = None,
        output_units: Names = None, reference_units: Names = None, source: str = "",
        hold: Hold = None, time_unit: TimeUnit | None = None, valid: Valid | None = None,
        max_gap: Number | None = None, repaired: Mapping[str, ArrayLike] | None = None,
    ):  # fmt: skip
        stamps = uniform_stamps(time, time_unit)
        start, rows, none = clock_start(stamps), stamps.size, np.empty((stamps.size, 0))
        roles = (
            ("inputs", "u", inputs, input_names, input_units),
            ("outputs", "y", outputs, output_names, output_units),
            ("references", "r", none if references is None else references, reference_names,
             reference_units),
        )  # fmt: skip
        fields = {"time": stamps, "source": source}
        for role, letter, values, names, units in roles:
            array = as_float64(role, values)
            array = array[:, None] if array.ndim == 1 else array
            if array.ndim != 2:
                raise RecordError(
                    f"{role} has shape {array.shape}: it must be (samples, channels)."
                )
            if array.shape[0] != rows:
                turned = array.shape[1] == rows
                hint = "Transpose it." if turned else "Cut or resample one of the two."
                raise RecordError(
                    f"{role} has {array.shape[0]} rows for {rows} time stamps; the shape must be "
                    f"(samples, channels). {hint}"
                )
            count = array.shape[1]
            if count == 0 and role != "references":
                raise RecordError(
                    f"{role} has no channel: a record needs at least one input and output."
                )
            numbered = tuple(f"{letter}{i + 1}" for i in range(count))
            default = (letter,) if count == 1 else numbered
            names = default if names is None else as_tuple(names)
            if len(names) != count:
                raise RecordError(
                    f"{len(names)} names {names} for {count} channels: give one name for each "
                    f"channel."
                )
            units = ("",) * count if units is None else as_tuple(units)
            if len(units) != count:
                raise RecordError(
                    f"{len(units)} units {units} for the channels {names}: give one unit for each."
                )
            one = role.removesuffix("s")
            fields |= {role: array, f"{one}_names": names, f"{one}_units": units}
        vars(self).update(fields)
        if hold == "dt":
            hold = self.dt
        elif hold is not None and (isinstance(hold, str) or not 0 <= float(hold) < np.inf):
            raise RecordError(
                f"hold is {hold!r}: give the time in s for which the input keeps each value, 'dt' "
                f"for the sample interval, 0 for a continuous quantity that was measured, or None "
                f"where it is unknown."
            )
        check_distinct(self.names)
        earlier = {name: np.asarray(times, np.float64) for name, times in (repaired or {}).items()}
        vars(self).update(hold=None if hold is None else float(hold), repaired=earlier)
        check_keys("«valid=» names", valid or {}, self.names)
        channels = dict(zip(self.names, _all_channels(self), strict=True))
        for name, values in channels.items():
            limits = (valid or {}).get(name)
            values[:], times = repair_values(name, self.time, values, limits, max_gap)
            if times.size:
                earlier[name] = times
        for name, times in earlier.items():
            if times.size > _MOST_REPAIRED * rows:
                warn(
                    f"channel {name!r}: {times.size} of {rows} samples are interpolated, the first "
                    f"at t = {show_times(times.min(), start=start)}. Check «valid=» and the "
                    "sensor."
                )
        for name, values in channels.items():
            bad = np.flatnonzero(~np.isfinite(values))
            if bad.size == values.size:
                raise RecordError(
                    f"channel {name!r} holds no usable number: all {values.size} samples are "
                    f"{values[0]}, or out of the range that it was given («valid=»). Check that it "
                    "was logged, or choose another channel."
                )
            if bad.size:
                good = np.isfinite(values)
                gap = np.max(np.diff(self.time[good])) if good[0] and good[-1] else None
                longest = "" if gap is None else f", the longest gap {gap:.4g} s"
                raise RecordError(
                    f"channel {name!r} holds {np.isnan(values).sum()} NaN and "
                    f"{np.isinf(values).sum()} inf, the first at t = "
                    f"{show_times(float(self.time[bad[0]]), start=start)}"
                    f"{longest}. {mend_holes('them')}"
                )
            largest = float(np.max(np.abs(values)))
            if largest and not _SMALLEST <= largest <= 1 / _SMALLEST:
                raise RecordError(
                    f"channel {name!r} reaches {largest:.3g}: powers of it leave the range of "
                    f"floating point numbers. Give it in another unit, between {_SMALLEST:g} and "
                    f"{1 / _SMALLEST:g}."
                )
            if np.ptp(values) == 0:
                warn(
                    f"channel {name!r} is constant at {values[0]:.6g}: nothing can be identified "
                    f"from it. Check that it was excited and logged."
                )
        if self.hold is not None and self.hold > _CHANGES * self.dt:
            # A hold during which an input changes all the time.
            share = np.mean(np.diff(self.inputs, axis=0) != 0, axis=0)  # of the samples
            k = int(np.argmax(share))
            if share[k] * self.hold > _CHANGES * self.dt:
                raise RecordError(
                    f"hold is {self.hold:.4g} s, but the input {self.input_names[k]} changes every "
                    f"{self.dt / share[k]:.3g} s: give s, so 0.004 for 4 ms, or 'dt' for the "
                    f"sample interval."
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all channels: inputs, outputs, references."""
        return self.input_names + self.output_names + self.reference_names

    @property
    def samples(self) -> int:
        return self.time.size

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, in s."""
        return float(self.time[-1] - self.time[0])

    @property
    def dt(self) -> float:
        """Sample interval in s."""
        return self.duration / (self.samples - 1)

    @property
    def sample_rate(self) -> float:
        """Samples per second, in Hz."""
        return (self.samples - 1) / self.duration

    def channel(self, name: str) -> Float[np.ndarray, " samples"]:
        """The values of one channel, whatever its role."""
        return _all_channels(self)[self._position(name)]

    def unit(self, name: str) -> str:
        """The unit of one channel, empty where unknown."""
        units = self.input_units + self.output_units + self.reference_units
        return units[self._position(name)]

    def _position(self, name: str) -> int:
        if name not in self.names:
            raise RecordError(unknown_name(name, self.names))
        return self.names.index(name)

    @classmethod
    def from_dataframe(
        cls, frame: "pandas.DataFrame", *, inputs: Names = None, outputs: Names = None,
        references: Names = None, time: str | None = None, time_unit: TimeUnit | None = None,
        sample_rate: Number | None = None, max_gap: Number | None = None,
        units: Mapping[str, str] | None = None, hold: Hold = None, source: str = "",
    ) -> "Record":  # fmt: skip
        """A record of columns of a table of pandas (extra `interop`).

        **Arguments:**

        - `frame`: its time stamps are the column `time`, or t, time, time_s or timestamp, or else
            the index. Dates become s since the first.
        - `inputs`, `outputs`, `references`: names of columns. A table of `to_dataframe` knows them.
        - `time_unit`, `max_gap`, `hold`, `source`: as in `Record`.
        - `sample_rate`: of the record, in Hz, where the stamps are not uniform; see
            `jq.records.resample`.
        - `units`: name of a column -> unit.

        **Raises:**

        - `RecordError`: as `Record`, and for columns that are missing or hold no numbers.
        """
        from ._edit import resample
        from ._interop import frame_stamps, frame_values

        stored = frame.attrs.get(_ATTRIBUTES, {})
        roles = {"inputs": inputs, "outputs": outputs, "references": references}
        if all(role is None for role in roles.values()):
            if not roles.keys() <= stored.keys():
                raise RecordError(
                    "the table does not say which columns are inputs and outputs: name them "
                    "(«inputs=», «outputs=»). Its columns are "
                    f"{', '.join(map(str, frame.columns))}."
                )
            roles = stored
        names = [as_tuple(roles[role] or ()) for role in ("inputs", "outputs", "references")]
        flat = [name for role in names for name in role]
        check_distinct(flat)
        values = {name: frame_values(frame, name) for name in flat}
        stamps = frame_stamps(frame, time, time_unit)
        if sample_rate is not None:
            channels = [
                Channel(name, stamps, repair_values(name, stamps, column, None, max_gap)[0])
                for name, column in values.items()
            ]
            stamps, table = resample(channels, sample_rate, max_gap=max_gap)
            values = dict(zip(values, table.T, strict=True))
        if not names[0] or not names[1]:
            raise RecordError(
                "a record needs at least one input and one output («inputs=», «outputs=»)."
            )
        check_keys("a unit is given for", units or {}, flat)
        units = {**stored.get("units", {}), **(units or {})}
        return assemble(
            stamps, names, values.__getitem__, lambda name: units.get(name, ""),
            hold=stored.get("hold") if hold is None else hold,
            source=source or stored.get("source", ""), max_gap=max_gap,
        )  # fmt: skip

    def to_dataframe(self) -> "pandas.DataFrame":
        """A table of pandas (extra `interop`): a column per channel over the time in s.

        What columns cannot say (roles, units, hold) is in `DataFrame.attrs`, from which
        `from_dataframe` takes it.
        """
        import pandas

        table = np.concatenate([self.inputs, self.outputs, self.references], axis=1)
        index = pandas.Index(self.time, name="time")
        frame = pandas.DataFrame(table, index=index, columns=pandas.Index(self.names))
        frame.attrs[_ATTRIBUTES] = {
            "inputs": self.input_names,
            "outputs": self.output_names,
            "references": self.reference_names,
            "units": {name: self.unit(name) for name in self.names},
            "hold": self.hold,
            "source": self.source,
        }
        return frame

    @classmethod
    def from_iddata(
        cls, path: str | Path, *, variable: str | None = None, references: Names = None
    ) -> "Record":
        """A record of a MAT file with the fields of an `iddata` of MATLAB's toolbox.

        The object itself cannot be read outside of MATLAB. A struct of its properties can, as
        MATLAB makes it by `s = get(z); save('z.mat', 's', '-v7')`: y, u, Ts, and where they are
        there Tstart, SamplingInstants, TimeUnit, InputName, OutputName, InputUnit, OutputUnit and
        InterSample (zoh is a hold of Ts, bl one of 0).

        **Arguments:**

        - `path`: the file, of version 5 to 7.
        - `variable`: the struct, where there are several.
        - `references`: names of inputs that are external references.

        **Raises:**

        - `ReadError`: the file is damaged, or has no such struct.
        - `RecordError`: as `Record`.
        """
        from ._interop import from_iddata

        return from_iddata(path, variable, references)

    def to_iddata(self, path: str | Path) -> Path:
        """A MAT file from which MATLAB makes an `iddata`; references become further inputs.

        It holds the struct `z`: `load z.mat; z = iddata(z.y, z.u, z.Ts, 'InputName', z.InputName)`.

        **Arguments:**

        - `path`: the file to write.

        **Returns:** the path.
        """
        from ._interop import to_iddata

        return to_iddata(self, path)

    def __str__(self) -> str:
        roles = (
            ("inputs", self.input_names),
            ("outputs", self.output_names),
            ("references", self.reference_names),
        )
        lines = [
            f"Record {self.source}".rstrip(),
            f"  {self.samples} samples, {self.duration:.6g} s at {self.sample_rate:.6g} Hz "
            f"(t = {show_times(self.time[0], self.time[-1], start=clock_start(self.time))})",
        ]
        for role, members in roles:
            texts = [f"{name} [{self.unit(name)}]" if self.unit(name) else name for name in members]
            lines.append(f"  {role}: {', '.join(texts) or 'none'}")
        if self.hold is not None:
            hold = f"held for {self.hold:.6g} s" if self.hold else "measured, not held"
            lines.append(f"  inputs {hold}")
        counts = [f"{name} {times.size} samples" for name, times in self.repaired.items()]
        if counts:
            lines.append(f"  repaired by interpolation: {', '.join(counts)}")
        return "\n".join(lines)


def assemble(
    time: Times, roles: Sequence[Iterable[str]], values: Callable[[str], Times],
    unit: Callable[[str], str], *, source: str, hold: Hold,
    repaired: Mapping[str, ArrayLike] | None = None, max_gap: Number | None = None,
) -> Record:  # fmt: skip
    """A record of the named inputs, outputs and references, by what gives a channel's values."""
    names = [tuple(role) for role in roles]
    columns = [
        np.stack([values(name) for name in role], axis=1) if role else np.empty((time.size, 0))
        for role in names
    ]
    units = [[unit(name) for name in role] for role in names]
    return Record(
        time, *columns, input_names=names[0], output_names=names[1], reference_names=names[2],
        input_units=units[0], output_units=units[1], reference_units=units[2], source=source,
        hold=hold, time_unit="s", max_gap=max_gap, repaired=repaired,
    )  # fmt: skip


def _all_channels(record: Record) -> list[Float[np.ndarray, " samples"]]:
    return [*record.inputs.T, *record.outputs.T, *record.references.T]


def as_tuple(names: str | Iterable[str]) -> tuple[str, ...]:
    """A single string is one name, not a sequence of letters."""
    return (names,) if isinstance(names, str) else tuple(names)


def check_distinct(names: Sequence[str]) -> None:
    """Raise RecordError for a name that stands for two channels."""
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise RecordError(
            f"the channel name {twice[0]!r} occurs {names.count(twice[0])} times among "
            f"{', '.join(names)}: input, output and reference are different signals. Choose "
            "another channel; if two signals have one name, give each a different name."
        )
