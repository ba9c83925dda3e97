"""Costs: weights on the logarithm of the ratio of model to measurement, and shared noise.

Points of a response that share noise count together: neighbours partly repeat one another.

So do pairs of output and input at one frequency: outputs share noise, and inputs that a narrow
window hardly tells apart share the outputs' noise. Whitened pair by pair along frequency, and then
at each frequency across pairs, estimates are nearly as sharp as under the whole covariance.

Under the inverse of their whole covariance the estimates would be the sharpest, but also trust
what the covariance says of the small differences between neighbours, which nobody knows: they
would follow any bias. So each point has a share of doubt, noise that it shares with none, as large
as that of all the points that it shares noise with.
"""

import dataclasses
import functools as ft
import itertools
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from jaxquad._core import Message, pytree_node
from jaxquad.spectra import DOMINATED, FrequencyResponse

from ._parameters import namespace_of, Numbers


_COHERENT, _POOR = 0.6, 0.05  # least coherence: in general, and beside coherent points
_ENOUGH = 5  # coherent points beside which poor ones count
_LARGEST = 0.3  # random error of a point that counts
_DB = 20 / np.log(10)  # dB to a unit of natural logarithm
_DECADE = 10.0
_PRECISE = 0.1  # random error that noise alone does not reach
_ALONE = 1.02  # sum of |rho|^2 below which all points of a pair count as independent
_W_g, _W_p = 1.0, 0.01745  # so that 1 dB weighs as much as 7.57 deg

Mask = Bool[np.ndarray, "frequencies outputs inputs"]
Ratio = Float[Numbers, "frequencies outputs inputs"]
Weights = Float[Numbers, "frequencies outputs inputs 2"]


def coherence_weight(gamma_squared: Float[Numbers, "..."]) -> Float[Numbers, "..."]:
    """Eq. (14), the weight of a point: W_gamma = [1.58 (1 - exp(-gamma^2))]^2.

    The paper prints it without the square. Source: docs/equations.md.
    """
    return (1.58 * (1 - namespace_of(gamma_squared).exp(-gamma_squared))) ** 2


def paper_cost(
    T: Complex[np.ndarray, " frequencies"],
    T_hat: Complex[np.ndarray, " frequencies"],
    gamma_squared: Float[np.ndarray, " frequencies"],
) -> float:
    """Eq. (14) for one response: J = 20/n_omega sum W_gamma [W_g (|T^| - |T|)^2 + W_p (angle)^2].

    `T` is the model's response and `T_hat` the measured one; magnitudes count in dB, phases in deg,
    W_g = 1 and W_p = 0.01745. `CoherenceWeighted` gives the fit the same cost as weights.
    The paper prints a minus before W_p. Source: Tischler & Remple, eq. 11.4; docs/equations.md.
    """
    decibels = 20 * np.log10(np.abs(T_hat) / np.abs(T))
    degrees = np.degrees(np.angle(T_hat / T))
    squares = _W_g * decibels**2 + _W_p * degrees**2
    return float(20 / T.size * np.sum(coherence_weight(gamma_squared) * squares))


@pytree_node
class Points:
    """The points of one measured response as a fit counts them.

    Neighbouring frequencies share part of their noise: `shared` is the sum of |rho|^2 of a point's
    error with those of all points used, so that `1 / shared` of it is the point's own.
    `correlations` has the complex rho of the points used of each pair that shares noise, by
    (output, input). `between` has that of the pairs at each frequency, output by output, where
    they share noise; of points that are not used, the identity.
    """

    frf: FrequencyResponse
    used: Mask  # the weights of the others have to be 0
    shared: Ratio
    floor: Ratio  # what the model leaves unexplained, in neper and rad; 0 before that is known
    correlations: Mapping[tuple[int, int], Complex[Numbers, "used used"]] = eqx.field(
        default_factory=dict
    )
    between: Complex[Numbers, "frequencies pairs pairs"] | None = None


@runtime_checkable
class Cost(Protocol):
    """How much each point of a response counts in a fit; any object with this method is one."""

    def weights(self, points: Points, ratio: Ratio) -> Weights:
        """Weights of `ln|T/T^|` and of `angle(T/T^)` in rad, on a last axis of two.

        `ratio` is |model / measurement|, 1 before there is a model. For derivatives of a fit it is
        an array of JAX, as is what they are taken by.
        """
        ...


