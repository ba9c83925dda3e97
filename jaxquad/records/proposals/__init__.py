from ._firmware_log import FirmwareLog as FirmwareLog, Flight as Flight
from ._flights import flights as flights
from ._proposal import Proposal as Proposal
from ._propose import propose as propose
from ._setup import AXES as AXES
