from ._firmware_log import FirmwareLog as FirmwareLog, Flight as Flight
from ._proposal import Proposal as Proposal
from ._propose import flights as flights, propose as propose
from ._setup import AXES as AXES
