"""From the distributions of an ensemble to its members."""

from collections.abc import Callable, Sequence
from typing import Any, TYPE_CHECKING

import jax
import numpy as np
from jaxtyping import Array, Float, Key

from jaxquad._core import as_array, as_float, is_concrete
from jaxquad.loops import Loop

from ._distributions import Distribution, normal_scores, Shares
from ._members import count_axes, Drawn, MemberPayload, Members, multiply, plant_inertia, vary_plant


if TYPE_CHECKING:
    from ._ensemble import Ensemble


SAMPLINGS = ("latin", "random", "sobol", "grid")


def make_generator(key: Key[Array, ""]) -> np.random.Generator:
    """Random numbers of a key, outside JAX: nothing is compiled, and both precisions get the same.

    Raise ValueError under jit.
    """
    if not is_concrete(key):
        raise ValueError("members are drawn outside jit, vmap and grad: pass drawn members in")
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())


def make_member_keys(key: Key[Array, ""], members: int) -> Key[Array, " members"]:
    """A key for each member; more members leave the first ones' as they are."""
    random = make_generator(jax.random.fold_in(key, 1))
    words = random.integers(0, 2**32, (members, 2), dtype=np.uint32)
    # Other generators draw numbers under vmap that depend on how many members there are.
    return jax.random.wrap_key_data(as_array(words), impl="threefry2x32")


def draw_unit_points(sampling: str, key: Key[Array, ""], rows: int, members: int) -> Shares:
    """Probabilities, one row for each number that a member draws."""
    random = make_generator(key)
    if sampling == "sobol":
        return _sobol(random, rows, members)
    inside = random.random((rows, members))
    if sampling == "random":
        return inside
    cells = np.stack([random.permutation(members) for _ in range(rows)]) if rows else inside
    return (cells + inside) / members


def make_grid(distributions: Sequence[Distribution], members: int) -> Shares:
    """Every combination of equally many levels of each; the last one changes fastest.

    Raise ValueError where `members` is no such number.
    """
    if not distributions:
        return np.zeros((0, members))
    count = round(members ** (1 / len(distributions)))
    if count ** len(distributions) != members:
        below = int(members ** (1 / len(distributions)))
        near = " or ".join(str(k ** len(distributions)) for k in (below, below + 1))
        raise ValueError(
            f"a grid over {len(distributions)} quantities has equally many levels of each, so "
            f"{members} members do not fill one: draw {near}, or use "
            'sampling="latin" for any number'
        )
    levels = np.meshgrid(*(one.grid_levels(count) for one in distributions), indexing="ij")
    return np.stack([level.ravel() for level in levels])


def _sobol(random: np.random.Generator, rows: int, members: int) -> Shares:
    from scipy.stats import qmc

    if not rows:
        return np.zeros((0, members))
    # Whole powers of two are balanced; what is cut off is the end of a scrambled sequence.
    seeded: Any = {"seed": random}  # the name in SciPy 1.13, still taken by those that call it rng
    return qmc.Sobol(rows, **seeded).random_base2((members - 1).bit_length())[:members].T


Wide = Callable[[np.ndarray], Float[np.ndarray, "axes members"]]


def draw_members(
    ensemble: "Ensemble", loop: Loop, n: int, key: Key[Array, ""], sampling: str
) -> Members:
    """`n` members of an `Ensemble` around a `Loop`."""
    nominal, distributions = ensemble.resolve(loop)
    axes = count_axes(nominal)
    # How many numbers each distribution draws for a member.
    varying = {name: one for name, one in distributions.items() if one.varies}
    rows = {name: axes if name in ensemble.independent else 1 for name in varying}
    # Probabilities: of the distributions first, then of the posterior.
    if sampling == "grid":
        points = make_grid([varying[name] for name in rows for _ in range(rows[name])], n)
    else:
        deviates = 0 if ensemble.plants is None else ensemble.plants.deviates
        points = draw_unit_points(sampling, key, sum(rows.values()) + deviates, n)
    drawn = _values(distributions, rows, points, axes)
    wide: Wide = lambda x: np.broadcast_to(x if x.ndim > 1 else x[:, None], (axes, n))
    plant, delay = nominal, np.atleast_1d(np.asarray(loop.delay))
    longest = loop.longest_delay or float(np.max(delay))
    if ensemble.plants is not None:
        scores = normal_scores(points[sum(rows.values()) :])
        plant, delay, longest = ensemble.plants.draw(scores, loop.dt)
    if "delay" in distributions:
        delay, longest = drawn["delay"], _latest(distributions["delay"])
    believed = multiply(plant_inertia(nominal), drawn["inertia"])
    return Members(
        plant=vary_plant(plant, drawn),
        delay=as_float(wide(delay)[0]),
        assumed_inertia=as_float(wide(multiply(believed, drawn["assumed_inertia"]))),
        keys=make_member_keys(key, n),
        noise=as_float(wide(drawn["noise"])) if "noise" in distributions else None,
        gust=as_float(wide(drawn["gust"])) if "gust" in distributions else None,
        payload=_payload(plant_inertia(nominal), distributions, drawn, wide),
        drive=loop.drive,
        encoder=loop.encoder,
        longest_delay=longest,
        gust_corner=ensemble.gust_corner,
        dt=loop.dt,
        substeps=loop.substeps,
        bound=loop.bound,
    )


Given = dict[str, Distribution]


def _values(distributions: Given, rows: dict[str, int], points: Shares, axes: int) -> Drawn:
    """Of each quantity, [axes] where it is known and [axes, members] where it varies."""
    drawn, first = {}, 0
    for name, one in distributions.items():
        if not one.varies:
            drawn[name] = np.broadcast_to(one.support[0], (axes,))
            continue
        value = one.quantile(points[first : first + rows[name]])
        drawn[name] = np.broadcast_to(value, (axes, points.shape[1]))
        first += rows[name]
    return drawn


def _payload(
    nominal: Float[np.ndarray, "..."], distributions: Given, drawn: Drawn, wide: Wide
) -> MemberPayload | None:
    if "payload added" not in distributions:
        return None
    inertia = multiply(nominal, drawn["payload added"])
    at = wide(drawn["payload at"])[0]
    until = np.full(at.shape, np.inf)
    if "payload width" in distributions:
        until = at + wide(drawn["payload width"])[0]
    parts = (as_float(x) for x in (wide(inertia), at, until))
    return MemberPayload(*parts, latest=_latest(distributions["payload at"]))


def _latest(one: Distribution) -> float:
    return float(np.max(one.support[1]))
