import atexit
import contextlib
import ctypes
import gc
import os
import shutil
import tempfile
from importlib.metadata import version
from pathlib import Path


# Many small matrices: threads would only wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import equinox as eqx
import jax
import jaxtyping
import psutil
import pytest
import type_checks


gc.disable()  # while tests are collected
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")

MEMORY = max(3 * 2**30, psutil.virtual_memory().total // 5)  # bytes of one worker
ROOT = Path(__file__).parent.parent
QUICKLY = "jax_disable_most_optimizations"
FLAGS = "--xla_backend_optimization_level=0"
if version("jaxlib").startswith("0.10."):  # another XLA may not know this one, and would exit
    FLAGS += " --xla_cpu_use_fusion_emitters=false"  # a quarter less of the tests' processor time
    FLAGS += " --xla_llvm_disable_expensive_passes=true --xla_cpu_parallel_codegen_split_count=1"
FOLDER, LEAST = "JAX_COMPILATION_CACHE_DIR", "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"


def share_compiled_loops() -> None:
    """Let workers and their subprocesses take from disk what one of them has compiled."""
    if FOLDER not in os.environ:  # as in the workers, whose parent it is that removes it
        os.environ[FOLDER] = tempfile.mkdtemp(prefix="jaxquad-compiled-")
        os.environ[LEAST] = "0.1"  # s of compile time: smaller programs take as long to store
        atexit.register(shutil.rmtree, os.environ[FOLDER], ignore_errors=True)
    jax.config.update(FOLDER.lower(), os.environ[FOLDER])
    jax.config.update(LEAST.lower(), float(os.environ.get(LEAST, 1.0)))


share_compiled_loops()


def pytest_configure(config):
    """Have quick tests compiled quickly: what they run takes no time.

    Slow ones run as users do, but for those that use `compiled_quickly`.
    """
    if config.option.markexpr == "not slow":
        os.environ.setdefault("XLA_FLAGS", FLAGS)


@pytest.fixture(scope="module")
def compiled_quickly():
    """For slow tests, and their processes, whose programs take longer to compile than to run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(QUICKLY.upper(), "1")
        jax.config.update(QUICKLY, True)
        yield
        jax.config.update(QUICKLY, False)


def pytest_runtest_setup():
    type_checks.begin_test()


def pytest_collection_finish():
    """Let collections of garbage come seldom, and pass over what was imported, which stays."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000)  # else 1 s of 20
    gc.enable()


@pytest.fixture(scope="module", autouse=True)
def bounded_memory():
    """Forget compiled loops between modules: a worker would keep gigabytes of them."""
    yield
    if psutil.Process().memory_info().rss > MEMORY:
        eqx.clear_caches()
        jax.clear_caches()
        gc.collect()
        # glibc keeps what is freed: without this, every later module would start from nothing.
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL("libc.so.6").malloc_trim(0)


@pytest.fixture(scope="session")
def data() -> Path:
    """The folder of measured flights, which the repository does not hold."""
    folder = Path(os.environ.get("JAXQUAD_DATA", ROOT / ".." / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no measured data at {folder}: set JAXQUAD_DATA to the folder that holds it")
    return folder


@pytest.fixture
def without_type_checks():
    """As in use: the tests check the types of all arguments, a user's Python does not."""
    before = jaxtyping.config.jaxtyping_disable
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", before)
