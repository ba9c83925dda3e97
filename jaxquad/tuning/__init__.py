"""Tuning over an ensemble: objectives, limits, the optimiser, certificates, Pareto fronts."""

from ._certificate import Certificate as Certificate
from ._certify import (
    certify as certify,
    describe_controller as describe_controller,
    KNOWN_INERTIA as KNOWN_INERTIA,
    paper_designs as paper_designs,
    peers as peers,
    worst_flights as worst_flights,
)
from ._cost import Evaluation as Evaluation, Tail as Tail
from ._descent import GaussNewton as GaussNewton, LBFGS as LBFGS
from ._design_result import (
    DesignResult as DesignResult,
    DesignSummary as DesignSummary,
    LinearMembers as LinearMembers,
    upper_bound as upper_bound,
)
from ._objective import (
    CVaR as CVaR,
    Limit as Limit,
    Mean as Mean,
    Mix as Mix,
    Objective as Objective,
    Penalty as Penalty,
    QUANTITIES as QUANTITIES,
    Quantity as Quantity,
    Worst as Worst,
)
from ._pareto import front_point as front_point, Pareto as Pareto, pareto as pareto
from ._problem import Bound as Bound
from ._tune import LimitResult as LimitResult, Optimum as Optimum, tune as tune, Tuned as Tuned
from ._verdict import Attainable as Attainable, Distance as Distance, Verdict as Verdict
