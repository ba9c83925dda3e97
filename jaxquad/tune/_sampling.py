"""Points in the unit cube, from which laws make members."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Key

from jaxquad.models._parameters import is_concrete

from ._law import Law, Shares


SAMPLINGS = ("latin", "random", "sobol", "grid")


def generator(key: Key[Array, ""]) -> np.random.Generator:
    """Random numbers of a key, outside JAX: nothing is compiled, and both precisions get the same.

    Raises ValueError under jit.
    """
    if not is_concrete(key):
        raise ValueError("members are drawn outside jit, vmap and grad: pass drawn members in")
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())


def member_keys(key: Key[Array, ""], members: int) -> Key[Array, " members"]:
    """A key for each member; more members leave the first ones' as they are."""
    random = generator(jax.random.fold_in(key, 1))
    words = random.integers(0, 2**32, (members, 2), dtype=np.uint32)
    # Other generators draw numbers under vmap that depend on how many members there are.
    return jax.random.wrap_key_data(jnp.asarray(words), impl="threefry2x32")


def unit_points(sampling: str, key: Key[Array, ""], rows: int, members: int) -> Shares:
    """Shares of the probability, one row for each number that a member draws."""
    random = generator(key)
    if sampling == "sobol":
        return _sobol(random, rows, members)
    inside = random.random((rows, members))
    if sampling == "random":
        return inside
    cells = np.stack([random.permutation(members) for _ in range(rows)]) if rows else inside
    return (cells + inside) / members


def grid_points(laws: Sequence[Law], members: int) -> Shares:
    """Every combination of equally many levels of each law; the last law changes fastest.

    Raises ValueError where `members` is no such number.
    """
    if not laws:
        return np.zeros((0, members))
    count = round(members ** (1 / len(laws)))
    if count ** len(laws) != members:
        below = int(members ** (1 / len(laws)))
        near = " or ".join(str(k ** len(laws)) for k in (below, below + 1))
        raise ValueError(
            f"a grid over {len(laws)} quantities has as many levels of each, so {members} members "
            f'do not fill one: draw {near}, or use sampling="latin" for any number'
        )
    levels = np.meshgrid(*(law.levels(count) for law in laws), indexing="ij")
    return np.stack([each.ravel() for each in levels])


def _sobol(random: np.random.Generator, rows: int, members: int) -> Shares:
    from scipy.stats import qmc

    if not rows:
        return np.zeros((0, members))
    # Whole powers of two are balanced; what is cut off is the end of a scrambled sequence.
    seeded: Any = {"seed": random}  # the name in SciPy 1.13, still taken by those that call it rng
    return qmc.Sobol(rows, **seeded).random_base2((members - 1).bit_length())[:members].T
