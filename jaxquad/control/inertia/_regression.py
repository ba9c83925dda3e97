from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Float


NUISANCES = ("offset", "rate", "angle")


class Sums(NamedTuple):
    """Weighted sums over the samples heard: products of the terms, and the score's own scatter."""

    products: Float[Array, " signals signals axes *ensemble"]
    recent: Float[Array, " axes *ensemble"]  # scores of the last moment
    scatter: Float[Array, " axes *ensemble"]  # long-run variance of the sum of scores


class Solution(NamedTuple):
    """A regression solved for the inertia alone."""

    inertia: Float[Array, " axes *ensemble"]  # kg m^2
    variance: Float[Array, " axes *ensemble"]  # (kg m^2)^2
    weight: Float[Array, " axes *ensemble"]  # samples that count
    informed: Float[Array, " axes *ensemble"]  # 1 where the acceleration stands out


def no_sums(signals: int, like: Float[Array, " axes *ensemble"]) -> Sums:
    zero = jnp.zeros_like(like)
    return Sums(jnp.zeros((signals, signals, *like.shape), like.dtype), zero, zero)


def require_nuisance(nuisance: tuple[str, ...]) -> None:
    unknown = set(nuisance) - set(NUISANCES)
    if unknown or len(set(nuisance)) != len(nuisance):
        raise ValueError(
            f"nuisance is {nuisance}: choose each of 'offset', 'rate' and 'angle' at most once"
        )


def learn(
    sums: Sums,
    terms: Float[Array, " signals axes *ensemble"],
    keep: Float[Array, " axes *ensemble"],
    *,
    nuisance: tuple[str, ...],
    excitation: float,
    forget: float,
    previous: Float[Array, " axes *ensemble"],
) -> tuple[Sums, Solution]:
    """The sums after one more sample, old ones weighted by `keep`, and what they say.

    The inertia is the regression of torque on acceleration beside the `nuisance` terms. Where the
    acceleration that they leave is below `excitation` in rad/s^2 rms the `previous` inertia stays.
    The scores x e of neighbouring samples are correlated, since both are filtered: the variance of
    their sum weighs pairs of samples by (1 - `forget`)^|k - l|.
    """
    products = keep[None, None] * sums.products + terms[:, None] * terms[None]
    own = _eliminate(products, terms, nuisance)
    weight = products[0, 0]
    floor = 64 * jnp.finfo(terms.dtype).eps * products[-2, -2]
    informed = own.square > jnp.maximum(weight * excitation**2, floor)
    inverse = _inverse(own.square, informed)
    inertia = jnp.where(informed, own.product * inverse, previous)
    score = own.acceleration * (own.torque - inertia * own.acceleration)
    recent = (1 - forget) * keep * sums.recent
    scatter = keep**2 * sums.scatter + score * (score + 2 * recent)
    variance = jnp.maximum(scatter, 0) * inverse**2
    solved = Solution(inertia, variance, weight, informed.astype(terms.dtype))
    return Sums(products, recent + score, scatter), solved


class _Own(NamedTuple):
    """What no nuisance term explains."""

    square: Array  # of the acceleration, summed
    product: Array  # with the torque, summed
    acceleration: Array  # at this sample
    torque: Array


def _eliminate(products, terms, nuisance):
    """Gauss' elimination of the nuisance terms, without pivoting: the matrix is definite.

    Entry by entry, which compiles to one pass over the ensemble.
    """
    a, u = len(terms) - 2, len(terms) - 1
    left = {(i, j): products[i, j] for i in range(len(terms)) for j in range(i, len(terms))}
    now = list(terms)
    pivots = [NUISANCES.index(name) for name in nuisance]
    for n, k in enumerate(pivots):
        row = {j: left[min(j, k), max(j, k)] for j in (*pivots[n + 1 :], a, u)}
        solid = left[k, k] > 64 * jnp.finfo(terms.dtype).eps * products[k, k]
        inverse = _inverse(left[k, k], solid)
        ratio = {j: x * inverse for j, x in row.items()}
        for i in row:
            now[i] = now[i] - ratio[i] * now[k]
        for i, j in left:
            if i in row and j in row:
                left[i, j] = left[i, j] - ratio[i] * row[j]
    return _Own(left[a, a], left[a, u], now[a], now[u])


def _inverse(x, safe):
    return jnp.where(safe, 1 / jnp.where(safe, x, 1), 0)
