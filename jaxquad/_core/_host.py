"""What needs no JAX: messages as values, numbers that a user gives, refused at once, by name and
with the remedy; files that are whole or not there, JSON; stages of the work; threads and cores.
"""

import contextlib
import functools as ft
import logging
import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import threadpoolctl
from numpy.typing import ArrayLike


class Message(str):
    """A text that is a value: it prints, joins and compares like any other string.

    **Arguments:**

    - `text`: words that belong to Python stand in guillemets: `"be interpolated («max_gap=»)"`.
      Another interface has its own for them. It looks them up by the words themselves, or by what
      stands before a bar: `"as «range|valid={'q': (-20, 20)}»"`.
    - `kind`: what it is about, for code that decides by it; the text is for readers alone.
    """

    marked: str  # with the guillemets
    kind: str

    def __new__(cls, text: str, kind: str = ""):
        marked = marked_text(text)
        self = super().__new__(cls, _replaced(marked, lambda term: term.rpartition("|")[2]))
        self.marked, self.kind = marked, kind or getattr(text, "kind", "")
        return self

    def __getnewargs__(self) -> tuple[str, str]:
        return self.marked, self.kind

    def in_words(self, word: Callable[[str], str]) -> "Message":
        """With the `word` of another interface for each term, which it gets with its key."""
        return Message(_replaced(self.marked, word), self.kind)


def _replaced(marked: str, word: Callable[[str], str]) -> str:
    texts = marked.replace("»", "«").split("«")
    return "".join(word(text) if k % 2 else text for k, text in enumerate(texts))


def marked_text(text: object) -> str:
    """A text, or what an error says, with its guillemets, to make another message of."""
    if isinstance(text, BaseException):
        text = text.args[0] if len(text.args) == 1 and isinstance(text.args[0], Message) else text
    return text.marked if isinstance(text, Message) else str(text)


def as_messages(texts: Iterable[str]) -> tuple[Message, ...]:
    """Each text as a message; what is one stays what it is."""
    return tuple(text if isinstance(text, Message) else Message(text) for text in texts)


def is_ours(kind: type[BaseException]) -> bool:
    """Whether a class of errors or warnings is the package's; those of NumPy, for one, are not."""
    return kind.__module__.partition(".")[0] == "jaxquad"


Number = float | int
Value = Number | ArrayLike  # of NumPy or JAX
_PLAIN = float | int | np.ndarray | np.generic


def is_concrete(x: object) -> bool:
    """Whether `x` has values to check, which a tracer under jit, vmap or grad has not."""
    if isinstance(x, _PLAIN):
        return True
    return not isinstance(x, _tracer())


@ft.cache
def _tracer() -> type:
    from jax.core import Tracer  # Designs and lists of channels need no JAX, nor its 0.3 s.

    return Tracer


def require_vector(name: str, value: Value, length: int) -> None:
    """Raise ValueError unless `value` is `[length]` or `[length, members]`."""
    shape = np.shape(value)
    if not shape or shape[0] != length:
        raise ValueError(
            f"{name} has shape {shape}, but it must be ({length},), or ({length}, members) "
            "for an ensemble: give one value for each axis."
        )


def require_finite(name: str, value: Value) -> None:
    """Raise ValueError for an inf or nan in `value`."""
    _require(name, value, np.isfinite, "finite", "look for the NaN or inf in it")


def require_positive(name: str, value: Value, remedy: str = "") -> None:
    """Raise ValueError unless all of `value` is above 0 and finite."""
    _require(name, value, lambda x: (x > 0) & np.isfinite(x), "above 0 and finite", remedy)


def require_nonnegative(name: str, value: Value, remedy: str = "") -> None:
    """Raise ValueError unless all of `value` is 0 or above, and finite."""
    _require(name, value, lambda x: (x >= 0) & np.isfinite(x), "0 or above and finite", remedy)


