from typing import NamedTuple


LOG_END = "log end"
RESUME = "logging resume"
ADJUSTMENT = "inflight adjustment"


class Event(NamedTuple):
    """A transition that the flight controller noted; `end` is the offset behind it."""

    offset: int
    name: str
    values: tuple[int, ...]
    end: int


# Event type: its name and how many variable-byte numbers it carries.
_COUNTED = {
    0: ("sync beep", 1),
    14: (RESUME, 2),
    15: ("disarm", 1),
    30: ("flight mode", 2),
}
_ADJUSTED = 13
_END = 255
_END_TEXT = b"End of log"


def event(data: bytes, at: int, stop: int) -> Event | None:
    """The event frame at `at`, or None where there is none that is known and whole."""
    if data[at : at + 1] != b"E" or at + 2 >= stop:
        return None
    kind = data[at + 1]
    if kind == _END:
        return _log_end(data, at, stop)
    if kind == _ADJUSTED:
        return _adjustment(data, at, stop)
    if kind not in _COUNTED:
        return None
    name, count = _COUNTED[kind]
    values, end = [], at + 2
    for _ in range(count):
        value, end = _variable(data, end, stop)
        values.append(value)
    return Event(at, name, tuple(values), end) if end <= stop else None


def _log_end(data: bytes, at: int, stop: int) -> Event | None:
    if not data.startswith(_END_TEXT, at + 2):
        return None
    null = data.find(b"\0", at + 2, min(stop, at + 80))
    return Event(at, LOG_END, (), null + 1) if null >= 0 else None


def _adjustment(data: bytes, at: int, stop: int) -> Event | None:
    """A setting changed in flight: its number, and its value unless that is a float."""
    setting = data[at + 2]
    if setting >= 128:
        return Event(at, ADJUSTMENT, (setting,), at + 7) if at + 7 <= stop else None
    value, end = _variable(data, at + 3, stop)
    signed = value >> 1 ^ -(value & 1)
    return Event(at, ADJUSTMENT, (setting, signed), end) if end <= stop else None


def _variable(data: bytes, at: int, stop: int) -> tuple[int, int]:
    """A number of at most five bytes and the offset behind it, which is beyond `stop` if none."""
    value = 0
    for i, byte in enumerate(data[at : min(at + 5, stop)]):
        value |= (byte & 0x7F) << 7 * i
        if byte < 0x80:
            return value & 0xFFFFFFFF, at + i + 1
    return 0, stop + 1