@pytree_node
class CoherenceWeighted:
    """The cost of Eq. (14), `paper_cost`, summed over the responses (CIFER's).

    An average cost below 100 is acceptable, below 50 very good. It has no noise model: its
    estimates scatter 2 to 4 times as much as those of `MaximumLikelihood`, and
    `jq.identify.Prior`s need the latter.
    Source: Tischler & Remple, eq. 11.4; docs/equations.md says what the paper prints.
    """

    def weights(self, points: Points, ratio: Ratio) -> Weights:
        count = np.maximum(points.used.sum(axis=0, keepdims=True), 1)
        xp = namespace_of(ratio)
        W_gamma = coherence_weight(xp.asarray(points.frf.coherence))
        root = xp.where(points.used, np.sqrt(20 / count) * xp.sqrt(W_gamma), 0.0)
        units = np.sqrt(_W_g) * _DB, np.sqrt(_W_p) * np.degrees(1.0)
        return xp.stack([root * unit for unit in units], axis=-1)


@pytree_node
class MaximumLikelihood:
    """The likelihood of Gaussian noise: squared logarithm of the ratio over its random error.

    The random error is taken relative to the model: relative to the measurement, points that came
    out low by chance would weigh more, and points of a joint estimate whose denominator came out
    high. The logarithm is unbiased for circular noise. Points that
    share their noise with neighbours count by what is their own, and what the model leaves
    unexplained is a floor on the random error.
    """

    def weights(self, points: Points, ratio: Ratio) -> Weights:
        # 1e-7 keeps noise-free records from weights that overflow.
        # Where the model is off by far, as at the start, the measurement is the better guide.
        xp = namespace_of(ratio)
        off = xp.clip(ratio, 1 / 3, 3) ** -points.frf.error_exponent
        error = xp.maximum(xp.asarray(points.frf.random_error), 1e-7) * off
        with np.errstate(invalid="ignore"):  # an unknown response has an infinite error
            deviation = xp.hypot(error * xp.sqrt(points.shared), points.floor)
        root = xp.where(points.used, 1 / deviation, 0.0)
        return xp.stack([root, root], axis=-1)


def least_coherence(wanted: float | None, cost: Cost, frf: FrequencyResponse) -> float:
    """The least coherence of a point that counts: as `wanted`, or what is best for the cost."""
    if wanted is not None:
        return wanted
    # A cost that knows the noise weighs poor points as they deserve; others do without. So does the
    # joint estimate, a ratio, whose error is no longer small where coherence is; and so do the
    # direct estimate of a closed loop and a response that is coherent nowhere: what little they
    # show may be noise that is fed back.
    if not (isinstance(cost, MaximumLikelihood) and frf.method == "direct" and not frf.fed_back):
        return _COHERENT
    return _POOR if np.count_nonzero(usable(frf, None, _COHERENT)) >= _ENOUGH else _COHERENT


Range = tuple[float, float]
Band = Range | Mapping[tuple[str, str], Range | None] | None


def usable(frf: FrequencyResponse, band: Band, least: float) -> Mask:
    """Which points of a response a fit uses, with `band` as in `jq.fit`.

    Those within the band of their pair whose coherence, averaged over a third of an octave, is at
    `least` this, and whose random error, averaged likewise, is below 30 %. Not those whose error
    exceeds the response as sharper neighbours show it, as beyond the end of an excitation.
    """
    omega, error = np.asarray(frf.omega), np.asarray(frf.random_error)
    response = np.asarray(frf.response)
    kernel = _third_of_an_octave(omega.tobytes())
    mean = lambda values: (kernel @ values.reshape(len(values), -1)).reshape(values.shape)
    finite = np.isfinite(response) & np.isfinite(error)
    coherent = mean(np.asarray(frf.coherence)) >= least
    sharp = mean(np.fmin(error, 1.0)) <= _LARGEST
    chosen = finite & coherent & sharp
    poor = chosen & (error > _LARGEST)
    if np.any(poor):  # as sharper neighbours show the size of the response
        weights = (finite / np.fmax(error, 1e-3)) ** 2
        size = np.log(np.abs(response), out=np.zeros(error.shape), where=finite & (response != 0))
        around = mean(weights * size)[poor] / mean(weights)[poor]
        chosen[poor] = np.log(error[poor]) + size[poor] <= around

    def within(limits: Range | None) -> np.ndarray:  # annotations of shapes take time at each call
        low, high = limits or (0.0, np.inf)
        inside = (omega >= low) & (omega <= high)
        if not low < high or not np.any(inside):
            raise ValueError(
                f"band {limits} rad/s holds none of the response's frequencies, which run from "
                f"{omega[0]:.4g} to {omega[-1]:.4g} rad/s"
            )
        return inside

    if not isinstance(band, Mapping):
        return chosen & within(band)[:, None, None]
    inside, names = np.ones(error.shape, dtype=bool), (frf.output_names, frf.input_names)
    pairs = list(itertools.product(*names))
    for pair, limits in band.items():
        if pair not in pairs:
            raise ValueError(
                f"no response pair {pair!r} for a band: (output, input) is one of {pairs}"
            )
        o, i = (side.index(name) for side, name in zip(names, pair, strict=True))
        inside[:, o, i] = limits is not None and within(limits)
    return chosen & inside


