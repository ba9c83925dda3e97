"""What knows the compiler: loops as one kernel, compiler options, devices, kept programs."""

from ._accelerator import (
    scan_on_device as scan_on_device,
    why_no_device_kernels as why_no_device_kernels,
)
from ._compile_cache import (
    enable_compile_cache as enable_compile_cache,
    own_folder as own_folder,
    share_programs as share_programs,
)
from ._devices import (
    asked_devices as asked_devices,
    Devices as Devices,
    devices_for as devices_for,
    gathered as gathered,
    may_be_several as may_be_several,
    movable as movable,
    require_same as require_same,
    where_put as where_put,
)
from ._engine import (
    brief_options as brief_options,
    compiler_options as compiler_options,
    Engine as Engine,
    engine as engine,
    hasty_options as hasty_options,
    Jit as Jit,
)
from ._fusion import evaluate_once as evaluate_once, FEW as FEW, no_fuse as no_fuse
from ._kept_programs import KeptPrograms as KeptPrograms
from ._kernel import (
    apart_in_reverse as apart_in_reverse,
    as_one_kernel as as_one_kernel,
    most_numbers as most_numbers,
    why_no_kernels as why_no_kernels,
)
from ._real_parts import (
    in_real_parts as in_real_parts,
    NotInRealPartsError as NotInRealPartsError,
)
from ._shared import run_shared as run_shared
from ._swap import swap_row as swap_row
from ._vector_functions import arctan2 as arctan2, sincos as sincos