def require_all_positive(**values: Value) -> None:
    """`require_positive` for each of the named values."""
    for name, value in values.items():
        require_positive(name, value)


def require_all_nonnegative(**values: Value) -> None:
    """`require_nonnegative` for each of the named values."""
    for name, value in values.items():
        require_nonnegative(name, value)


def _require(
    name: str, value: Value, valid: Callable[[np.ndarray], np.ndarray], limit: str, remedy: str
) -> None:
    if is_concrete(value) and not np.all(valid(np.asarray(value))):
        text = f"{name} is {value}, but it must be {limit}"
        raise ValueError(f"{text}: {remedy}." if remedy else f"{text}.")


def require_band(omega_min: Number, omega_max: Number, sample_rate: Number) -> None:
    """Raise ValueError unless 0 < omega_min < omega_max < Nyquist (rad/s, Hz)."""
    require_all_positive(omega_min=omega_min, omega_max=omega_max, sample_rate=sample_rate)
    if omega_max <= omega_min:
        raise ValueError(
            f"omega_max {omega_max:.6g} rad/s is not above omega_min {omega_min:.6g} rad/s."
        )
    nyquist = np.pi * sample_rate
    if omega_max >= nyquist:
        raise ValueError(
            f"omega_max {omega_max:.6g} rad/s is not below {nyquist:.6g} rad/s, half the "
            f"sample_rate of {sample_rate:.6g} Hz: sample faster (25 times omega_max is the rule)."
        )


def whole_samples(name: str, seconds: Number, sample_rate: Number, *, fewest: int = 1) -> int:
    """The number of samples in `seconds`. Raises ValueError unless that is a whole number."""
    count = seconds * sample_rate
    if not np.isfinite(count):
        raise ValueError(f"{name} is {seconds} s at {sample_rate} Hz: it has to be finite.")
    rounded = round(count)
    if rounded < fewest or abs(count - rounded) > 1e-6:
        below = max(fewest, int(np.floor(count)))
        raise ValueError(
            f"{name} of {seconds:.9g} s is {count:.6g} samples at {sample_rate:.6g} Hz, not "
            f"a whole number of at least {fewest}: the nearest are {below / sample_rate:.9g} s and "
            f"{(below + 1) / sample_rate:.9g} s."
        )
    return rounded


STAGES = logging.getLogger("jaxquad.stages")


def announce(stage: str) -> None:
    """Log what begins now, at level INFO; the command line shows it on stderr."""
    STAGES.info(stage)


