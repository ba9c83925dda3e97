"""Controllers as C headers."""

from ._header import (
    c_header as c_header,
    ExportableController as ExportableController,
    write_c_header as write_c_header,
)
from ._source import Gain as Gain, Source as Source
