"""What a sampled record shows of a model whose input is held: its response with all aliases."""

import dataclasses
import functools as ft
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree

from jaxquad._core import Message, pytree_node
from jaxquad.models import (
    evaluate_response,
    feedthrough,
    imaginary,
    require_sampled,
    StateSpace,
    TransferFunction,
)
from jaxquad.spectra import FrequencyResponse

from ..output_error._simulated import (
    HasStateSpace,
    HasTransferFunction,
    linear_model,
    sample_interval,
)
from ._parameters import namespace_of, Numbers


_COUNTS = (16, 64, 256)  # aliases to either side
_NODES = (6, 12)  # frequencies between which the sum over the aliases is interpolated
_TRIED = 32  # frequencies at which the two are chosen
_TOLERANCE = 1e-8  # of the response, to which they are chosen
_TURNS = 32  # delays within a hold at which they are compared, for a fit may go to any
_FLAT = 0.3  # of the sum, over which its window stays at 1
_SECOND = 0.7  # length of a second window over that of the first
_WHOLE = 1e-9  # samples; a delay this close to whole samples is whole, whatever the rounding
_LEVEL = 0.5  # of a response over three octaves of aliases: it does not decay


@pytree_node
class Aliases:
    """How the response of a held input follows from a model's own at other frequencies.

    Held for h seconds each, the samples u[k] give a plant G the sampled response
    T(w) = sum_k G(j(w + k ws)) H(j(w + k ws)) / h, H(s) = (1 - e^(-s h)) / s, ws = 2 pi / h.
    The numerator of H is common to all terms; what is left of those with k other than 0 is smooth
    over the band, so that a few nodes carry it. What passes directly, D e^(-delay s), does not
    decay: it is taken out of the sum and shows as D z^-n, n = ceil(delay / h).
    Source: Franklin, Powell and Workman, "Digital Control of Dynamic Systems", 3rd ed., ch. 5.
    """

    direct: Complex[Numbers, " frequencies"]  # times G(jw)
    spread: Complex[Numbers, "frequencies nodes"]  # times the sum at each node
    upper: Float[Numbers, "nodes aliases"]  # rad/s
    lower: Float[Numbers, "nodes aliases"]  # rad/s, of the negative frequencies
    weights: Float[Numbers, " aliases"]  # of the sum
    hold: Float[Numbers, ""]  # s
    # n of the direct part, if there is one; delay / h + 1/2 where it is nan.
    samples: Float[Numbers, "outputs inputs"] | None = None
    # Whether the response stays level instead, and the model's kind does not tell its direct part.
    is_level: bool = eqx.field(static=True, default=False)

    @staticmethod
    def of_direct(hold: float, samples: Float[np.ndarray, "outputs inputs"]) -> "Aliases":
        """Without frequencies: the direct part alone, as a record in time shows it."""
        none, row = np.zeros((0, 0)), np.zeros(0)
        parts = (row.astype(complex), none.astype(complex), none, none, row, np.asarray(hold))
        return Aliases(*parts, samples=samples)

    @property
    def omega(self) -> Float[Numbers, " others"]:
        """All frequencies at which the model is needed beside those of the response, in rad/s."""
        both = [self.upper.reshape(-1), self.lower.reshape(-1)]
        return namespace_of(self.upper).concatenate(both)

    def total(
        self,
        direct: Complex[Numbers, "frequencies outputs inputs"],
        others: Complex[Numbers, "others outputs inputs"],
    ) -> Complex[Numbers, "frequencies outputs inputs"]:
        """The response, from the model's at the frequencies themselves and at `omega`."""
        columns = (1,) * (direct.ndim - 1)
        ratio = others / _imaginary(self.omega).reshape(-1, *columns)
        upper, lower = ratio[: len(ratio) // 2], ratio[len(ratio) // 2 :]
        terms = (upper + lower.conj()).reshape(*self.upper.shape, *direct.shape[1:])
        weights = self.weights.astype(terms.dtype).reshape(1, -1, *columns)
        at_nodes = (terms * weights).sum(1)
        aliased = self.spread @ at_nodes.reshape(len(at_nodes), -1)
        direct = self.direct.reshape(-1, *columns).astype(direct.dtype) * direct
        return direct + aliased.reshape(direct.shape)


def _imaginary(omega: Float[Numbers, "..."]) -> Complex[Numbers, "..."]:
    return 1j * omega if isinstance(omega, np.ndarray) else imaginary(omega)


def _aliases_at(omega, hold: float, count: int, nodes: np.ndarray | None = None) -> Aliases:
    """The aliases of all frequencies, or of the nodes between which they are interpolated."""
    at = (omega if nodes is None else nodes)[:, None]
    steps = 2 * np.pi / hold * np.arange(1, count + 1)[None]
    turn = (1 - namespace_of(omega).exp(-hold * _imaginary(omega))) / hold
    across = np.eye(len(omega))
    if nodes is not None:  # from values at the nodes to the polynomial through them
        middle, half = 0.5 * (nodes[-1] + nodes[0]), 0.5 * (nodes[-1] - nodes[0])
        basis = lambda x: np.polynomial.chebyshev.chebvander((x - middle) / half, nodes.size - 1)
        across = np.linalg.solve(basis(nodes).T, basis(np.asarray(omega)).T).T

    spread = turn[:, None] * across.astype(turn.dtype)
    parts = turn / _imaginary(omega), spread, at + steps, steps - at
    return Aliases(*parts, _weights(count), np.asarray(hold))


@ft.lru_cache
def _weights(count: int) -> Float[np.ndarray, " aliases"]:
    """Of a sum over so many aliases.

    A smooth end makes the rest of a sum that turns with a delay vanish faster than any power; of
    one that does not turn it is a series in 1 / count, of which two lengths cancel the first term
    (Richardson's extrapolation).
    """

    def window(place: Float[np.ndarray, " aliases"]) -> Float[np.ndarray, " aliases"]:
        """From 1 to 0 at 1, with all derivatives."""
        x = np.clip((place - _FLAT) / (1 - _FLAT), 0, 1)
        with np.errstate(divide="ignore", over="ignore"):
            rise, fall = np.exp(-1 / x), np.exp(-1 / (1 - x))
        return fall / (rise + fall)

    place = np.arange(1, count + 1) / (count + 1)
    return (window(place) - _SECOND * window(place / _SECOND)) / (1 - _SECOND)


def direct_part(
    model: PyTree,
) -> tuple[Float[Array, "outputs inputs"], Float[Array, "outputs inputs"]] | None:
    """The gain and the delay in s of what passes directly, as far as the model tells them."""
    kinds = TransferFunction | StateSpace | HasStateSpace | HasTransferFunction
    plant = linear_model(model) if isinstance(model, kinds) else None
    return feedthrough(plant) if isinstance(plant, TransferFunction | StateSpace) else None


def whole_samples(
    delay: Float[Numbers, "outputs inputs"], hold: float | Float[Numbers, ""]
) -> Float[Numbers, "outputs inputs"]:
    """After how many samples a held input shows directly; where it jumps, the value just after."""
    return namespace_of(delay).ceil(delay / hold - _WHOLE)


def _split_direct(model: PyTree, omega: Float[Array, " frequencies"]):
    """The response without its direct part, and that part."""
    response, direct = evaluate_response(model, omega), direct_part(model)
    if direct is None:
        return response, None
    return response - _late(*direct, omega), direct


def _late(
    gain: Float[Array, "outputs inputs"], delay: Float[Array, "outputs inputs"], omega: Array
) -> Complex[Array, "frequencies outputs inputs"]:
    """gain e^(-j omega delay)."""
    turned = omega[:, None, None] * delay[None]
    return jax.lax.complex(gain[None] * jnp.cos(turned), -gain[None] * jnp.sin(turned))


@eqx.filter_jit
def _evaluate(model, omega, others):
    return _split_direct(model, jnp.concatenate([omega, others]))


def plan_aliases(model: PyTree, frf: FrequencyResponse) -> Aliases:
    """As many aliases and as few nodes as the response of this model needs, and ones near it."""
    hold, omega = hold_of(frf), np.asarray(frf.omega)
    tried = omega[np.unique(np.linspace(0, omega.size - 1, _TRIED).round().astype(int))]
    enough = _enough(model, frf)
    aliases = _aliases_at(tried, hold, _COUNTS[1] if enough[1] else _COUNTS[2])
    response, passing = jax.tree.map(np.asarray, _evaluate(model, tried, aliases.omega))
    bad = ~np.isfinite(response).all(axis=tuple(range(1, response.ndim)))
    if bad.any():
        first = np.concatenate([tried, np.ravel(aliases.omega)])[int(np.argmax(bad))]
        raise ValueError(
            Message(
                "the response of the model is not finite at its starting values, first at "
                f"{first:.4g} rad/s: «start from other values»"
            )
        )
    direct, others = response[: tried.size], response[tried.size :]
    others = others.reshape(2, *aliases.upper.shape, *direct.shape[1:])

    def total(count: int, nodes: np.ndarray | None) -> np.ndarray:
        """The response from fewer aliases, and interpolated between some of the frequencies."""
        some = others[:, slice(None) if nodes is None else nodes, :count]
        plan = _aliases_at(tried, hold, count, None if nodes is None else tried[nodes])
        return np.asarray(plan.total(direct, some.reshape(-1, *direct.shape[1:])))

    samples = None if passing is None else np.asarray(whole_samples(passing[1], hold))
    top, middle = (np.abs(others[0, 0, k - 1]) for k in (_COUNTS[1], _COUNTS[1] // 8))
    is_level = passing is None and bool(np.any((top > _LEVEL * middle) & (middle > 0)))
    count = aliases.upper.shape[1]
    best = total(count, None)
    close = lambda *plan: bool(np.all(np.abs(total(*plan) - best) <= _TOLERANCE * abs(best)))
    if enough[0] and close(_COUNTS[0], None):
        count = _COUNTS[0]
    for number in _NODES if omega.size > _NODES[-1] else ():
        # The frequencies nearest to Chebyshev's points between the first and the last.
        points = np.cos(np.pi * (np.arange(number) + 0.5) / number)
        left = list(range(tried.size))
        for target in tried[0] + (tried[-1] - tried[0]) * (1 - points) / 2:
            left.remove(min(left, key=lambda k: abs(tried[k] - target)))
        nodes = np.setdiff1d(np.arange(tried.size), left)
        if close(count, nodes):
            plan = _aliases_at(omega, hold, count, tried[nodes])
            break
    else:
        plan = _aliases_at(omega, hold, count)
    return dataclasses.replace(plan, samples=samples, is_level=is_level)


def _enough(model: PyTree, frf: FrequencyResponse) -> list[bool]:
    """Whether so many aliases are, at whatever delay within a sample a fit may arrive: what they
    lack at the highest frequency, where it is most, is less than the random error of all."""
    highest, most = np.max(np.asarray(frf.omega), keepdims=True), _COUNTS[-1]
    aliases = _aliases_at(highest, hold_of(frf), most)
    response = np.asarray(_evaluate(model, highest, aliases.omega)[0])
    response = response.reshape(len(response), -1)
    above, below = (response[1:] / _imaginary(aliases.omega)[:, None]).reshape(2, most, -1)
    weights = np.stack([np.pad(_weights(n), (0, most - n)) for n in _COUNTS])[:, None]
    turns = weights * np.exp(
        -2j * np.pi / _TURNS * np.outer(np.arange(_TURNS), np.arange(1, most + 1))
    )
    sums = turns @ above + turns.conj() @ below.conj()  # count delay pair
    totals = aliases.direct * response[0] + aliases.spread[0, 0] * sums
    allowed = max(_typical_error(frf) / np.sqrt(len(frf.omega)), _TOLERANCE) * np.abs(totals[-1])
    return np.all(np.abs(totals - totals[-1]) <= allowed, axis=(1, 2)).tolist()


def _typical_error(frf: FrequencyResponse) -> float:
    error = np.asarray(frf.random_error)
    finite = error[np.isfinite(error)]
    return float(np.median(finite)) if finite.size else 0.0


def count_aliases(model: PyTree, frfs: Sequence[FrequencyResponse]) -> int:
    """How many aliases to either side the most precise of the responses needs, at any delay."""
    enough = _enough(model, min(frfs, key=_typical_error))
    return next((n for n, is_enough in zip(_COUNTS, enough, strict=True) if is_enough), _COUNTS[-1])


def evaluate_sampled(
    model: PyTree, omega: Float[Numbers, " frequencies"], aliases: Aliases | None
) -> Complex[Array, "frequencies outputs inputs"]:
    """A model's response as a sampled record shows it; without aliases its own."""
    omega = jnp.asarray(omega)
    if aliases is None:
        return evaluate_response(model, omega)
    everywhere = jnp.concatenate([omega, aliases.omega])
    if aliases.samples is None:
        both = evaluate_response(model, everywhere)
        return jnp.asarray(aliases.total(both[: omega.size], both[omega.size :]))
    both, direct = _split_direct(model, everywhere)
    assert direct is not None
    gain, late = direct
    total = jnp.asarray(aliases.total(both[: omega.size], both[omega.size :]))
    samples = jnp.where(jnp.isnan(aliases.samples), late / aliases.hold + 0.5, aliases.samples)
    return total + _late(gain, jnp.asarray(aliases.hold * samples), omega)


class SampledModel(eqx.Module):
    """A model as samples of it show it while its input is held, at any frequencies."""

    model: PyTree
    hold: float = eqx.field(static=True)  # s
    aliases: int = eqx.field(static=True, default=_COUNTS[0])  # to either side

    def frequency_response(
        self, omega: Float[Array, " frequencies"]
    ) -> Complex[Array, "frequencies outputs inputs"]:
        """At frequencies below half the sample rate."""
        omega, direct = jnp.asarray(omega), direct_part(self.model)
        samples = None if direct is None else whole_samples(direct[1], self.hold)
        aliases = _aliases_at(omega, self.hold, self.aliases)
        aliases = dataclasses.replace(aliases, samples=samples)
        return evaluate_sampled(self.model, omega, aliases)


def as_sampled(model: PyTree, frf: FrequencyResponse) -> PyTree:
    """The model whose frequency response is to be compared with a measured one.

    It is the model itself, or one whose response has the hold of the input and its aliases.
    """
    return behind_hold(model, hold_before(model, frf))


def behind_hold(model: PyTree, hold: float, aliases: int = _COUNTS[0]) -> PyTree:
    """The model behind an input that is held for `hold` s; itself for 0."""
    return SampledModel(model, hold, aliases) if hold else model


def hold_before(model: PyTree, frf: FrequencyResponse) -> float:
    """`hold_of` the response; 0 for a discrete model, which has it in it.

    Raises ValueError where such a model is of samples at another rate.
    """
    if (dt := sample_interval(model)) is None:
        return hold_of(frf)
    require_sampled(dt, samples=frf.dt or None, omega=np.asarray(frf.omega))
    return 0.0


def hold_of(frf: FrequencyResponse) -> float:
    """The hold in s that a model has to allow for; 0: none.

    What is held for several samples is held for each of them: the record shows the steps.
    """
    return min(frf.hold or 0.0, frf.dt)


def remarks_on_hold(
    model: PyTree, frfs: Sequence[FrequencyResponse], used: Sequence[Bool[np.ndarray, "..."]]
) -> list[Message]:
    """Remark on inputs of which nobody said how they are held, where it would show."""
    if sample_interval(model) is not None:
        return []
    for frf, mine in zip(frfs, used, strict=True):
        if frf.hold is not None or not frf.dt or not np.any(mine):
            continue
        # What a hold takes off the magnitude, beside a delay of half a sample.
        lost = (np.asarray(frf.omega) * frf.dt)[:, None, None] ** 2 / 24
        lost = np.broadcast_to(lost, mine.shape)
        over = np.where(mine, lost / np.maximum(np.asarray(frf.random_error), 1e-7), 0.0)
        k = np.unravel_index(np.argmax(over), over.shape)
        if over[k] > 1:
            omega = np.asarray(frf.omega)[k[0]]
            text = (
                "it is not known how long the input keeps each value: if it is held for a sample "
                f"({1e3 * frf.dt:.3g} ms), the gain is {100 * lost[k]:.2g} % too low at "
                f"{omega:.3g} rad/s ({omega / (2 * np.pi):.3g} Hz), {over[k]:.2g} times the random "
                "error, and the delay half a sample too long; give «hold=» in s, the loop's period "
                "for a command, 0 for a quantity that was measured« (jq.Record, jq.read)»"
            )
            return [Message(text, "hold")]
    return []
