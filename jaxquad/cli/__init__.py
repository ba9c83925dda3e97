"""The command line `jaxquad`: options in, messages out."""

from ._main import main as main, make_parser as make_parser
