"""Programs of arrays alone, found by all else that is in the arguments, here or on the disk.

`eqx.filter_jit` takes arguments apart and puts results together in Python, each leaf by itself,
which takes as long as a flight of some hundred samples. And JAX finds a compiled program on the
disk by its operations, which it has to trace and lower first: for a loop and its derivative that
takes longer than all of its runs. Here the arguments' shapes and every number that is not an array
name the program, beside the source of jaxquad and the versions of what traces. Arguments with
anything of another's making have no such name: its source may change.
"""

import contextlib
import functools as ft
import hashlib
import io
import logging
import os
import pickle
import sys
import threading
import warnings
import weakref
import zlib
from collections import deque
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any

import equinox as eqx
import jax
import numpy as np
from jax.core import Tracer
from jax.experimental.serialize_executable import deserialize_and_load, serialize
from jax.extend.core import get_opaque_trace_state
from jaxtyping import Array, PyTree

from jaxquad._core import thread_settings

from ._door import brief_options, compiler_options, compilers, own_folder, warn_of_damage


Numbers = Array | np.ndarray
Options = Callable[[], dict[str, Any]]
Others = tuple[Any, ...]  # at the places of arrays None, else what is there, with its type
_MOST = 256  # programs of a function
_MOST_LOADED = 192  # compiled ones of the process: each takes up to 5 MB, and 49 of 65,530 maps
_ARRAYS = jax.Array, np.ndarray, np.generic  # as for `eqx.is_array`


class Jit:
    """`eqx.filter_jit` of a function that loops, with the compiler's options for loops.

    JAX takes options of an outermost jit only: within another, such as a user's, this one has none,
    and `compiler_options()` are there to be given to that one. What does not compile with kernels
    is compiled plain, with a warning.
    """

    def __init__(self, function: Callable[..., PyTree], options: Options = compiler_options):
        ft.update_wrapper(self, function)
        self._function, self._options = function, options
        self._programs = KeptPrograms(function, options)
        self._plain = eqx.filter_jit(function)
        self._met: set[tuple] = set()

    @ft.cached_property
    def brief(self) -> "Jit":
        """The same function, compiled with `brief_options`."""
        return self if self._options is brief_options else Jit(self._function, brief_options)

    def __call__(self, *args: PyTree) -> PyTree:
        return self.of_flat(args, *jax.tree.flatten(args))

    def of_flat(self, args: tuple, leaves: list, structure: PyTree) -> PyTree:
        """The same for arguments that the caller has taken apart."""
        if not _is_outermost(leaves):
            return self._plain(*args)
        kind = lambda: (self._function, str(structure), *map(_kind, _arrays_and_others(leaves)[0]))
        run = lambda: self._run(args, leaves, structure)
        return compilers().or_plain(self._function.__name__, kind, run)

    def _run(self, args: PyTree, leaves: list, structure: PyTree) -> PyTree:
        arrays, others = _arrays_and_others(leaves)
        try:
            with _Silence():  # errors of what runs are raised here
                return jax.block_until_ready(self._programs.of(structure, others)(arrays))
        except (jax.errors.JaxRuntimeError, ValueError) as error:
            if _RAISED not in str(error):
                raise
            return self._plain(*args)  # raises it with its own words, as equinox does

    def is_outermost(self, *args: PyTree) -> bool:
        """Whether a call with such arguments is no part of another program."""
        return _is_outermost(jax.tree.leaves(args))

    def is_new(self, *args: PyTree) -> bool:
        """Whether nobody has asked before for arguments that have the same program."""
        leaves, structure = jax.tree.flatten(args)
        arrays, others = _arrays_and_others(leaves)
        kind = structure, others, _kinds(arrays)
        is_new = kind not in self._met
        self._met.add(kind)
        return is_new


class KeptPrograms:
    """`function` of arrays and settings, by programs that can outlive the process."""

    def __init__(self, function: Callable[..., PyTree], options: Options):
        self.of = ft.lru_cache(_MOST)(ft.partial(_Program, function, options))

    def __call__(self, *args: PyTree) -> PyTree:
        leaves, structure = jax.tree.flatten(args)
        arrays, others = _arrays_and_others(leaves)
        return self.of(structure, others)(arrays)

    def of_arrays(
        self, fill: Callable[[Sequence[Any]], PyTree]
    ) -> Callable[[Sequence[Numbers]], PyTree]:
        """`function` of the arguments that `fill` makes of arrays.

        The arrays are in the order of the arguments' leaves.
        """
        program: list[_Program] = []

        def run(arrays: Sequence[Numbers]) -> PyTree:
            if not program:
                leaves, structure = jax.tree.flatten(fill(arrays))
                in_order, others = _arrays_and_others(leaves)
                if list(map(id, in_order)) != list(map(id, arrays)):
                    raise ValueError(
                        "the arrays are not those of the arguments' leaves, in their order"
                    )
                program.append(self.of(structure, others))
            return program[0](arrays)

        return run


def _arrays_and_others(leaves: Sequence[Any]) -> tuple[list[Any], Others]:
    arrays = [x for x in leaves if isinstance(x, _ARRAYS)]
    if len(arrays) == len(leaves):
        return arrays, ()
    return arrays, tuple([None if isinstance(x, _ARRAYS) else (type(x), x) for x in leaves])


