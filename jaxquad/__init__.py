"""From a flight record to an identified model with honest error bars, in JAX."""

import lazy_loader

from .records._firmwares import offer


for _name in ("ardupilot", "px4", "betaflight", "crazyflie"):
    offer(_name, f"jaxquad.autopilot.firmwares._{_name}_log")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
