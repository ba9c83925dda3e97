"""What a log holds before anything is computed: its flights, what excites each axis, traces."""

import dataclasses
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from jaxquad._core import announce
from jaxquad.records import (
    AXES,
    Channel,
    channels,
    ChannelSummary,
    Flight,
    flights,
    keep_logs,
    Proposal,
    propose,
    RecordError,
    RecordWarning,
    traces,
)
from jaxquad.records.firmware import firmware_log, load_log

from ._options import SettingsError


class AxisView(NamedTuple):
    """What a log says of an axis: channels by what they are, and what excites it."""

    proposal: Proposal | None  # None where the log lacks a channel
    why: str = ""  # it lacks one
    channels: Mapping[str, str] = {}  # set-point, rate, command, throttle: names

    @property
    def span(self) -> tuple[float | None, float | None]:
        """Start and stop of what is analysed by default, in s of the file's time."""
        return (None, None) if self.proposal is None else self.proposal.setup.longest

    @property
    def excitation(self) -> str:
        """In words."""
        return self.why if self.proposal is None else self.proposal.setup.excitation


@dataclasses.dataclass(frozen=True)
class LogView:
    """What a log holds."""

    path: Path
    firmware: str  # its name; empty for a log of no known autopilot, as the title
    title: str
    flights: tuple[Flight, ...]
    flight: int | None  # the number of the one that is shown; None for a file without flights
    axes: Mapping[str, AxisView]  # empty for a log of no known autopilot
    channels: tuple[ChannelSummary, ...]
    shown: Mapping[str, Channel]  # by name: what `axes` name

    @property
    def first_axis(self) -> str:
        """That of the longest chirp, else the first that can be used; empty where none can."""
        usable = [axis for axis, view in self.axes.items() if view.proposal is not None]
        return max(usable, key=self._chirped, default="")

    @property
    def has_chirps_apart(self) -> bool:
        """Whether several axes have chirps, each at its time."""
        return sum(self._chirped(axis) > 0 for axis in self.axes) > 1

    def _chirped(self, axis: str) -> float:
        """For how long, in s."""
        proposal = self.axes[axis].proposal
        if proposal is None or not proposal.setup.band:
            return 0.0
        return sum(stop - start for start, stop in proposal.segments)

    @property
    def can_be_tuned(self) -> bool:
        """Whether its firmware has gains that `autopilot` tunes: its logs hold the parameters."""
        firmware = firmware_log(self.firmware)
        return bool(self.first_axis) and firmware is not None and firmware.settings


def look(path: str | Path, *, flight: int | None = None) -> LogView:
    """Read what a log holds, without JAX.

    **Arguments:**

    - `path`: a log of an autopilot, or any file that `jq.read` knows.
    - `flight`: the number of the flight to show, of a file with several; by default the one that
      `jq.propose` takes.

    **Returns:** a `LogView`.

    **Raises:**

    - `ReadError`: where the file is missing, damaged or of an unknown format.
    - `SettingsError`: where the file has no such flight.
    """
    path = Path(path)
    announce(f"reading {path.name}")
    with keep_logs(), warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordWarning)
        log = load_log(path)
        firmware, several, listed = firmware_log(log.vehicle), flights(path), channels(path)
        if flight is not None and flight not in [one.number for one in several]:
            raise SettingsError(
                f"`flight` is {flight}, but the file holds flights 1 to {len(several)}"
            )
        axes: dict[str, AxisView] = {}
        if firmware is not None:
            axes = {axis: _view(path, axis, flight) for axis in AXES}
        names = dict.fromkeys(name for view in axes.values() for name in view.channels.values())
        shown = {channel.name: channel for channel in traces(path, list(names))}
    if flight is None and len(several) > 1:
        used = [view.proposal.setup.rate for view in axes.values() if view.proposal]
        flight = next((x.number for x in several if used and used[0].startswith(x.log)), None)
    return LogView(
        path, "" if firmware is None else firmware.name, "" if firmware is None else firmware.title,
        tuple(several), flight, axes, tuple(listed), shown,
    )  # fmt: skip


def _view(path: Path, axis: str, flight: int | None) -> AxisView:
    try:
        proposal = propose(path, axis=axis, flight=flight)
    except RecordError as error:
        return AxisView(None, str(error))
    setup, firmware = proposal.setup, firmware_log(proposal.vehicle)
    assert firmware is not None
    names, k = {"rate": setup.rate}, AXES.index(axis)
    if k < len(firmware.setpoints) and k < len(firmware.rates):
        names["set-point"] = setup.rate.removesuffix(firmware.rates[k]) + firmware.setpoints[k]
    names["command"] = max(setup.command, key=lambda name: abs(setup.command[name]))
    if setup.throttle:
        names["throttle"] = next(iter(setup.throttle))
    return AxisView(proposal, "", names)
