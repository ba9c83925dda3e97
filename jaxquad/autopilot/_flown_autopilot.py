"""The rate loop of a log: its law, its parameters, and the same with other filters."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxquad._core import Message, Number
from jaxquad.identify import KnownFilter, MeasuredChain
from jaxquad.records import AXES, Proposal, read_settings, Settings as LogSettings

from ._angle_loop import angle_loop_of, AngleLoop
from ._choices import change_filters, flown_loop
from ._flight_channels import HOVER
from ._flown import FlownLoop
from ._identified import DesignSettings
from ._parameters import Firmware
from ._rate_gains import gains_of, parameters_of, RateLaw
from .betaflight._law import BetaflightPID


@dataclasses.dataclass(frozen=True)
class FlownAutopilot:
    """The rate loop of a log: firmware, version, law and what of it is not modelled.

    `loop` is the law with what moves in flight, `law` that at one throttle. `values` are the log's
    own parameters, `throttle` is where Betaflight's dynamic filters and TPA and ArduPilot's notches
    are taken, and `tracked_hz` what other notches of the latter followed. `angle` is the angle loop
    around the rate loop, None where the firmware has none. `filters` are those of the gyro, by the
    parameters, or as measured where the law lacks some of them; `filters_text` says which.
    """

    firmware: Firmware
    version: tuple[int, ...]
    axis: int
    loop: FlownLoop
    law: RateLaw
    parameters: Mapping[str, float]
    unmodelled: tuple[Message, ...]
    values: Mapping[str, str] = dataclasses.field(default_factory=dict)
    throttle: float = 0.3
    tracked_hz: Mapping[int, Sequence[float]] = dataclasses.field(default_factory=dict)
    angle: AngleLoop | None = None
    filters: tuple[KnownFilter, ...] = ()
    filters_text: str = ""

    @property
    def measured(self) -> tuple[KnownFilter, ...] | None:
        """The gyro's filters as measured; None where they are those of the law."""
        return self.filters if any(isinstance(x, MeasuredChain) for x in self.filters) else None

    def with_filters(self, parameters: Mapping[str, Number]) -> RateLaw:
        """The law as it is read from a log with these cutoffs and notches."""
        values = change_filters(self.firmware, self.values, parameters)
        return flown_loop(
            self.firmware, values, self.version, throttle=self.throttle, tracked_hz=self.tracked_hz
        ).law

    def at(self, throttle: float) -> "FlownAutopilot":
        """The same at another throttle, which moves cutoffs, notches and TPA of some firmwares."""
        if self.firmware == "px4":
            return self
        there = dataclasses.replace(self, throttle=throttle)
        return dataclasses.replace(there, law=there.with_filters({}))

    @property
    def old(self) -> dict[str, float]:
        """P, I and D of the axis by the firmware's names."""
        return parameters_of(self.law, self.axis, gains_of(self.law, self.axis))


def settings_of(path: Path, proposal: Proposal) -> LogSettings:
    """The log's own parameters, of the part that is proposed."""
    setup = proposal.setup
    prefix = setup.rate.rpartition("gyroADC")[0].rstrip(".")
    at = None if proposal.vehicle == "betaflight" else setup.start
    return read_settings(path, log=prefix, at=at)


def read_flown(
    path: Path, proposal: Proposal, settings: DesignSettings,
    tracked_hz: Mapping[int, Sequence[float]],
) -> FlownAutopilot:  # fmt: skip
    """The loop that flew. Raises ValueError where the log does not hold its gains."""
    setup, given = proposal.setup, settings_of(path, proposal)
    axis, values = AXES.index(setup.axis), _with_hold(given.values, setup.hold)
    known: dict[str, Firmware] = {"betaflight": "betaflight", "px4": "px4"}
    firmware = known.get(proposal.vehicle, "ardupilot")
    throttle = HOVER if settings.throttle is None else settings.throttle
    loop = flown_loop(firmware, values, given.version, throttle=throttle, tracked_hz=tracked_hz)
    loop = _in_angle_mode(loop) if setup.levelled else loop
    if not np.any(gains_of(loop.law, axis) > 0):
        raise ValueError(
            f"{path}: P, I and D of {setup.axis} are all 0, so there is no rate loop to tune"
        )
    return FlownAutopilot(
        firmware, tuple(given.version), axis, loop, loop.law, loop.parameters(), loop.unmodelled,
        values, throttle, tracked_hz,
        angle_loop_of(
            firmware, given.values, axis, loop.law.interval(), levelled=setup.levelled
        ),
    )  # fmt: skip


def _with_hold(values: Mapping[str, str], hold: float | None) -> Mapping[str, str]:
    """Betaflight's parameters with the loop's interval that the log's stamps show, in s."""
    if hold is None or "looptime" not in values:
        return values
    denominator = float(values.get("pid_process_denom", 1.0))
    looptime = 1e6 * hold / denominator
    if abs(looptime / float(values["looptime"]) - 1) < _SAME_LOOP:
        return values
    return {**values, "looptime": f"{looptime:.6g}"}


_SAME_LOOP = 0.05  # of the interval in the header


def _in_angle_mode(loop: FlownLoop) -> FlownLoop:
    """Betaflight's integral is held from a fifth of the set-point's speed on there."""
    relax = loop.law.relax if isinstance(loop.law, BetaflightPID) else None
    if relax is None:
        return loop
    relax = dataclasses.replace(relax, threshold=0.2 * relax.threshold)
    return dataclasses.replace(loop, law=dataclasses.replace(loop.law, relax=relax))