def write_file(path: str | Path, content: str | bytes) -> Path:
    """Write a file whole or not at all; it is on the disk when this returns.

    **Arguments:**

    - `path`: its folders are made as needed.
    - `content`: a text is encoded as UTF-8, as `readable` makes it.

    **Returns:** the path.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f"{path.name}.{os.getpid()}.part")
    try:
        with draft.open("wb") as file:
            file.write(readable(content).encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except BaseException as error:
        draft.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno:  # a full disk names no file
            error.filename = str(path)
        raise
    if os.name != "nt":  # a new name is on the disk only once its folder is
        folder = os.open(path.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
    return path


@contextlib.contextmanager
def staged_files(folder: Path) -> Iterator[Path]:
    """A folder of drafts whose files move to `folder` at the end of the `with`: all, or none."""
    new = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        draft = Path(tempfile.mkdtemp(prefix=".", suffix=".part", dir=folder))
        try:
            yield draft
            for path in sorted(draft.iterdir()):
                path.replace(folder / path.name)
        finally:
            shutil.rmtree(draft, ignore_errors=True)
    except BaseException as error:
        for path in new:
            with contextlib.suppress(OSError):  # it holds something else
                path.rmdir()
        if isinstance(error, OSError) and error.errno:
            error.filename = str(folder)
        raise


def readable(text: str) -> str:
    """A text without what UTF-8 cannot hold: bytes in the name of a file, half a pair in JSON."""
    if text.isascii():
        return text
    try:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace")
    except UnicodeEncodeError:
        return "".join("\ufffd" if "\ud800" <= x <= "\udfff" else x for x in text)


def plain_content(value: object) -> Any:
    """JSON's own types, with null for what is not finite, and texts as `readable` makes them."""
    if isinstance(value, float):  # first what there is most of
        return float(value) if math.isfinite(value) else None
    if isinstance(value, str):
        return readable(value)
    if value is None or isinstance(value, int):
        return value
    if isinstance(value, Mapping):
        return {readable(str(key)): plain_content(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain_content(item) for item in value]
    if hasattr(value, "__array__"):  # of NumPy or JAX
        return plain_content(np.asarray(value).tolist())
    return value


Item = TypeVar("Item")
Result = TypeVar("Result")


def map_in_threads(function: Callable[[Item], Result], items: Iterable[Item]) -> list[Result]:
    """`function` of each, on all cores, while the next ones are drawn from an iterator.

    One after the other where JAX is set differently for the caller's thread alone.
    """
    with ThreadPoolExecutor(max(available_cores(), 2)) as pool:
        if pool.submit(thread_settings).result() != thread_settings():
            return [function(x) for x in items]
        return list(pool.map(function, items))


def available_cores() -> int:
    """That this process may use."""
    try:
        return len(os.sched_getaffinity(0))
    except AttributeError:  # macOS, Windows
        return os.cpu_count() or 1


def default_device() -> Any:
    """The `jax.Device` on which programs run of which nobody says where."""
    import jax

    chosen = getattr(jax.config, "jax_default_device", None)
    return chosen if isinstance(chosen, jax.Device) else jax.local_devices()[0]


def free_memory(device: Any) -> float | None:
    """Of a `jax.Device` in bytes; of the host for a CPU, and of what a container may use of it."""
    if device.platform != "cpu":
        stats = device.memory_stats() or {}
        limit = stats.get("bytes_limit")
        return None if limit is None else float(limit - stats.get("bytes_in_use", 0))
    free: list[float] = []
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = Path("/proc/meminfo").read_text().splitlines()
        free.append(next(1024.0 * int(x.split()[1]) for x in lines if x.startswith("MemAvailable")))
    # Of all that the container may use ("max" without a limit) the page cache can be freed.
    with contextlib.suppress(OSError, ValueError):
        free.append(float(Path("/sys/fs/cgroup/memory.max").read_text()))
    return min(free, default=None)


def thread_settings() -> tuple[object, ...]:
    """Of JAX, those that change numbers or raise, and that a `with` can set for one thread."""
    import jax  # Batches and usage errors ask for cores without it.
    import jax.numpy as jnp

    config = jax.config  # makes its attributes while it is imported, which no type checker sees
    return (
        jnp.result_type(float),
        config.jax_default_device,  # pyright: ignore[reportAttributeAccessIssue]
        config.jax_default_matmul_precision,  # pyright: ignore[reportAttributeAccessIssue]
        config.jax_debug_nans,  # pyright: ignore[reportAttributeAccessIssue]
        config.jax_numpy_rank_promotion,  # pyright: ignore[reportAttributeAccessIssue]
        config.jax_numpy_dtype_promotion,  # pyright: ignore[reportAttributeAccessIssue]
    )


@contextlib.contextmanager
def one_blas_thread() -> Iterator[None]:
    """Within it, NumPy's and SciPy's BLAS has one thread, in the whole process.

    The environment's OPENBLAS_NUM_THREADS and its kin count only before NumPy is imported.
    """
    with _libraries().limit(limits=1, user_api="blas"):
        yield


@ft.cache  # to look for them takes as long as a small fit
def _libraries() -> threadpoolctl.ThreadpoolController:
    import scipy.linalg.lapack  # SciPy has a BLAS of its own, and only loaded ones are limited

    del scipy
    return threadpoolctl.ThreadpoolController()
