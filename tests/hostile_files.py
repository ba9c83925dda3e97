"""Small sound files of every kind that is read, and ways to damage them."""

import struct
import tempfile
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from blackbox_rows import log as blackbox_log, rows as blackbox_rows
from log_writers import DataFlash, structured, ULog


ROWS = 40
TIME = 3.0 + np.arange(ROWS) / 100
WAVE = np.sin(TIME)
EXTREMES = (0, 1, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0xFFFFFFFF, 2**63 - 1, 2**64 - 1)


def sound_files(kinds: Sequence[str] = ()) -> dict[str, tuple[str, bytes]]:
    """By kind (all by default): the file's name and its content."""
    makers: Mapping[str, tuple[str, Callable[[Path], None]]] = {
        "npz": ("log.npz", lambda path: np.savez_compressed(path, t=TIME, u=WAVE, y=WAVE[:, None])),
        "npy": ("log.npy", lambda path: np.save(path, np.stack([TIME, WAVE], axis=1))),
        "csv": ("log.csv", _csv),
        "mat": ("log.mat", lambda path: _mat(path, compressed=True)),
        "mat plain": ("log.mat", lambda path: _mat(path, compressed=False)),
        "dataflash": ("log.bin", lambda path: _put(path, _dataflash())),
        "dataflash text": ("log.log", lambda path: _put(path, _dataflash_text().encode())),
        "ulog": ("log.ulg", lambda path: _put(path, _ulog())),
        "betaflight": ("log.bbl", lambda path: _put(path, blackbox_log(blackbox_rows(ROWS)))),
        "betaflight table": ("log.csv", _blackbox_table),
        "crazyflie": ("log15", lambda path: _put(path, _crazyflie())),
        "hdf5": ("log.h5", _hdf5),
        "parquet": ("log.parquet", _parquet),
        "mcap": ("log.mcap", lambda path: _bag(path, "MCAP")),
        "db3": ("log.db3", lambda path: _bag(path, "SQLITE3")),
    }
    with tempfile.TemporaryDirectory() as folder:
        files = {}
        for kind in kinds or makers:
            name, make = makers[kind]
            path = Path(folder) / name
            make(path)
            files[kind] = name, path.read_bytes()
            path.unlink()
        return files


def damaged(content: bytes, rng: np.random.Generator) -> bytes:
    """The content cut, flipped, overwritten, doubled or shuffled, once to four times."""
    ways = (_cut, _flip, _flip, _extreme, _extreme, _repeat, _remove, _noise, _swap)
    for _ in range(rng.integers(1, 5)):
        if content:
            content = ways[rng.integers(len(ways))](content, rng)
    return content


def _cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: rng.integers(len(content) + 1)]


