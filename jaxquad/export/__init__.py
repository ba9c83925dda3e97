"""Controllers as C headers, gains as parameter files of autopilots."""

from ._autopilot import (
    change_table as change_table,
    parameter_file as parameter_file,
    ParameterChange as ParameterChange,
    ParameterFiles as ParameterFiles,
    propose_changes as propose_changes,
    WordChange as WordChange,
    write_parameter_files as write_parameter_files,
)
from ._header import (
    c_header as c_header,
    ExportableController as ExportableController,
    write_c_header as write_c_header,
)
from ._source import Gain as Gain, Source as Source
