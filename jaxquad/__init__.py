"""From a flight record to an identified model with honest error bars, in JAX."""

import lazy_loader

from .records._firmwares import offer


# The module of each firmware's `FirmwareLog`, a constant with the name of the firmware: `PX4`.
_LOGS = dict(ardupilot="_logs", px4="_logs", betaflight="_betaflight_log", crazyflie="_logs")
for _name, _module in _LOGS.items():
    offer(_name, f"jaxquad.autopilot.firmwares.{_module}")

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
