"""Controllers as C headers."""

from ._header import (
    c_header as c_header,
    ExportableController as ExportableController,
    Gain as Gain,
    Source as Source,
    write_c_header as write_c_header,
)