@ft.lru_cache(maxsize=16)
def _third_of_an_octave(omega: bytes) -> Float[np.ndarray, "frequencies frequencies"]:
    """Weights of a mean around each frequency (the bytes of their array, rad/s). Choosing single
    points whose coherence came out high by chance would bias the fit."""
    place = np.log(np.frombuffer(omega))
    kernel = np.exp(-0.5 * ((place[:, None] - place[None, :]) / 0.2) ** 2)
    return kernel / kernel.sum(axis=1, keepdims=True)


def describe_usable(frfs: Sequence[FrequencyResponse], points: int, least: float) -> str:
    """How many frequencies are usable, in words."""
    total = sum(frf.response.size for frf in frfs)
    best = max(float(np.max(np.asarray(frf.coherence))) for frf in frfs)
    lowest = min(float(np.min(np.asarray(frf.random_error))) for frf in frfs)
    return (
        f"coherence reaches {least:g}, with a random error below {100 * _LARGEST:.0f} %, at "
        f"{points} of {total} frequencies (means over a third of an octave; the largest coherence "
        f"of one frequency is {best:.2f}, the smallest error {100 * lowest:.2g} %)"
    )


WIDER_BAND = "wider band"  # kind of a remedy


def widen_band(frfs: Sequence[FrequencyResponse], used: Sequence[Mask]) -> Message | None:
    """The advice to excite more than the band of the points `used`, with numbers. None where that
    is a decade or more, or nothing."""
    rows = [np.asarray(f.omega)[np.any(m, axis=(1, 2))] for f, m in zip(frfs, used, strict=True)]
    omega = np.concatenate(rows)
    if not omega.size or np.max(omega) >= _DECADE * np.min(omega):
        return None
    low, high = float(np.min(omega)), float(np.max(omega))
    hertz = lambda *ends: " to ".join(f"{end / (2 * np.pi):.3g}" for end in ends)
    in_both = lambda low, high: f"{low:.3g} to {high:.3g} rad/s ({hertz(low, high)} Hz)"
    return Message(
        f"excite the axis («jq.sweep») over more than {in_both(low, high)}, the band that counts "
        f"here: for instance {in_both(low, _DECADE * low)}",
        WIDER_BAND,
    )


def precise_points(frf: FrequencyResponse) -> Mask:
    """Points that have a response, each by its own random error: so small by no chance. None where
    feedback dominates: what is known there is the controller, and not the plant."""
    error = np.nan_to_num(np.asarray(frf.random_error), nan=1.0)
    dominated = any(remark.kind == DOMINATED for remark in frf.remarks)
    return np.isfinite(np.asarray(frf.response)) & (error <= _PRECISE) & (not dominated)


