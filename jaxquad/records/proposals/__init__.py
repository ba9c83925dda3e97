from ._flights import Flight as Flight, flights as flights
from ._proposal import AXES as AXES, Proposal as Proposal
from ._propose import propose as propose
