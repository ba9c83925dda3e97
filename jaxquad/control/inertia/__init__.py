from ._lock_in import LockInInertia as LockInInertia
from ._maps import (
    certainty_equivalence as certainty_equivalence,
    Falling as Falling,
    FuzzyMap as FuzzyMap,
    InertiaMap as InertiaMap,
    printed_map as printed_map,
)
from ._probe_tones import NoProbe as NoProbe, ProbeTones as ProbeTones
from ._regression import (
    RecursiveInertia as RecursiveInertia,
    WindowedInertia as WindowedInertia,
)
