"""Controllers as C headers."""

from ._header import c_header as c_header, write_c_header as write_c_header
