from ._certificate import Certificate as Certificate
from ._certify import certify as certify
from ._distance import Distance as Distance
from ._gauss_newton import GaussNewton as GaussNewton
from ._judged import Judged as Judged
from ._lbfgs import LBFGS as LBFGS
from ._objective import (
    CVaR as CVaR,
    Limit as Limit,
    Mean as Mean,
    Mix as Mix,
    Objective as Objective,
    Penalty as Penalty,
    Worst as Worst,
)
from ._pareto import Pareto as Pareto, pareto as pareto, place as place
from ._peers import paper_designs as paper_designs, peers as peers
from ._progress import Evaluation as Evaluation
from ._quantities import SHOWN as SHOWN, Shown as Shown
from ._row import upper_bound as upper_bound
from ._tune import tune as tune
from ._tuned import Kept as Kept, Optimum as Optimum, Tuned as Tuned
