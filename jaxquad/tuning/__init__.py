"""Tuning over an ensemble: objectives, limits, the optimiser, certificates, Pareto fronts."""

from ._certificate import Certificate as Certificate
from ._certify import (
    certify as certify,
    describe_controller as describe_controller,
    KNOWN_INERTIA as KNOWN_INERTIA,
    paper_designs as paper_designs,
    peers as peers,
)
from ._cost import Evaluation as Evaluation
from ._design_result import (
    DesignResult as DesignResult,
    DesignSummary as DesignSummary,
    Distance as Distance,
    front_point as front_point,
    LinearMembers as LinearMembers,
    share_interval as share_interval,
    upper_bound as upper_bound,
)
from ._gauss_newton import GaussNewton as GaussNewton
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
from ._pareto import Pareto as Pareto, pareto as pareto
from ._quantities import QUANTITIES as QUANTITIES, Quantity as Quantity
from ._tail import Tail as Tail
from ._tune import tune as tune
from ._tuned import (
    LimitResult as LimitResult,
    Optimum as Optimum,
    Tuned as Tuned,
    worst_flights as worst_flights,
)
from ._verdict import Bound as Bound, Verdict as Verdict
