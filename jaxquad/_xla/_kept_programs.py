"""Programs found on the disk by what they would be traced from.

JAX finds a compiled program by its operations, which it has to trace and lower first: for a loop
and its derivative that takes longer than all of its runs. Here the arguments' shapes and every
number that is not an array name the program, beside the source of jaxquad and the versions of what
traces. Arguments with anything of another's making have no such name: its source may change.
"""

import functools as ft
import hashlib
import io
import os
import pickle
import sys
import threading
import warnings
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from types import FunctionType
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize
from jaxtyping import Array, PyTree

from jaxquad._core import thread_settings

from ._compile_cache import own_folder
from ._switch import device_kernels, plain_loops


Numbers = Array | np.ndarray


class KeptPrograms:
    """`function` of arrays and settings, by programs that outlive the process."""

    def __init__(self, function: Callable[..., PyTree], options: Callable[[], dict]):
        self._function, self._options = function, options
        self._programs: dict[tuple, _Program | None] = {}
        self._begun: dict[tuple, _Lowered] = {}
        self._lock = threading.Lock()

    def begin(self, args: PyTree) -> bool:
        """Trace and lower the program for such arguments, unless it is there; False for None."""
        folder, options = _folder(), self._options()
        name = None if folder is None else _name(self._function, options, args)
        if folder is None or name is None:
            return False
        known = kind_of(args)
        with self._lock:
            if not ((folder / name).is_file() or known in self._programs or known in self._begun):
                self._begun[known] = _lowered(self._function, name, options, args)
        return True

    def find(self, args: PyTree) -> "_Program | None":
        """The program for such arguments, from memory, the disk or the compiler.

        None where programs are not kept, or have no name: `jax.jit` has to run them.
        """
        folder = _folder()
        if folder is None:
            return None
        known = kind_of(args)
        with self._lock:
            if known not in self._programs:
                self._programs[known] = self._made(args, self._begun.pop(known, None), folder)
            return self._programs[known]

    def of_arrays(
        self, fill: Callable[[Sequence[Any]], PyTree]
    ) -> Callable[[Sequence[Numbers]], PyTree]:
        """`function` of the arguments that `fill` makes of arrays, by a program of these alone.

        The arrays are in the order of the arguments' leaves.
        """
        function, programs = self._function, dict[tuple, _Program | None]()
        options = self._options()
        plain = jax.jit(lambda arrays: function(*fill(arrays)), compiler_options=options or None)

        def run(arrays: Sequence[Numbers]) -> PyTree:
            if _folder() is None:
                return plain(arrays)
            kinds = tuple(map(_kind, arrays))
            if kinds not in programs:
                programs[kinds] = self.find(_in_order(fill(arrays), arrays))
            program = programs[kinds]
            return plain(arrays) if program is None else program.of_arrays(arrays)

        return run

    def _made(self, args: PyTree, begun: "_Lowered | None", folder: Path) -> "_Program | None":
        options = self._options()
        name = _name(self._function, options, args)
        if name is None:
            return None
        program = _read(folder / name) if (folder / name).is_file() else None
        if program is None:
            lowered = begun or _lowered(self._function, name, options, args)
            program = _compiled(name, lowered)
            _write(folder / name, program)
        return program


def _in_order(args: PyTree, arrays: Sequence[Numbers]) -> PyTree:
    mine = [x for x in jax.tree.leaves(args) if eqx.is_array(x)]
    if len(mine) != len(arrays) or any(x is not y for x, y in zip(mine, arrays, strict=True)):
        raise ValueError("the arrays are not those of the arguments' leaves, in their order")
    return args


def _folder() -> Path | None:
    """Where programs are kept; None without `enable_compile_cache`, and but for a single CPU."""
    folder = own_folder()
    alone = folder is not None and jax.default_backend() == "cpu" and jax.device_count() == 1
    return folder if alone else None


class _Lowered(NamedTuple):
    program: jax.stages.Lowered  # of a list of arrays, for such a list
    result: PyTree  # with the places of its arrays in that list


