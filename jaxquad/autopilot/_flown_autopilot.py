"""The rate loop of a log: its law, its parameters, and the same with other filters."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxquad._core import Message, Number
from jaxquad.identify import KnownFilter, MeasuredChain
from jaxquad.records import AXES, Proposal, read_settings, Settings as LogSettings

from ._filter_choices import change_filters, flown_loop
from ._firmware import firmware_named, HOVER, OuterLoop
from ._flight_channels import channel_prefix
from ._identified import DesignSettings
from ._law import FlownLoop, RateLoop
from ._rate_gains import gains_of, parameters_of


@dataclasses.dataclass(frozen=True)
class FlownAutopilot:
    """The rate loop of a log: firmware, version, law and what of it is not modelled.

    `loop` is the law with what moves in flight, `law` that at one throttle. `values` are the log's
    own parameters, `throttle` is where Betaflight's dynamic filters and TPA and ArduPilot's notches
    are taken, and `tracked_hz` what other notches of the latter followed. `angle` is the angle loop
    around the rate loop, None where the firmware has none. `filters` are those of the gyro, by the
    parameters, or as measured where the law lacks some of them; `filters_text` says which.
    """

    firmware: str
    version: tuple[int, ...]
    axis: int
    loop: FlownLoop
    law: RateLoop
    parameters: Mapping[str, float]
    unmodelled: tuple[Message, ...]
    values: Mapping[str, str] = dataclasses.field(default_factory=dict)
    throttle: float = 0.3
    tracked_hz: Mapping[int, Sequence[float]] = dataclasses.field(default_factory=dict)
    angle: OuterLoop | None = None
    filters: tuple[KnownFilter, ...] = ()
    filters_text: str = ""

    @property
    def measured(self) -> tuple[KnownFilter, ...] | None:
        """The gyro's filters as measured; None where they are those of the law."""
        return self.filters if any(isinstance(x, MeasuredChain) for x in self.filters) else None

    def with_filters(self, parameters: Mapping[str, Number]) -> RateLoop:
        """The law as it is read from a log with these cutoffs and notches."""
        values = change_filters(self.firmware, self.values, parameters)
        return flown_loop(
            self.firmware, values, self.version, throttle=self.throttle, tracked_hz=self.tracked_hz
        ).law

    def at(self, throttle: float) -> "FlownAutopilot":
        """The same at another throttle, which moves cutoffs, notches and TPA of some firmwares."""
        if not firmware_named(self.firmware).follows_throttle:
            return self
        there = dataclasses.replace(self, throttle=throttle)
        return dataclasses.replace(there, law=there.with_filters({}))

    @property
    def old(self) -> dict[str, float]:
        """P, I and D of the axis by the firmware's names."""
        return parameters_of(self.law, self.axis, gains_of(self.law, self.axis))


def settings_of(path: Path, proposal: Proposal) -> LogSettings:
    """The log's own parameters, of the part that is proposed."""
    prefix = channel_prefix(proposal).rstrip(".")
    return read_settings(path, log=prefix, at=proposal.setup.start)


def read_flown(
    path: Path, proposal: Proposal, settings: DesignSettings,
    tracked_hz: Mapping[int, Sequence[float]],
) -> FlownAutopilot:  # fmt: skip
    """The loop that flew. Raises ValueError where the log does not hold its gains."""
    setup, logged = proposal.setup, settings_of(path, proposal)
    axis, firmware = AXES.index(setup.axis), firmware_named(proposal.vehicle)
    values = firmware.with_hold(logged.values, setup.hold)
    throttle = HOVER if settings.throttle is None else settings.throttle
    loop = firmware.flown_loop(values, logged.version, throttle=throttle, tracked_hz=tracked_hz)
    loop = firmware.levelled(loop) if setup.levelled else loop
    if not np.any(gains_of(loop.law, axis) > 0):
        raise ValueError(
            f"{path}: P, I and D of {setup.axis} are all 0, so there is no rate loop to tune"
        )
    dt = loop.law.interval()
    return FlownAutopilot(
        proposal.vehicle, tuple(logged.version), axis, loop, loop.law, loop.parameters(),
        loop.unmodelled, values, throttle, tracked_hz,
        firmware.angle_loop(logged.values, axis, dt, levelled=setup.levelled),
    )  # fmt: skip
