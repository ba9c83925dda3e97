from ._actuator import MotorDrive as MotorDrive
from ._excite import excite as excite
from ._integrate import runge_kutta as runge_kutta
from ._loop import Scenario as Scenario, simulate as simulate, Simulation as Simulation
from ._noise import gauss_markov as gauss_markov
from ._sensor import Encoder as Encoder
