from .._log import Log as Log, Table as Table
from ._readers import (
    load_log as load_log,
    load_signals as load_signals,
    Reader as Reader,
    READERS as READERS,
    require_file as require_file,
)