def points_of(frf: FrequencyResponse, used: Mask) -> Points:
    """The points of a response, with a floor of 0. Correlations are those of the errors relative to
    the response."""
    shared, correlations, errors = np.ones(used.shape), {}, frf.errors
    for o, i in np.ndindex(used.shape[1:]):
        mine = np.flatnonzero(used[:, o, i])
        # A bound method of an `eqx.Module` is made like a model.
        if type(errors).independent(errors, i, mine):
            continue
        covariance = type(errors).between(errors, (o, i), (o, i))[np.ix_(mine, mine)]
        size = np.sqrt(np.maximum(np.real(np.diagonal(covariance)), 1e-300))
        turn = np.exp(-1j * np.angle(np.asarray(frf.response)[mine, o, i])) / size
        correlation = turn[:, None] * covariance * turn.conj()
        sums = np.sum(correlation.real**2 + correlation.imag**2, axis=1)
        shared[mine, o, i] = np.maximum(sums, 1.0)
        if np.any(sums > _ALONE):
            correlations[o, i] = correlation
    points = Points(frf, used, shared, np.zeros(used.shape), correlations)
    if used[0].size == 1:
        return points
    covariance = type(errors).at_each_frequency(errors)
    mine, count = used.reshape(len(used), -1), used[0].size
    size = np.sqrt(np.maximum(np.real(np.diagonal(covariance, axis1=1, axis2=2)), 1e-300))
    response = np.where(used, np.asarray(frf.response), 1.0).reshape(len(used), -1)
    turn = np.exp(-1j * np.angle(response)) / size
    both = mine[:, :, None] & mine[:, None, :] & ~np.eye(count, dtype=bool)
    relative = turn[:, :, None] * covariance * np.conj(turn)[:, None, :]
    between = np.where(both, relative, np.eye(count, dtype=complex))
    sums = np.sum(np.real(between) ** 2 + np.imag(between) ** 2, axis=2)
    return dataclasses.replace(points, between=between) if np.any(sums > _ALONE) else points


_DOUBT = 0.3  # of the variance of a point's share in the noise of all points

Square = Complex[np.ndarray, "*members outputs inputs frequencies frequencies"]
Across = Complex[np.ndarray, "*members frequencies pairs pairs"]


class Mixing(NamedTuple):
    """How the weighted points of one response are taken together.

    The weighted misfits, magnitude as the real part and phase as the imaginary one, are multiplied
    by `factor` along frequency, and then by `across` at each frequency, output by output; both are
    triangular, and the identity where no noise is shared. `correlation` and `between` are those of
    the noise, relative to the response. A single pair has no `across`.
    """

    factor: Square
    correlation: Square
    across: Across | None = None
    between: Across | None = None
    idle: Bool[np.ndarray, ""] | None = None  # whether nothing is mixed, if programs are to ask


def mixing_of(points: Points, weights: Weights) -> Mixing | None:
    """Of the points of a response; `None` where they share no noise."""
    if not points.correlations and points.between is None:
        return None
    none, xp = unmixed(points.used.shape), namespace_of(weights)
    factor: Any = np.array(none.factor)
    correlation: Any = np.array(none.correlation)
    for (o, i), shared in points.correlations.items():
        mine = np.flatnonzero(points.used[:, o, i])
        # A floor on the error is shared with no other point.
        alone = xp.minimum((weights[mine, o, i, 0] * points.floor[mine, o, i]) ** 2, 1.0)
        size = xp.sqrt((1 - alone) / points.shared[mine, o, i])
        total = size[:, None] * shared * size + xp.diag(alone + _DOUBT)
        root = np.sqrt(1 + _DOUBT) * xp.linalg.inv(xp.linalg.cholesky(total))
        place = (o, i, mine[:, None], mine)
        factor, correlation = _placed(factor, place, root), _placed(correlation, place, shared)
    across: Any = none.across
    between: Any = none.between
    if points.between is not None:  # what whitens the pairs at each frequency
        alone = xp.minimum((weights[..., 0] * points.floor) ** 2, 1.0).reshape(len(weights), -1)
        size, identity = xp.sqrt(1 - alone), np.eye(alone.shape[1])
        total = size[:, :, None] * points.between * size[:, None, :]
        total = total + (alone + _DOUBT)[:, :, None] * identity
        across = np.sqrt(1 + _DOUBT) * xp.linalg.inv(xp.linalg.cholesky(total))
        between = points.between
    return Mixing(factor, correlation, across, between, np.array(False))


def _placed(array: Numbers, place: tuple, values: Numbers) -> Any:
    """`array` with these values in place."""
    if namespace_of(values) is not np:
        return jnp.asarray(array).at[place].set(values)
    assert isinstance(array, np.ndarray)
    array[place] = values
    return array


@ft.lru_cache(maxsize=8)
def unmixed(shape: tuple[int, ...]) -> Mixing:
    """The mixing of (frequencies, outputs, inputs) that share no noise: identities."""
    count, outputs, inputs = shape
    pairs, identity = outputs * inputs, np.eye(count, dtype=complex)
    along = np.broadcast_to(identity, (2, outputs, inputs, count, count))
    if pairs == 1:
        return Mixing(*along, idle=np.array(True))
    across = np.broadcast_to(np.eye(pairs, dtype=complex), (2, count, pairs, pairs))
    return Mixing(*along, *across, idle=np.array(True))


