"""What the file of a firmware needs to say what its logs mean: see `FirmwareLog`."""

from ._clock import FEWEST as FEWEST
from ._firmwares import (
    axis_of_rate as axis_of_rate,
    firmware_log as firmware_log,
    firmware_names as firmware_names,
    register_log as register_log,
)
from ._log import flattened as flattened, Log as Log, Signals as Signals, Table as Table
from .formats import Reader as Reader
from .proposals._firmware_log import (
    FirmwareLog as FirmwareLog,
    hold_by_rate as hold_by_rate,
    number_of as number_of,
    plausible_hold as plausible_hold,
)
from .proposals._setup import (
    channel_rate as channel_rate,
    choose_chirps as choose_chirps,
    first_logged as first_logged,
    Injection as Injection,
    most_active_axis as most_active_axis,
    moves as moves,
    NumberedChirp as NumberedChirp,
    Point as Point,
    Selection as Selection,
    Setup as Setup,
    values_of as values_of,
    with_injections as with_injections,
)
