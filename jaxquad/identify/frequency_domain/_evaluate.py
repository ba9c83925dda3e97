"""A problem's misfits and their slopes on the host, by a program for each kind of record."""

import functools as ft
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PyTree

from jaxquad._compile import evaluate_once, FEW, hasty_options, KeptPrograms

from ._mixing import mix_complex, Mixing
from ._parameters import Numbers
from ._problem import misfits, Problem


class Evaluation(NamedTuple):
    """The misfits of a problem, as `misfits` lines them up, and their slopes by all parameters."""

    misfits: Float[np.ndarray, " residuals"]
    slopes: Float[np.ndarray, "all residuals"]


def evaluate(problem: Problem, z: Float[np.ndarray, " parameters"]) -> Evaluation:
    """Unweighted misfits and slopes at values of the free parameters.

    Records of equal shape share a program, whatever they are weighted by: compiling it takes longer
    than a fit.
    """
    return start_each(problem, [z])()[0]


def start_each(
    problem: Problem, places: Sequence[Float[np.ndarray, " parameters"]]
) -> Callable[[], list[Evaluation]]:
    """The same at several places, begun at once and in parallel; what is returned waits for it."""
    programs, found = _programs(_Same(problem)), []
    for z in places:
        z_all = np.array(problem.parameters.start)
        z_all[: z.size] = z
        found.append([run([z_all, *arrays]) for run, arrays in programs])
    return lambda: [_joined(parts, problem.parameters.start.size) for parts in found]


def _joined(found: Sequence[tuple[Array, Array]], count: int) -> Evaluation:
    """Of all records, one after the other."""
    parts = [(np.asarray(r), np.asarray(rows)) for r, rows in found]
    if len(parts) == 1:
        return Evaluation(*parts[0])
    none = np.zeros(0), np.zeros((count, 0))
    misfits, slopes = zip(none, *parts, strict=True)
    return Evaluation(np.concatenate(misfits), np.concatenate(slopes, axis=1))


def as_residuals(
    problem: Problem, lined_up: Float[np.ndarray, "*columns residuals"]
) -> Float[np.ndarray, "*columns residuals"]:
    """Misfits, or their slopes, weighted and with points that share noise taken together."""
    parts, start = [], 0
    for weights, mixing in zip(problem.weights, problem.mixings, strict=True):
        part = lined_up[..., start : start + weights.size] * _in_line(np.asarray(weights))
        start += weights.size
        parts.append(part if mixing is None else _mixed(mixing, part, weights.shape))
    rest = lined_up[..., start:]
    return np.concatenate([*parts, rest], axis=-1) if len(parts) != 1 or rest.size else parts[0]


def _in_line(values: Float[np.ndarray, "frequencies outputs inputs 2"]) -> np.ndarray:
    return values.transpose(3, 1, 2, 0).reshape(-1)


def _mixed(mixing: Mixing, part: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    count, outputs, inputs, _ = shape
    both = part.reshape(-1, 2, outputs, inputs, count)
    joined = np.moveaxis(both[:, 0] + 1j * both[:, 1], 0, -1)
    turned = np.moveaxis(mix_complex(mixing, joined), -1, 0)
    return np.stack([np.real(turned), np.imag(turned)], axis=1).reshape(part.shape)


Program = Callable[[list[Numbers]], tuple[Array, Array]]


class _Same:
    """A problem whatever its weights: equal where it was made once and weighted anew."""

    def __init__(self, problem: Problem):
        self.problem = problem

    def _what(self) -> tuple[PyTree, ...]:
        return self.problem.model, self.problem.measured, self.problem.parameters

    def __hash__(self) -> int:
        return hash(tuple(map(id, self._what())))

    def __eq__(self, other: object) -> bool:
        pairs = zip(self._what(), other._what(), strict=True) if isinstance(other, _Same) else ()
        return isinstance(other, _Same) and all(mine is its for mine, its in pairs)


class Frame(NamedTuple):
    """A problem without its arrays: what a program is compiled for."""

    structure: PyTree
    rest: tuple[PyTree, ...]

    def filled(self, arrays: Sequence[Numbers]) -> PyTree:
        """The problem with these arrays."""
        given = iter(arrays)
        leaves = [next(given) if leaf is None else leaf for leaf in self.rest]
        return jax.tree.unflatten(self.structure, leaves)


def take_apart(problem: PyTree) -> tuple[Frame, list[Numbers]]:
    """What a program is compiled for, and the arrays that it is run with."""
    leaves, structure = jax.tree.flatten(problem)
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    rest = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
    return Frame(structure, rest), arrays


@ft.lru_cache(maxsize=8)
def _programs(same: _Same) -> list[tuple[Program, list[Numbers]]]:
    parts = [(has_few_slopes(part), *take_apart(part)) for part in same.problem.parts()]
    return [(_program(frame, few), arrays) for few, frame, arrays in parts]


@ft.lru_cache(maxsize=128)
def _program(frame: Frame, few: bool) -> Program:
    kept = _OF_FEW if few else _OF_MANY
    return kept.of_arrays(lambda arrays: (arrays[0], frame.filled(arrays[1:])))


_FEW = 2000  # points times parameters: a tenth of a ms


def has_few_slopes(problem: Problem) -> bool:
    """Whether all slopes take less time than the optimisation of their program would."""
    points = sum(each.size for each in problem.measured)
    return points * problem.parameters.start.size <= _FEW


def misfits_and_slopes(
    z: Float[Array, " all"], problem: Problem
) -> tuple[Float[Array, " residuals"], Float[Array, "all residuals"]]:
    """Those of an `Evaluation`, in JAX."""

    def along(z, change):
        return jax.jvp(lambda z: misfits(z, problem), (z,), (change,))

    everywhere = jax.vmap(along, in_axes=(None, 0), out_axes=(None, 0))
    return evaluate_once(everywhere, least=FEW)(z, jnp.eye(z.size, dtype=z.dtype))


_OF_FEW = KeptPrograms(misfits_and_slopes, hasty_options)
_OF_MANY = KeptPrograms(misfits_and_slopes, dict)
