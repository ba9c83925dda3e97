"""The one door to the compilers: scans over members, programs that are kept, and their switches.

What knows XLA, MLIR and CUDA is `jaxquad._xla`, which nothing else imports. Without it every result
is the same, by plain scans. See docs/compilers.md.
"""

from ._door import (
    brief_options as brief_options,
    compiler_options as compiler_options,
    enable_compile_cache as enable_compile_cache,
    Engine as Engine,
    engine as engine,
    evaluate_once as evaluate_once,
    FEW as FEW,
    hasty_options as hasty_options,
    no_fuse as no_fuse,
    share_programs as share_programs,
)
from ._programs import Jit as Jit, KeptPrograms as KeptPrograms
from ._scan import (
    are_few as are_few,
    in_chunks as in_chunks,
    KEPT as KEPT,
    most_at_once as most_at_once,
    Queue as Queue,
    run_ensemble as run_ensemble,
    scan_members as scan_members,
    SINGLE as SINGLE,
)