def _flip(content: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(content)
    for place in rng.integers(len(content), size=rng.integers(1, 9)):
        changed[place] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _extreme(content: bytes, rng: np.random.Generator) -> bytes:
    """A number such as a length becomes as small or as large as it can be."""
    width = int(rng.choice([1, 2, 4, 8]))
    place = int(rng.integers(len(content)))
    order = "little" if rng.random() < 0.8 else "big"
    value = EXTREMES[rng.integers(len(EXTREMES))] % 256**width
    return content[:place] + value.to_bytes(width, order) + content[place + width :]


def _repeat(content: bytes, rng: np.random.Generator) -> bytes:
    first, last = np.sort(rng.integers(len(content) + 1, size=2))
    return content[:last] + content[first:last] * int(rng.integers(1, 4)) + content[last:]


def _remove(content: bytes, rng: np.random.Generator) -> bytes:
    first = int(rng.integers(len(content)))
    return content[:first] + content[first + int(rng.integers(1, 200)) :]


def _noise(content: bytes, rng: np.random.Generator) -> bytes:
    first, size = int(rng.integers(len(content))), int(rng.integers(1, 100))
    return content[:first] + rng.bytes(size) + content[first + size :]


def _swap(content: bytes, rng: np.random.Generator) -> bytes:
    a, b = np.sort(rng.integers(len(content) + 1, size=2))
    return content[:a] + content[b:] + content[a:b]


def _put(path: Path, content: bytes) -> None:
    path.write_bytes(content)


def _csv(path: Path) -> None:
    rows = (f"{t!r},{u!r},{u * t!r}" for t, u in zip(TIME.tolist(), WAVE.tolist(), strict=True))
    path.write_text("\n".join(["# flight 7", "t,u,y", *rows]) + "\n")


def _mat(path: Path, *, compressed: bool) -> None:
    from scipy.io import savemat

    values = {"t": TIME, "u": WAVE, "s": {"q": WAVE, "n": {"deep": WAVE[:, None]}}, "note": "x"}
    savemat(path, values, do_compression=compressed)


def _dataflash() -> bytes:
    log = DataFlash()
    log.define("IMU", "QBfff", "TimeUS,I,GyrX,GyrY,GyrZ", units="s#EEE", mults="F-000")
    log.define("RATE", "Qfffc", "TimeUS,RDes,R,ROut,A", units="skk--", mults="F----")
    log.write("PARM", 0, b"SID_AXIS", 10.0)
    for k, (t, u) in enumerate(zip((TIME * 1e6).astype(int).tolist(), WAVE.tolist(), strict=True)):
        log.write("IMU", t, k % 2, u, -u, 2 * u)
        log.write("RATE", t + 100, u, u, -u, k)
    return bytes(log.content)


def _dataflash_text() -> str:
    lines = [
        "FMT, 128, 89, FMT, BBnNZ, Type,Length,Name,Format,Columns",
        "FMT, 140, 27, RATE, Qfff, TimeUS,RDes,R,ROut",
        "FMT, 141, 20, MODE, QMB, TimeUS,Mode,Rsn",
        "PARM, 1, SID_AXIS, 10",
        "MODE, 3000000, Stabilize, 1",
    ]
    stamps = (TIME * 1e6).astype(int).tolist()
    lines += [f"RATE, {t}, {u:.6f}, {-u:.6f}, 0.5" for t, u in zip(stamps, WAVE, strict=True)]
    return "\n".join(lines) + "\n"


def _ulog() -> bytes:
    log = ULog()
    log.define("vehicle_angular_velocity:uint64_t timestamp;float[3] xyz;uint8_t[4] _padding0;")
    log.define("gain:float p;float i;")
    log.define("rate_ctrl_status:uint64_t timestamp;gain[2] axis;gain other;")
    log.info("char[4] sys_name", b"PX4\0")
    log.info("float MC_ROLLRATE_P", np.float32(0.15).tobytes(), kind="P")
    log.subscribe(1, "vehicle_angular_velocity")
    log.subscribe(2, "rate_ctrl_status", 1)
    stamps = (TIME * 1e6).astype("<u8")
    xyz = np.stack([WAVE, -WAVE, WAVE], axis=1)
    rates = structured({"timestamp": ("<u8", stamps), "xyz": ("(3,)<f4", xyz)})
    gains = structured({"timestamp": ("<u8", stamps)} | {f"g{i}": ("<f4", WAVE) for i in range(6)})
    for k in range(0, ROWS, 10):
        log.write_rows(1, rates[k : k + 10])
        log.sync()
        log.write_rows(2, gains[k : k + 10])
    log.dropout(20)
    return bytes(log.content)


def _blackbox_table(path: Path) -> None:
    names = "loopIteration, time (us), axisP[0], gyroADC[0] (deg/s), flightModeFlags (flags)"
    rows = (f"{k}, {1000 * k}, {k % 7}, {u:.4f}, ACRO" for k, u in enumerate(WAVE))
    path.write_text("\n".join([names, *rows]) + "\n")


def _crazyflie() -> bytes:
    content = struct.pack("<BHH", 0xBC, 2, 2)
    for number, name in ((0xFFFF, "fixedFrequency"), (7, "estTDOA")):
        content += struct.pack("<H", number) + name.encode() + b"\0"
        content += struct.pack("<H", 2) + b"gyro.x(f)\0motor.m1(H)\0"
    for k, u in enumerate(WAVE.tolist()):
        for number in (0xFFFF, 7):
            content += struct.pack("<HQfH", number, 10_000 * k + number % 2, u, k)
    return content + struct.pack("<I", zlib.crc32(content))


def _hdf5(path: Path) -> None:
    import h5py

    with h5py.File(path, "w") as file:
        file["t"] = TIME
        file.create_dataset("run/u", data=WAVE, compression="gzip")
        file["run/y"] = np.stack([WAVE, TIME], axis=1)
        file["run/y"].attrs["units"] = "rad/s"


def _parquet(path: Path) -> None:
    import pyarrow
    import pyarrow.parquet

    table = pyarrow.table({"t": TIME, "u": WAVE, "note": ["x"] * ROWS})
    pyarrow.parquet.write_table(table, path)


def _bag(path: Path, storage: str) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import get_typestore, Stores

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "geometry_msgs/msg/Vector3Stamped"
    header, stamp, vector = (
        store.types[name]
        for name in (
            "std_msgs/msg/Header",
            "builtin_interfaces/msg/Time",
            "geometry_msgs/msg/Vector3",
        )
    )
    folder = path.parent / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin[storage]) as writer:
        topic = writer.add_connection("/rate", kind, typestore=store)
        for k, (t, u) in enumerate(zip(TIME.tolist(), WAVE.tolist(), strict=True)):
            message = store.types[kind](header(stamp(3, 10**7 * k), "base"), vector(u, -u, 0.0))
            writer.write(topic, int(t * 1e9), store.serialize_cdr(message, kind))
    next(folder.glob(f"*{path.suffix}")).rename(path)
    for left in folder.iterdir():
        left.unlink()
    folder.rmdir()
