"""Figures with matplotlib.

All functions that draw return `jq.plot.Panels`, and take `ax`, axes to draw into (by default a new
figure's; as many as panels, one where nothing else is said), and `title`, what stands above them.
"""

import lazy_loader


__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
