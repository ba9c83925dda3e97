from ._analysis import analyse_loop as analyse_loop
from ._result import LoopAnalysis as LoopAnalysis, LoopResponse as LoopResponse
from ._window import gain_window as gain_window, GainWindow as GainWindow
