from ._arrays import (
    align as align,
    as_array as as_array,
    as_float as as_float,
    as_float_or_none as as_float_or_none,
    is_zero as is_zero,
    on_host as on_host,
    pytree_node as pytree_node,
)
from ._checks import (
    is_concrete as is_concrete,
    Number as Number,
    require_all_nonnegative as require_all_nonnegative,
    require_all_positive as require_all_positive,
    require_band as require_band,
    require_finite as require_finite,
    require_nonnegative as require_nonnegative,
    require_positive as require_positive,
    require_vector as require_vector,
    whole_samples as whole_samples,
)
from ._gains import (
    broadcast_gain as broadcast_gain,
    match_reference as match_reference,
    multiply_gains as multiply_gains,
    pick_gain as pick_gain,
    require_below_sampling as require_below_sampling,
    require_common_shape as require_common_shape,
    require_limit as require_limit,
    require_sample_interval as require_sample_interval,
    signal_shape as signal_shape,
)
from ._levenberg_marquardt import (
    advance as advance,
    begin as begin,
    CONVERGED as CONVERGED,
    DAMPING as DAMPING,
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
from ._message import (
    as_messages as as_messages,
    is_ours as is_ours,
    marked_text as marked_text,
    Message as Message,
)
from ._output import (
    announce as announce,
    plain_content as plain_content,
    STAGES as STAGES,
    write_file as write_file,
)
from ._precision import (
    enable_x64 as enable_x64,
    PrecisionError as PrecisionError,
    require_float64 as require_float64,
    require_x64 as require_x64,
)
from ._threads import (
    available_cores as available_cores,
    map_in_threads as map_in_threads,
    one_blas_thread as one_blas_thread,
    thread_settings as thread_settings,
)
