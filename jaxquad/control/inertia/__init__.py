from ._estimator import NoProbe as NoProbe, ProbeTones as ProbeTones
from ._lock_in import LockInInertia as LockInInertia
from ._maps import (
    certainty_equivalence as certainty_equivalence,
    Falling as Falling,
    FuzzyMap as FuzzyMap,
    InertiaMap as InertiaMap,
    printed_map as printed_map,
)
from ._paper import (
    disturbance_slope as disturbance_slope,
    disturbed_axis as disturbed_axis,
    estimate_disturbance as estimate_disturbance,
    expected_disturbance as expected_disturbance,
    filter_signals as filter_signals,
    observe_disturbance as observe_disturbance,
    paper_inertia as paper_inertia,
)
from ._regression import RecursiveInertia as RecursiveInertia, WindowedInertia as WindowedInertia