def _together(arrays: Sequence[Any], others: Others) -> Sequence[Any]:
    rest = iter(arrays)
    return [next(rest) if x is None else x[1] for x in others] if others else arrays


@jax.tree_util.register_static
class _Form:
    """All of a result but its arrays."""

    def __init__(self, structure: PyTree, others: Others):
        self._structure, self._others = structure, others

    def filled(self, arrays: Sequence[Any]) -> PyTree:
        return jax.tree.unflatten(self._structure, _together(arrays, self._others))


_Call = Callable[[Sequence[Numbers]], PyTree]


class _Program:
    """Of all arguments of a structure and of some settings: one for each shape of the arrays."""

    def __init__(
        self, function: Callable[..., PyTree], options: Options, structure: PyTree, others: Others
    ):
        def run(arrays: Sequence[Any]) -> tuple[list[Any], _Form]:
            args = jax.tree.unflatten(structure, _together(arrays, others))
            leaves, form = jax.tree.flatten(function(*args))
            results, rest = _arrays_and_others(leaves)
            return results, _Form(form, rest)

        run.__name__ = function.__name__
        self._function, self._options, self._run = function, options, run
        self._settings = structure, others
        self.plain: Any = jax.jit(run, compiler_options=options() or None)
        self._compiled: dict[tuple, _Call] = {}
        self._lock = threading.Lock()

    def __call__(self, arrays: Sequence[Numbers]) -> PyTree:
        folder = _folder()
        if folder is None:
            return self._by_jit(arrays)
        kinds = _kinds(arrays)
        with self._lock:
            call = self._compiled.get(kinds)
            if call is None:
                call = self._compiled[kinds] = self._find(arrays, folder)
                _count_loaded(self, kinds)
        return call(arrays)

    def drop(self, kinds: tuple | None) -> None:
        """Forget a compiled program; None for those of `jax.jit`."""
        if kinds is None:
            self.plain.clear_cache()
        else:
            self._compiled.pop(kinds, None)

    def _find(self, arrays: Sequence[Numbers], folder: Path) -> _Call:
        """From the disk or the compiler; by `jax.jit` where it has no name."""
        structure, others = self._settings
        args = jax.tree.unflatten(structure, _together(arrays, others))
        name = _name(self._function, self._options(), args)
        if name is None:
            return self._by_jit
        path = folder / name
        program = _read(path, len(arrays)) if path.is_file() else None
        if program is not None:
            return program
        forms: list[_Form] = []

        def traced(arrays: Sequence[Any]) -> list[Any]:
            results, form = self._run(arrays)
            forms.append(form)
            return results

        traced.__name__ = _stem(name)  # JAX's own files of a program begin with it
        jit = jax.jit(traced, compiler_options=self._options() or None)
        lowered, [form, *_] = jit.lower(list(arrays)), forms
        _remove_of_jax(name)  # what JAX takes from its own files cannot be written again
        run = lowered.compile()
        _remove_of_jax(name)
        _write(path, run, form)
        return lambda arrays: form.filled(run(list(arrays)))

    def _by_jit(self, arrays: Sequence[Numbers]) -> PyTree:
        loaded = self.plain._cache_size()
        results, form = self.plain(arrays)
        if self.plain._cache_size() > loaded:
            _count_loaded(self, None)
        return form.filled(results)


_loaded: deque[tuple[weakref.ref[_Program], tuple | None]] = deque()  # the oldest first


def _count_loaded(program: _Program, kinds: tuple | None) -> None:
    """Count a program that was compiled or read; beyond the most, the oldest ones are dropped."""
    _loaded.append((weakref.ref(program), kinds))
    while len(_loaded) > _MOST_LOADED:
        with contextlib.suppress(IndexError):  # another thread has dropped it
            oldest, of_oldest = _loaded.popleft()
            if (owner := oldest()) is not None:
                owner.drop(of_oldest)
            while of_oldest is None and (oldest, None) in _loaded:  # it forgets all at once
                _loaded.remove((oldest, None))


def _is_outermost(leaves: list) -> bool:
    return get_opaque_trace_state() == _OUTSIDE and not any(isinstance(x, Tracer) for x in leaves)


with jax.ensure_compile_time_eval():  # whatever is traced while this is imported
    _OUTSIDE = get_opaque_trace_state()


_RAISED = "_EquinoxRuntimeError: "  # in the message of what `eqx.error_if` has raised
_CALLBACKS = logging.getLogger("jax._src.callback")


class _Silence:
    """JAX logs what a callback raises, beside raising it."""

    def __enter__(self) -> None:
        _CALLBACKS.addFilter(self)

    def __exit__(self, *_: object) -> None:
        _CALLBACKS.removeFilter(self)

    def filter(self, record: logging.LogRecord) -> bool:
        return False


def _folder() -> Path | None:
    """Where programs are kept; None without `enable_compile_cache`, and but for a single CPU."""
    folder = own_folder()
    alone = folder is not None and jax.default_backend() == "cpu" and jax.device_count() == 1
    return folder if alone else None


