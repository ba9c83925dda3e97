"""Firmwares whose logs are understood: each says what its channels mean, and no reader has to.

What comes with the package is offered by the name of a module, which is imported when a log of that
firmware is read. This file is imported with jaxquad itself, so it imports nothing else.
"""

import importlib
from collections.abc import Iterator


TYPE_CHECKING = False  # for checkers, without the time to import typing
if TYPE_CHECKING:
    from .firmware import FirmwareLog

_OFFERED: dict[str, "str | FirmwareLog"] = {}  # by the `vehicle` of logs


def offer(name: str, module: str) -> None:
    """Let a module's constant, `PX4` of "px4", say what the logs of a firmware mean."""
    _OFFERED[name] = module


def register_log(log: "FirmwareLog") -> None:
    """Let `jq.propose`, `jq.read` and the others understand the logs of a further firmware."""
    _OFFERED[log.name] = log


def firmware_names() -> tuple[str, ...]:
    """All that are offered or registered."""
    return tuple(_OFFERED)


def firmware_log(name: str) -> "FirmwareLog | None":
    """What the logs of a firmware mean; None for others."""
    offered = _OFFERED.get(name)
    if isinstance(offered, str):
        offered = _OFFERED[name] = getattr(importlib.import_module(offered), name.upper())
    return offered


def registered_logs() -> "Iterator[FirmwareLog]":
    """Those from outside of the package."""
    return (log for log in tuple(_OFFERED.values()) if not isinstance(log, str))


def axis_of_rate(name: str) -> int | None:
    """0, 1 or 2 for a channel that is a rate behind the gyro's filters of a firmware."""
    for log in map(firmware_log, firmware_names()):
        if log is not None and log.gyro_cutoffs:
            for axis, rate in enumerate(log.rates):
                if name == rate or name.endswith(f".{rate}"):
                    return axis
    return None


def channel_limit(name: str) -> float | None:
    """The most that a stick or a command of a firmware reaches, in the channel's unit; None where
    it is not known."""
    for log in map(firmware_log, firmware_names()):
        for prefix, limit in {} if log is None else log.limits.items():
            if name.startswith(prefix) or f".{prefix}" in name:
                return limit
    return None


def is_setpoint(name: str) -> bool:
    """Whether a channel is the rate set-point of a firmware."""
    logs = (log for log in map(firmware_log, firmware_names()) if log is not None)
    return any(name == x or name.endswith(f".{x}") for log in logs for x in log.setpoints)
