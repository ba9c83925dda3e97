from ._main import main as main, make_parser as make_parser
