from ._adaptive_ladrc import (
    AdaptiveLADRC as AdaptiveLADRC,
    AdaptiveLADRCState as AdaptiveLADRCState,
)
from ._anti_windup import (
    AntiWindup as AntiWindup,
    BackCalculation as BackCalculation,
    Clamping as Clamping,
)
from ._ladrc import (
    LADRC as LADRC,
    LADRCGains as LADRCGains,
    LADRCLaw as LADRCLaw,
    LADRCState as LADRCState,
)
from ._observers import (
    CurrentObserver as CurrentObserver,
    EulerObserver as EulerObserver,
    Observer as Observer,
    PredictiveObserver as PredictiveObserver,
)
from ._pd import PD as PD, place_pd as place_pd
from ._pid import PID as PID, PIDLaw as PIDLaw, PIDState as PIDState
from ._protocols import (
    as_setpoint as as_setpoint,
    LinearController as LinearController,
    Setpoint as Setpoint,
)
from ._scheduled import (
    flown as flown,
    ScheduledLADRC as ScheduledLADRC,
    ScheduledPID as ScheduledPID,
    told as told,
)
from .inertia._estimate import (
    InertiaEstimate as InertiaEstimate,
    InertiaEstimator as InertiaEstimator,
)
from .inertia._lock_in import LockInInertia as LockInInertia
from .inertia._maps import (
    certainty_equivalence as certainty_equivalence,
    FuzzyMap as FuzzyMap,
    InertiaMap as InertiaMap,
    printed_map as printed_map,
)
from .inertia._probe_tones import NoProbe as NoProbe, ProbeTones as ProbeTones
from .inertia._recursive import RecursiveInertia as RecursiveInertia
from .inertia._windowed import WindowedInertia as WindowedInertia
