"""Arrays and checks, the members axis, Levenberg-Marquardt, numbers of threads, stages."""

import lazy_loader


__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
