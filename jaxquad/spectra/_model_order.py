"""Search for the order of a rational model: poles are added one by one."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ._rational_fit import (
    cost_with_pole,
    descend,
    Equations,
    EXACT,
    make_basis,
    solve_linear,
    Solved,
)


_TRIAL = 1e-3  # relative gain of a step at which a descent ends
_PER_PARAMETER = 6  # real equations
_THOROUGH, _PATIENCE = 6, 4  # least order, and orders in a row no better, that end the search
_DOUBTED = 2  # orders in a row no better that end the search around an order
PRICE = 4.0  # of a parameter: Akaike's is 2, a Bayesian one ln(count), 7 to 8
_PLACES = 5  # at which one more pole is tried


class Orders(NamedTuple):
    """Solutions by their order, and the order of the least criterion; 0 where none explains."""

    solved: dict[int, Solved]
    best: int


def search_orders(equations: Equations, most: int) -> Orders:
    """From 0 upwards, each order from the one below with one pole more.

    Linear estimates of every order are no better places to begin: the noise draws their poles to
    the stability limit, or beyond it, and the last digit of a record chooses among them.
    """
    found = {0: solve_linear(equations, make_basis(equations, 1), np.ones(1))}
    _climb(equations, found, most, {}, _THOROUGH, _PATIENCE)
    return _judge(equations, found)


def refine_orders(equations: Equations, before: Orders, most: int) -> Orders:
    """Of the same equations in other weights: orders around the best one `before`."""
    first, known = before.best, before.solved
    found = {first: _descend(equations, known[first].denominator)}
    _climb(equations, found, most, known, first, _DOUBTED)
    for order in range(first - 1, 0, -1):
        found[order] = _descend(equations, known[order].denominator)
        if _judge(equations, found).best != order:
            break
    return _judge(equations, found)


def _climb(
    equations: Equations,
    found: dict[int, Solved],
    most: int,
    known: Mapping[int, Solved],
    thorough: int,
    patience: int,
) -> None:
    """Add orders to those `found` until too many in a row have no better criterion.

    `known` solutions, of other weights, are places to begin, too.
    """
    order, worse = max(found), 0
    least = _information(equations, found[order])
    while order < _most(equations, most) and not _is_exact(equations, found[order]):
        if worse >= patience and order >= thorough:
            break
        order += 1
        start = _start(equations, found[order - 1], known.get(order))
        found[order] = _descend(equations, start)
        value = _information(equations, found[order])
        worse, least = (0, value) if value < least else (worse + 1, least)


def next_order(equations: Equations, orders: Orders, most: int) -> Float[np.ndarray, " powers"]:
    """Where a descent of the order next above the best one begins: its new pole is at infinity.

    That is where half a sample of a delay is. The best order's where a higher one is too much, or
    where it leaves rounding alone.
    """
    best = orders.solved[orders.best]
    if orders.best >= _most(equations, most) or _is_exact(equations, best):
        return best.denominator
    return np.pad(best.denominator, (0, 1))


def _start(
    equations: Equations, below: Solved, known: Solved | None
) -> Float[np.ndarray, " powers"]:
    """The solution of the order below with a pole more, or the `known` one where it leaves less."""
    grown = _with_pole(equations, below)
    if known is None:
        return grown
    basis = make_basis(equations, grown.size)
    starts = known.denominator, grown
    return min(starts, key=lambda start: solve_linear(equations, basis, start).cost)


def _with_pole(equations: Equations, solved: Solved) -> Float[np.ndarray, " powers"]:
    """The denominator with a real pole more at that of a few places where it leaves least."""
    size = np.abs(equations.x)
    places = np.geomspace(np.min(size), np.max(size), _PLACES)
    basis = make_basis(equations, len(solved.denominator))
    costs = cost_with_pole(equations, basis, solved, places)
    return np.convolve(solved.denominator, [1.0, -1.0 / places[np.argmin(costs)]])


def _descend(equations: Equations, start: Float[np.ndarray, " powers"]) -> Solved:
    return descend(equations, make_basis(equations, start.size), start, _TRIAL)


def _most(equations: Equations, most: int) -> int:
    """The highest order, up to `most`, of which there are equations enough."""
    for order in range(1, most + 1):
        if equations.parameters(order) * _PER_PARAMETER > 2 * len(equations.y):
            return order - 1
    return most


def _judge(equations: Equations, solved: dict[int, Solved]) -> Orders:
    return Orders(solved, min(solved, key=lambda order: _information(equations, solved[order])))


def _information(equations: Equations, solved: Solved) -> float:
    count, order = 2 * len(equations.y), len(solved.denominator) - 1
    parameters = equations.parameters(order) if order else 1
    cost = max(solved.cost + 0.01 * _floor(equations), 1e-300)
    return count * np.log(cost / count) + PRICE * parameters


def _is_exact(equations: Equations, solved: Solved) -> bool:
    return solved.cost <= _floor(equations)


def _floor(equations: Equations) -> float:
    return EXACT * float(np.sum(np.abs(equations.y) ** 2))
