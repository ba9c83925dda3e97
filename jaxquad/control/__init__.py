from ._adaptive_ladrc import (
    AdaptiveLADRC as AdaptiveLADRC,
    AdaptiveLADRCState as AdaptiveLADRCState,
)
from ._anti_windup import (
    AntiWindup as AntiWindup,
    BackCalculation as BackCalculation,
    Clamping as Clamping,
)
from ._fuzzy_map import FuzzyMap as FuzzyMap, printed_map as printed_map
from ._inertia_estimate import (
    InertiaEstimate as InertiaEstimate,
    InertiaEstimator as InertiaEstimator,
)
from ._inertia_map import certainty_equivalence as certainty_equivalence, InertiaMap as InertiaMap
from ._ladrc import LADRC as LADRC
from ._ladrc_gains import LADRCGains as LADRCGains
from ._ladrc_law import LADRCLaw as LADRCLaw, LADRCState as LADRCState
from ._linear import LinearController as LinearController
from ._lock_in_inertia import LockInInertia as LockInInertia
from ._observers import (
    CurrentObserver as CurrentObserver,
    EulerObserver as EulerObserver,
    Observer as Observer,
    PredictiveObserver as PredictiveObserver,
)
from ._pd import PD as PD, place_pd as place_pd
from ._pid import PID as PID
from ._pid_law import PIDLaw as PIDLaw, PIDState as PIDState
from ._probe_tones import NoProbe as NoProbe, ProbeTones as ProbeTones
from ._recursive_inertia import RecursiveInertia as RecursiveInertia
from ._scheduled import (
    flown as flown,
    ScheduledLADRC as ScheduledLADRC,
    ScheduledPID as ScheduledPID,
    told as told,
)
from ._setpoint import as_setpoint as as_setpoint, Setpoint as Setpoint
from ._windowed_inertia import WindowedInertia as WindowedInertia
