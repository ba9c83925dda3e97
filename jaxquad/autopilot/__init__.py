"""Firmwares of real autopilots: their rate loops and filters, files, logs, and gains for them."""

import lazy_loader


__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
