"""Controllers (LADRC, PID, adaptive LADRC), observers and estimators of the inertia."""

from ._fourier import FourierInertia as FourierInertia, Parameters as FourierParameters
from ._ladrc import LADRC as LADRC, LADRCLaw as LADRCLaw
from ._lock_in import LockInInertia as LockInInertia, NoProbe as NoProbe, ProbeTones as ProbeTones
from ._pid import (
    BackCalculation as BackCalculation,
    Clamping as Clamping,
    PD as PD,
    PID as PID,
    place_pd as place_pd,
)
from ._protocols import (
    AntiWindup as AntiWindup,
    as_setpoint as as_setpoint,
    CurrentObserver as CurrentObserver,
    EulerObserver as EulerObserver,
    find_transform as find_transform,
    InertiaEstimate as InertiaEstimate,
    InertiaEstimator as InertiaEstimator,
    LinearController as LinearController,
    LinearisableController as LinearisableController,
    Member as Member,
    Observer as Observer,
    ObserverController as ObserverController,
    PredictiveObserver as PredictiveObserver,
    ProbingEstimator as ProbingEstimator,
    Reference as Reference,
    schedule_for_analysis as schedule_for_analysis,
    schedule_for_flight as schedule_for_flight,
    ScheduledController as ScheduledController,
    Setpoint as Setpoint,
    Transform as Transform,
    Tunable as Tunable,
)
from ._regression import (
    paper_inertia as paper_inertia,
    RecursiveInertia as RecursiveInertia,
    WindowedInertia as WindowedInertia,
)
from ._scheduled import (
    AdaptiveLADRC as AdaptiveLADRC,
    certainty_equivalence as certainty_equivalence,
    Falling as Falling,
    FuzzyMap as FuzzyMap,
    InertiaMap as InertiaMap,
    printed_map as printed_map,
    ScheduledLADRC as ScheduledLADRC,
    ScheduledPID as ScheduledPID,
)
