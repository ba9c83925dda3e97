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

from ._parameters import Numbers
from ._problem import misfits, Problem


_FEW = 2000  # points times parameters: a tenth of a ms

Program = Callable[[list[Numbers]], tuple[Array, Array]]


class Evaluation(NamedTuple):
    """The misfits of a problem, as `misfits` lines them up, and their slopes by all parameters."""

    misfits: Float[np.ndarray, " residuals"]
    slopes: Float[np.ndarray, "all residuals"]


def evaluate(problem: Problem, *places: Float[np.ndarray, " parameters"]) -> list[Evaluation]:
    """Unweighted misfits and slopes at values of the free parameters, at all places in parallel.

    Records of equal shape share a program, whatever they are weighted by: compiling it takes longer
    than a fit.
    """
    programs, running = _programs(_Unweighted(problem)), []
    for z in places:
        z_all = np.array(problem.parameters.start)
        z_all[: z.size] = z
        running.append([run([z_all, *arrays]) for run, arrays in programs])
    evaluations, none = [], (np.zeros(0), np.zeros((problem.parameters.start.size, 0)))
    for records in running:
        parts = [(np.asarray(r), np.asarray(rows)) for r, rows in records]
        if len(parts) != 1:  # all records, one after the other
            all_misfits, slopes = zip(none, *parts, strict=True)
            parts = [(np.concatenate(all_misfits), np.concatenate(slopes, axis=1))]
        evaluations.append(Evaluation(*parts[0]))
    return evaluations


class _Unweighted:
    """A problem whatever its weights: equal where it was made once and weighted anew."""

    def __init__(self, problem: Problem):
        self.problem = problem
        self.ids = tuple(map(id, (problem.model, problem.measured, problem.parameters)))

    def __hash__(self) -> int:
        return hash(self.ids)

    def __eq__(self, other: object) -> bool:  # both hold their problems: no id is used again
        return isinstance(other, _Unweighted) and self.ids == other.ids


class Frame(NamedTuple):
    """A problem without its arrays: what a program is compiled for."""

    structure: PyTree
    rest: tuple[PyTree, ...]

    def filled(self, arrays: Sequence[Numbers]) -> PyTree:
        """The problem with these arrays."""
        left = iter(arrays)
        leaves = [next(left) if leaf is None else leaf for leaf in self.rest]
        return jax.tree.unflatten(self.structure, leaves)


def take_apart(problem: PyTree) -> tuple[Frame, list[Numbers]]:
    """What a program is compiled for, and the arrays that it is run with."""
    leaves, structure = jax.tree.flatten(problem)
    arrays = [leaf for leaf in leaves if eqx.is_array(leaf)]
    rest = tuple(None if eqx.is_array(leaf) else leaf for leaf in leaves)
    return Frame(structure, rest), arrays


@ft.lru_cache(maxsize=8)
def _programs(unweighted: _Unweighted) -> list[tuple[Program, list[Numbers]]]:
    parts = [(has_few_slopes(part), *take_apart(part)) for part in unweighted.problem.parts()]
    return [(_program(frame, few), arrays) for few, frame, arrays in parts]


@ft.lru_cache(maxsize=128)
def _program(frame: Frame, few: bool) -> Program:
    kept = _OF_FEW if few else _OF_MANY
    return kept.of_arrays(lambda arrays: (arrays[0], frame.filled(arrays[1:])))


def has_few_slopes(problem: Problem) -> bool:
    """Whether all slopes take less time than the optimisation of their program would."""
    points = sum(measured.size for measured in problem.measured)
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