def _remove_of_jax(name: str) -> None:
    folder = jax.config.values["jax_compilation_cache_dir"]
    for path in Path(folder).glob(f"jit_{_stem(name)}-*") if folder else ():
        path.unlink(missing_ok=True)


def _stem(name: str) -> str:
    """The name of a function whose program is kept in the file of that name."""
    return name.removesuffix("-cache").replace("-", "_")


class _Place(int):
    """Of an array among a program's results."""


_CHECKSUM = 4  # bytes in front of what is stored
_LAPACK = "lapack_"  # in the names of its functions, which only a process that traces them loads


def _write(path: Path, run: jax.stages.Compiled, form: _Form) -> None:
    """The folder is this process's own; others get the file whole."""
    try:
        if _LAPACK in (run.as_text() or ""):
            return
        content, *_ = serialize(run)
        count = run.out_tree.num_leaves
        stored = pickle.dumps((content, count, form.filled([*map(_Place, range(count))])))
        path.write_bytes(zlib.crc32(stored).to_bytes(_CHECKSUM) + stored)
    except Exception as error:  # JAX calls its own interface experimental
        warnings.warn(f"a program is not kept for the next process: {error}", stacklevel=2)


def _read(path: Path, arguments: int) -> _Call | None:
    try:
        stored = path.read_bytes()
        if zlib.crc32(stored[_CHECKSUM:]).to_bytes(_CHECKSUM) != stored[:_CHECKSUM]:
            raise ValueError("it is damaged")
        content, count, result = pickle.loads(stored[_CHECKSUM:])
        taken = jax.tree.structure((([0] * arguments,), {}))
        results = jax.tree.structure([0] * count)
        run = deserialize_and_load(content, taken, results, None, jax.devices()[:1])
    except Exception:  # damaged, or of another making
        for place in (path, path.parent.parent / path.name):  # its own, and the shared one
            place.unlink(missing_ok=True)
        warn_of_damage()
        return None
    leaves, structure = jax.tree.flatten(result)
    others = tuple([None if isinstance(x, _Place) else (type(x), x) for x in leaves])
    form = _Form(structure, others)
    return lambda arrays: form.filled(run(list(arrays)))


def _kinds(arrays: Sequence[Numbers]) -> tuple:
    """What tells programs of the same settings apart."""
    return tuple(map(_kind, arrays)), thread_settings(), compilers().switches()


def _kind(array: Any) -> tuple:
    """Of an array, all but its numbers."""
    kind = jax.typeof(array)
    return kind.shape, kind.dtype, kind.weak_type


def _name(function: Callable[..., PyTree], options: dict, args: PyTree) -> str | None:
    """The file of a program; None where what it is traced from is not known by its name."""
    settings = sorted((k, v) for k, v in jax.config.values.items() if "cache" not in k)
    prefixes = ("XLA_", "JAXQUAD_K")
    environment = sorted((k, v) for k, v in os.environ.items() if k.startswith(prefixes))

    def written(leaf: object) -> object:
        """In words, for a file's name."""
        if not isinstance(leaf, _ARRAYS):
            return type(leaf), leaf
        shape, dtype, weak = _kind(leaf)
        return shape, str(dtype), weak

    kinds = jax.tree.map(written, args), thread_settings(), compilers().switches()
    what = kinds, sorted(options.items()), settings, environment
    with io.BytesIO() as file:
        try:
            _Known(file).dump((function.__module__, function.__qualname__, what))
        except (pickle.PickleError, AttributeError, TypeError):
            return None
        digest = hashlib.sha256(file.getvalue() + _makers())
    return f"traced-{function.__name__}-{digest.hexdigest()}-cache"


_TRACERS = ("jax", "jaxlib", "numpy", "equinox", "optimistix", "lineax")
_OURS = ("jaxquad", "jax", "jaxlib", "numpy", "equinox", "builtins", "collections", "copyreg")


class _Known(pickle.Pickler):
    """Pickles what is of jaxquad, or of what its programs are traced with; refuses all else."""

    def __init__(self, file: io.BytesIO):
        super().__init__(file)
        self.fast = True  # equal things read the same, whether they are one or two

    def persistent_id(self, obj: Any) -> str | None:
        return f"device {obj.id}" if isinstance(obj, jax.Device) else None

    def reducer_override(self, obj: Any) -> Any:
        home = getattr(obj if isinstance(obj, type | FunctionType) else type(obj), "__module__", "")
        if home.partition(".")[0] not in _OURS:
            raise pickle.PicklingError(f"{home} may change")
        return NotImplemented


@ft.cache
def _makers() -> bytes:
    """Of the source of jaxquad, and the versions of what programs are traced and compiled with."""
    source = Path(__file__).parents[1]
    digest = hashlib.sha256()
    for path in sorted(source.rglob("*.py")):
        digest.update(f"{path.relative_to(source)} {path.stat().st_size} ".encode())
        digest.update(path.read_bytes())
    versions = [version(name) for name in _TRACERS]
    digest.update(repr((sys.version, versions)).encode())
    return digest.digest()
