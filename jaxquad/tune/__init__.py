from ._certificate import Certificate as Certificate
from ._certify import certify as certify
from ._confidence import upper_bound as upper_bound
from ._descent import LBFGS as LBFGS
from ._distance import Distance as Distance
from ._ensemble import Ensemble as Ensemble
from ._gauss_newton import GaussNewton as GaussNewton
from ._judged import Judged as Judged
from ._law import Choice as Choice, Fixed as Fixed, Law as Law
from ._laws import (
    LogNormal as LogNormal,
    LogUniform as LogUniform,
    Normal as Normal,
    Uniform as Uniform,
)
from ._limit import Limit as Limit
from ._members import Members as Members
from ._objective import Objective as Objective
from ._optimum import Optimum as Optimum
from ._pareto import Pareto as Pareto, pareto as pareto
from ._payload import Payload as Payload
from ._peers import paper_designs as paper_designs, peers as peers
from ._penalty import Penalty as Penalty
from ._progress import Evaluation as Evaluation
from ._risk import CVaR as CVaR, Mean as Mean, Mix as Mix, Worst as Worst
from ._tune import tune as tune
from ._tuned import Kept as Kept, Tuned as Tuned
