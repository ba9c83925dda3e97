"""What knows XLA, MLIR and CUDA: loops as one kernel, compiler options, operations kept apart.

`jaxquad._compile` is the only one that imports it; its `PLAIN` has the same names without it.
"""

from ._kernel import (
    as_one_kernel as as_one_kernel,
    evaluate_once as evaluate_once,
    no_fuse as no_fuse,
    or_plain as or_plain,
    scan_on_device as scan_on_device,
    why_no_device_kernels as why_no_device_kernels,
    why_plain as why_plain,
)
from ._switch import (
    brief_options as brief_options,
    compiler_options as compiler_options,
    hasty_options as hasty_options,
    left_plain as left_plain,
    set_kernel as set_kernel,
    switches as switches,
)
