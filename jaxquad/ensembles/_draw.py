"""From an ensemble's laws to its members."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Key

from jaxquad._core import as_float, is_concrete

from ._distributions import Law, scores, Shares
from ._members import Carried, Members
from ._variation import Drawn, plant_inertia, times, varied


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


Wide = Callable[[np.ndarray], Float[np.ndarray, "axes members"]]


def drawn_members(ensemble: Any, n: int, key: Key[Array, ""], sampling: str) -> Members:
    """`n` members of an `Ensemble`."""
    laws, axes = ensemble.laws, ensemble.axes
    rows = _rows(laws, ensemble.independent, axes)
    deviates = 0 if ensemble.fitted is None else ensemble.fitted.deviates
    points = _points(laws, rows, deviates, n, key, sampling)
    drawn = _values(laws, rows, points, axes)
    wide: Wide = lambda x: np.broadcast_to(x if x.ndim > 1 else x[:, None], (axes, n))
    plant, delay, longest = ensemble.plant, np.zeros(1), 0.0
    if ensemble.fitted is not None:
        plant, delay, longest = ensemble.fitted.plants(scores(points[sum(rows.values()) :]))
    if "delay" in laws:
        delay, longest = drawn["delay"], _latest(laws["delay"])
    believed = times(plant_inertia(ensemble.plant), drawn["inertia"])
    return Members(
        plant=varied(plant, drawn),
        delay=as_float(wide(delay)[0]),
        inertia_told=as_float(wide(times(believed, drawn["told"]))),
        keys=member_keys(key, n),
        noise=as_float(wide(drawn["noise"])) if "noise" in laws else None,
        gust=as_float(wide(drawn["gust"])) if "gust" in laws else None,
        payload=_carried(ensemble, laws, drawn, wide),
        drive=ensemble.drive,
        encoder=ensemble.encoder,
        longest_delay=longest,
        gust_corner=ensemble.gust_corner,
        dt=ensemble.dt,
    )


def _rows(laws: dict[str, Law], independent: tuple[str, ...], axes: int) -> dict[str, int]:
    """How many numbers each law draws for a member."""
    return {name: axes if name in independent else 1 for name, law in laws.items() if law.varies}


def _points(
    laws: dict[str, Law],
    rows: dict[str, int],
    deviates: int,
    n: int,
    key: Key[Array, ""],
    sampling: str,
) -> Shares:
    """Shares of the probability: of the laws first, then of the fit."""
    if sampling == "grid":
        return grid_points([laws[name] for name, count in rows.items() for _ in range(count)], n)
    return unit_points(sampling, key, sum(rows.values()) + deviates, n)


def _values(laws: dict[str, Law], rows: dict[str, int], points: Shares, axes: int) -> Drawn:
    """Of each quantity, [axes] where it is known and [axes, members] where it varies."""
    drawn, first = {}, 0
    for name, law in laws.items():
        if not law.varies:
            drawn[name] = np.broadcast_to(law.support[0], (axes,))
            continue
        value = law.quantile(points[first : first + rows[name]])
        drawn[name] = np.broadcast_to(value, (axes, points.shape[1]))
        first += rows[name]
    return drawn


def _carried(ensemble: Any, laws: dict[str, Law], drawn: Drawn, wide: Wide) -> Carried | None:
    if ensemble.payload is None:
        return None
    inertia = times(plant_inertia(ensemble.plant), drawn["payload added"])
    at = wide(drawn["payload at"])[0]
    until = np.full(at.shape, np.inf)
    if "payload width" in laws:
        until = at + wide(drawn["payload width"])[0]
    parts = (as_float(x) for x in (wide(inertia), at, until))
    return Carried(*parts, latest=_latest(laws["payload at"]))


def _latest(law: Law) -> float:
    return float(np.max(law.support[1]))