Columns = Float[np.ndarray, "*members frequencies outputs inputs 2 columns"]


def mix(mixing: Mixing | None, weighted: Columns, *, twice: bool = False) -> Columns:
    """Weighted misfits, or their slopes, taken together; `twice`: by the adjoints, too."""
    if mixing is None:
        return weighted
    joined = np.moveaxis(weighted[..., 0, :] + 1j * weighted[..., 1, :], -4, -2)
    shape = joined.shape

    def apply_across(across: Across, x: np.ndarray) -> np.ndarray:
        pairs = np.swapaxes(x.reshape(*shape[:-4], -1, *shape[-2:]), -3, -2)
        return np.swapaxes(across @ pairs, -3, -2).reshape(shape)

    flat = mixing.factor @ joined
    if mixing.across is not None:
        flat = apply_across(mixing.across, flat)
    if twice and mixing.across is not None:
        flat = apply_across(np.conj(np.swapaxes(mixing.across, -1, -2)), flat)
    if twice:
        flat = np.conj(np.swapaxes(mixing.factor, -1, -2)) @ flat
    turned = np.moveaxis(flat, -2, -4)
    return np.stack([np.real(turned), np.imag(turned)], axis=-2)


def mix_pair(
    mixing: Mixing,
    weighted: Float[np.ndarray, "*members frequencies 2 columns"],
    pair: tuple[int, int],
) -> Columns:
    """As `mix`, of what only one output and input has."""
    (o, i), (outputs, inputs) = pair, mixing.factor.shape[-4:-2]
    flat = mixing.factor[..., o, i, :, :] @ (weighted[..., 0, :] + 1j * weighted[..., 1, :])
    flat = flat[..., None, :]
    if mixing.across is not None:
        flat = mixing.across[..., o * inputs + i, None] * flat
    flat = flat.reshape(*flat.shape[:-2], outputs, inputs, -1)
    return np.stack([np.real(flat), np.imag(flat)], axis=-2)


def expected_cost(
    mixing: Mixing | None, sizes: Float[np.ndarray, "*members frequencies outputs inputs 2"]
) -> Float[np.ndarray, "*members outputs inputs"]:
    """What noise alone leaves of each pair's cost; `sizes` are weights times random errors.
    Whitened along frequency, pairs count as correlated at each frequency as before."""
    if mixing is None:
        return np.sum(sizes**2, axis=(-4, -1))
    size = np.moveaxis(sizes[..., 0], -3, -1)
    noise = size[..., :, None] * mixing.correlation * size[..., None, :]
    shaped = mixing.factor @ noise
    power = np.real(np.einsum("...fg,...fg->...f", shaped, np.conj(mixing.factor)))
    if mixing.across is None or mixing.between is None:
        return 2 * np.sum(power, axis=-1)
    power = np.moveaxis(power, -1, -3)
    deviation = np.sqrt(np.maximum(power, 0.0)).reshape(*power.shape[:-2], -1)
    noise = deviation[..., :, None] * mixing.between * deviation[..., None, :]
    left = np.sum(np.real(mixing.across @ noise * np.conj(mixing.across)), axis=(-3, -1))
    return 2 * left.reshape(*left.shape[:-1], *power.shape[-2:])


def mix_parts(
    mixing: Mixing | None,
    real: Float[Array, "*columns outputs inputs frequencies"],
    imag: Float[Array, "*columns outputs inputs frequencies"],
) -> tuple[Array, Array]:
    """As `mix`, in JAX, with frequencies last."""
    if mixing is None:
        return real, imag

    def times(matrix, indices: str, real: Array, imag: Array) -> tuple[Array, Array]:
        c, s = jnp.real(matrix), jnp.imag(matrix)
        turn = lambda matrix, part: jnp.einsum(indices, matrix, part)
        return turn(c, real) - turn(s, imag), turn(s, real) + turn(c, imag)

    def turned(real: Array, imag: Array) -> tuple[Array, Array]:
        along = times(mixing.factor, "oifg,...oig->...oif", real, imag)
        if mixing.across is None:
            return along
        shape = real.shape
        flat = (part.reshape(*shape[:-3], -1, shape[-1]) for part in along)
        real, imag = times(mixing.across, "fpq,...qf->...pf", *flat)
        return real.reshape(shape), imag.reshape(shape)

    if mixing.idle is None:
        return turned(real, imag)
    return jax.lax.cond(mixing.idle, lambda *same: same, turned, real, imag)
