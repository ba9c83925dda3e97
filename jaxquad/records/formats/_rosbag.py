"""ROS 2 bags: a folder with metadata.yaml, or a lone .mcap or .db3 file."""

from pathlib import Path

from .._log import Log
from ._isolated import read_isolated


_MCAP, _SQLITE = b"\x89MCAP0\r\n", b"SQLite format 3\0"


def sniff(head: bytes, path: Path) -> bool:
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return head.startswith((_MCAP, _SQLITE))


def load(path: Path) -> Log:
    """The topics as tables, `/imu/data`; their channels as `/imu/data.angular_velocity.x`.

    Time is that of the message's header, or else the one at which it was recorded, in s from
    the beginning of the bag. Covariances are left out.
    """
    return read_isolated(path, module="_rosbag_tables", kind="a ROS 2 bag", per_megabyte=2.0)