class _Program(NamedTuple):
    run: jax.stages.Compiled
    result: PyTree

    def __call__(self, args: PyTree) -> PyTree:
        return self.of_arrays([x for x in jax.tree.leaves(args) if eqx.is_array(x)])

    def of_arrays(self, arrays: Sequence[Numbers]) -> PyTree:
        found = self.run(list(arrays))
        return jax.tree.map(lambda k: found[k], self.result)


def _compiled(name: str, lowered: _Lowered) -> _Program:
    """Compiled here and now: what JAX takes from its own files cannot be written again."""
    _remove_of_jax(name)
    program = lowered.program.compile()
    _remove_of_jax(name)
    return _Program(program, lowered.result)


def _remove_of_jax(name: str) -> None:
    folder = jax.config.values["jax_compilation_cache_dir"]
    for path in Path(folder).glob(f"jit_{_stem(name)}-*") if folder else ():
        path.unlink(missing_ok=True)


def _stem(name: str) -> str:
    """The name of a function whose program is kept in the file of that name."""
    return name.removesuffix("-cache").replace("-", "_")


def _lowered(function: Callable[..., PyTree], name: str, options: dict, args: PyTree) -> _Lowered:
    leaves, structure = jax.tree.flatten(args)
    result: list[PyTree] = []

    def run(arrays: list[Array]) -> list[Array]:
        given = iter(arrays)
        each = [next(given) if eqx.is_array(x) else x for x in leaves]
        found, shape = jax.tree.flatten(function(*jax.tree.unflatten(structure, each)))
        result.append(jax.tree.unflatten(shape, range(len(found))))
        return found

    run.__name__ = _stem(name)  # JAX's own files of a program begin with it
    arrays = [x for x in leaves if eqx.is_array(x)]
    program = jax.jit(run, compiler_options=options or None).lower(arrays)
    return _Lowered(program, result[0])


def kind_of(args: PyTree) -> tuple:
    """What tells apart the programs of a process."""
    leaves, structure = jax.tree.flatten(args)
    return structure, tuple(map(_kind, leaves)), thread_settings(), _switches()


_LAPACK = "lapack_"  # in the names of its functions, which only a process that traces them loads


def _write(path: Path, program: _Program) -> None:
    """The folder is this process's own; others get the file whole."""
    arrays = program.run.in_tree.num_leaves
    try:
        if _LAPACK in (program.run.as_text() or ""):
            return
        content, *_ = serialize(program.run)
        path.write_bytes(pickle.dumps((content, arrays, program.result)))
    except Exception as error:  # JAX calls its own interface experimental
        warnings.warn(f"a program is not kept for the next process: {error}", stacklevel=2)


def _read(path: Path) -> _Program | None:
    try:
        content, arrays, result = pickle.loads(path.read_bytes())
        taken = jax.tree.structure((([0] * arrays,), {}))
        given = jax.tree.structure([0] * len(jax.tree.leaves(result)))
        run = deserialize_and_load(content, taken, given, None, jax.devices()[:1])
    except Exception as error:  # damaged, or of another making
        warnings.warn(f"{path.name} cannot be read ({error}): it is compiled anew", stacklevel=2)
        return None
    return _Program(run, result)


def _kind(leaf: object) -> object:
    """What tells programs apart: of an array, all but its numbers."""
    if not eqx.is_array(leaf):
        return type(leaf), leaf
    known = jax.typeof(leaf)
    return known.shape, known.dtype, known.weak_type


def _written(leaf: object) -> object:
    """The same in words, for a file's name."""
    if not eqx.is_array(leaf):
        return _kind(leaf)
    known = jax.typeof(leaf)
    return known.shape, str(known.dtype), known.weak_type


def _switches() -> tuple:
    return plain_loops.value, device_kernels.value


def _name(function: Callable[..., PyTree], options: dict, args: PyTree) -> str | None:
    """The file of a program; None where what it is traced from is not known by its name."""
    settings = sorted((k, v) for k, v in jax.config.values.items() if "cache" not in k)
    told = sorted((k, v) for k, v in os.environ.items() if k.startswith(("XLA_", "JAXQUAD_K")))
    kinds = jax.tree.map(_written, args), thread_settings(), _switches()
    what = kinds, sorted(options.items()), settings, told
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
