from ._arrays import (
    align as align,
    as_float as as_float,
    as_float_or_none as as_float_or_none,
    is_concrete as is_concrete,
    is_zero as is_zero,
    require_finite as require_finite,
    require_nonnegative as require_nonnegative,
    require_positive as require_positive,
    require_vector as require_vector,
)
from ._checks import (
    check_band as check_band,
    check_not_negative as check_not_negative,
    check_positive as check_positive,
    Number as Number,
    whole_samples as whole_samples,
)
from ._files import write_file as write_file
from ._levenberg_marquardt import (
    advance as advance,
    begin as begin,
    CONVERGED as CONVERGED,
    decrement as decrement,
    Descent as Descent,
    minimise as minimise,
    minimise_on_host as minimise_on_host,
    Normal as Normal,
    normal_equations as normal_equations,
    RUNNING as RUNNING,
    settle as settle,
    solve_definite as solve_definite,
    STALLED as STALLED,
    TOLERANCE as TOLERANCE,
)
from ._members import (
    ensemble_shape as ensemble_shape,
    mark_members as mark_members,
    per_member as per_member,
)
from ._per_axis import (
    fit as fit,
    full_shape as full_shape,
    matched as matched,
    pick as pick,
    require_below as require_below,
    require_limit as require_limit,
    require_sample as require_sample,
    require_shapes as require_shapes,
    times as times,
)
from ._precision import (
    enable_x64 as enable_x64,
    PrecisionError as PrecisionError,
    require_float64 as require_float64,
    require_x64 as require_x64,
)
from ._threads import one_blas_thread as one_blas_thread
