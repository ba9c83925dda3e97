"""Writes blackbox logs value by value, from the same documentation as the decoder but apart."""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType


MARKER = "H Product:Blackbox flight data recorder by Nicholas Sherlock\n"
END = b"E\xffEnd of log\0"
NAMES = [
    "loopIteration", "time",
    "axisP[0]", "axisP[1]", "axisP[2]", "axisI[0]", "axisI[1]", "axisI[2]",
    "rcCommand[0]", "rcCommand[1]", "rcCommand[2]", "rcCommand[3]",
    "setpoint[0]", "setpoint[1]", "setpoint[2]", "vbatLatest", "rssi",
    "gyroADC[0]", "gyroADC[1]", "gyroADC[2]",
    "motor[0]", "motor[1]", "motor[2]", "motor[3]", "servo[5]",
]  # fmt: skip
UNSIGNED = {"loopIteration", "time", "rcCommand[3]", "vbatLatest", "rssi", "motor[0]"} | {
    f"motor[{i}]" for i in range(4)
}
I_PREDICTOR = [0, 0] + [0] * 6 + [0] * 4 + [0] * 3 + [9, 0] + [0] * 3 + [11, 5, 5, 5, 8]
I_ENCODING = [1, 1] + [0] * 6 + [0, 0, 0, 1] + [0] * 3 + [3, 1] + [0] * 3 + [1, 0, 0, 0, 0]
P_PREDICTOR = [6, 2] + [1] * 6 + [1] * 4 + [1] * 3 + [1, 1] + [3] * 3 + [3, 3, 3, 3, 1]
P_ENCODING = [9, 0] + [7] * 3 + [10] * 3 + [8] * 4 + [6] * 5 + [0] * 3 + [0, 0, 0, 0, 6]
SETTINGS = {
    "Firmware type": "Cleanflight", "vbatref": "1650", "minthrottle": "1070",
    "motorOutput": "158,2047", "gyro_scale": "0x3f800000", "acc_1G": "2048", "looptime": "125",
}  # fmt: skip


def header(
    *,
    interval: int = 32,
    logged: str = "1/1",
    changed: Mapping[str, str] = MappingProxyType({}),
    extra: str = "",
) -> bytes:
    """The text before the frames; `changed` lines replace or join the usual ones."""
    settings = {
        "Data version": "2",
        "I interval": str(interval),
        "P interval": logged,
        "Field I name": ",".join(NAMES),
        "Field I signed": ",".join("0" if name in UNSIGNED else "1" for name in NAMES),
        "Field I predictor": _joined(I_PREDICTOR),
        "Field I encoding": _joined(I_ENCODING),
        "Field P predictor": _joined(P_PREDICTOR),
        "Field P encoding": _joined(P_ENCODING),
        **SETTINGS,
    }
    settings |= changed
    lines = [f"H {name}:{text}\n" for name, text in settings.items()]
    return (MARKER + "".join(lines) + extra).encode()


def frames(rows: Sequence[dict[str, int]], *, interval: int = 32) -> list[bytes]:
    """One frame for each row, which gives a value for every name: I where iteration says so."""
    written, last, older = [], None, None
    for row in rows:
        values = [row[name] for name in NAMES]
        if row["loopIteration"] % interval == 0:
            coded = [v - _i_prediction(n, row) for n, v in enumerate(values)]
            written.append(b"I" + _encoded(coded, I_ENCODING))
            last = older = values
        else:
            assert last is not None and older is not None, "a log begins with a key frame"
            coded = [v - _p_prediction(n, v, last[n], older[n]) for n, v in enumerate(values)]
            written.append(b"P" + _encoded(coded, P_ENCODING))
            last, older = values, last
    return written


def _i_prediction(field: int, row: dict[str, int]) -> int:
    constants = {0: 0, 5: row["motor[0]"], 8: 1500, 9: 1650, 11: 158}
    return constants[I_PREDICTOR[field]]


def _p_prediction(field: int, value: int, last: int, older: int) -> int:
    by_predictor = {1: last, 2: 2 * last - older, 3: math.trunc((last + older) / 2), 6: value}
    return by_predictor[P_PREDICTOR[field]]


def _encoded(values: list[int], encodings: list[int]) -> bytes:
    out, at = b"", 0
    while at < len(values):
        encoding = encodings[at]
        most = {6: 8, 7: 3, 8: 4, 10: 3}.get(encoding, 1)
        count = 1
        while count < most and at + count < len(values) and encodings[at + count] == encoding:
            count += 1
        out += ENCODERS[encoding](values[at : at + count])
        at += count
    return out


def unsigned(value: int) -> bytes:
    value &= 0xFFFFFFFF
    out = bytearray()
    while value > 127:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def signed(value: int) -> bytes:
    value = (value + 2**31) % 2**32 - 2**31
    return unsigned(2 * value if value >= 0 else -2 * value - 1)


def _flagged(values: list[int]) -> bytes:
    if len(values) == 1:
        return signed(values[0])
    flags = sum(1 << i for i, value in enumerate(values) if value)
    return bytes([flags]) + b"".join(signed(value) for value in values if value)


def _bits(pairs: Sequence[tuple[int, int]]) -> bytes:
    """Pairs of a value and its width, the first in the highest bits, filled up to whole bytes."""
    text = "".join(format(value % (1 << width), f"0{width}b") for value, width in pairs if width)
    text += "0" * (-len(text) % 8)
    return bytes(int(text[i : i + 8], 2) for i in range(0, len(text), 8))


def _fits(values: Sequence[int], widths: Sequence[int]) -> bool:
    return all(-(1 << w - 1) <= v < 1 << w - 1 for v, w in zip(values, widths, strict=True))


def _bytes_each(values: list[int]) -> bytes:
    sizes = [next(n for n in (1, 2, 3, 4) if _fits([v], [8 * n])) for v in values]
    tag = 0b11000000 | sum((n - 1) << 2 * i for i, n in enumerate(sizes))
    parts = [v.to_bytes(n, "little", signed=True) for v, n in zip(values, sizes, strict=True)]
    return bytes([tag]) + b"".join(parts)


def _three(values: list[int]) -> bytes:
    if _fits(values, (2, 2, 2)):
        return _bits([(0, 2), *((v, 2) for v in values)])
    if _fits(values, (4, 4, 4)):
        return _bits([(0b0100, 4), *((v, 4) for v in values)])
    if _fits(values, (6, 6, 6)):
        return _bits([(2, 2), (values[0], 6), (0, 2), (values[1], 6), (0, 2), (values[2], 6)])
    return _bytes_each(values)


def _three_variable(values: list[int]) -> bytes:
    for tag, widths in enumerate(((2, 2, 2), (5, 5, 4), (8, 7, 7))):
        if _fits(values, widths):
            return _bits([(tag, 2), *zip(values, widths, strict=True)])
    return _bytes_each(values)


def _four(values: list[int]) -> bytes:
    codes = [0 if v == 0 else next(c for c in (1, 2, 3) if _fits([v], [2 << c])) for v in values]
    tag = sum(code << 2 * i for i, code in enumerate(codes))
    widths = [(0, 4, 8, 16)[code] for code in codes]
    return bytes([tag]) + _bits(list(zip(values, widths, strict=True)))


def _joined(numbers: list[int]) -> str:
    return ",".join(map(str, numbers))


ENCODERS = {
    0: lambda v: signed(v[0]),
    1: lambda v: unsigned(v[0]),
    3: lambda v: unsigned(-v[0] & 0x3FFF),
    6: _flagged,
    7: _three,
    8: _four,
    9: lambda v: b"",
    10: _three_variable,
}
