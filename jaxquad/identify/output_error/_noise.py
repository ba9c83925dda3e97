"""Noise models of residuals, and what noise with a residual's spectrum does to combinations."""

import functools as ft
import itertools
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float, Int


class AutoRegressive(eqx.Module):
    """Noise in which each sample follows from the `order` samples before it and a white shock.

    Without an `order`, the one of lowest Akaike criterion up to 40.
    """

    order: int | None = eqx.field(static=True, default=None)

    def __check_init__(self):
        if self.order is not None and self.order < 0:
            raise ValueError(f"the order of the noise is {self.order}: give 0 (white) or more")


class ARMA(eqx.Module):
    """White shocks through a filter with `poles` poles and `zeros` zeros."""

    poles: int = eqx.field(static=True)
    zeros: int = eqx.field(static=True)

    def __check_init__(self):
        if not (0 <= self.poles <= _LONGEST and 0 <= self.zeros <= _LONGEST):
            raise ValueError(
                f"ARMA({self.poles}, {self.zeros}): give 0 to {_LONGEST} poles and zeros, or "
                "jq.identify.AutoRegressive(order) for more poles"
            )


Noise = AutoRegressive | ARMA | Literal["auto"]
Series = Float[np.ndarray, " samples"]
_LONGEST = 8  # poles or zeros of an ARMA model
_MOST = 40  # poles of an autoregressive one
_FEW = 2  # poles that no zeros make fewer
_ROWS = 8192  # at once
_STEPS = 40  # of Gauss and Newton
_STILL = 1e-9  # relative change of the mean square that no longer matters


class NoiseModel(eqx.Module):
    """An estimated model of one output's noise: white shocks through numerator / denominator."""

    numerator: Float[np.ndarray, " zero_coefficients"]  # of 1, q^-1, q^-2, ...; begins with 1
    denominator: Float[np.ndarray, " pole_coefficients"]
    deviation: float  # standard deviation of the shocks, in units of the output

    @property
    def order(self) -> tuple[int, int]:
        """Poles and zeros."""
        return len(self.denominator) - 1, len(self.numerator) - 1


WHITE = NoiseModel(np.ones(1), np.ones(1), 1.0)


def shocks_of(
    v: Float[np.ndarray, " samples *columns"], model: NoiseModel
) -> Float[np.ndarray, " samples *columns"]:
    """What of each sample those before it do not predict; zero until `poles` samples are past."""
    from scipy.signal import lfilter

    moving = np.asarray(lfilter(model.denominator, [1.0], v, axis=0))
    moving[: model.order[0]] = 0.0
    return np.asarray(lfilter([1.0], model.numerator, moving, axis=0))


def shock_slopes(v: Series, model: NoiseModel) -> Float[np.ndarray, "samples coefficients"]:
    """Derivatives of the shocks by the coefficients: those of the poles, then of the zeros."""
    from scipy.signal import lfilter

    poles, zeros = model.order
    shocks = shocks_of(v, model)
    past = [_late(v, k + 1) for k in range(poles)] + [-_late(shocks, k + 1) for k in range(zeros)]
    columns = np.stack(past, axis=1) if past else np.zeros((len(v), 0))
    columns[:poles] = 0.0
    return np.asarray(lfilter([1.0], model.numerator, columns, axis=0)) if zeros else columns


def estimate_noise(v: Series, noise: Noise) -> NoiseModel:
    """The model of the wanted kind that leaves the least mean square of shocks. "auto" is that of
    lowest Akaike criterion of autoregressive ones and of a few with zeros."""
    if isinstance(noise, ARMA):
        return _with_zeros(v, noise.poles, noise.zeros)
    if isinstance(noise, AutoRegressive):
        return _autoregressive(v, noise.order)
    model = _autoregressive(v, None)
    if model.order[0] <= _FEW:
        return model

    def akaike(model: NoiseModel) -> float:  # over samples that every model predicts
        rest = shocks_of(v, model)[min(_MOST, len(v) // 20) :]
        return len(rest) * float(np.log(np.mean(rest**2))) + 2 * sum(model.order)

    return min([model, *(_with_zeros(v, count, count) for count in (1, 2, 3))], key=akaike)


def _late(x: np.ndarray, samples: int) -> np.ndarray:
    return np.concatenate([np.zeros(samples), x[:-samples]])


def _autoregressive(v: Series, order: int | None) -> NoiseModel:
    most = min(_MOST, len(v) // 20) if order is None else order
    if most >= len(v) // 2:
        raise ValueError(
            f"a noise of order {most} cannot be estimated from {len(v)} samples: give a lower one"
        )
    # The triangular factor of the `most` samples before each, the latest first, and itself.
    windows = np.lib.stride_tricks.sliding_window_view(v, most + 1)
    latest_first = [*range(most - 1, -1, -1), most]
    root = np.zeros((most + 1, most + 1))
    for at in range(0, len(windows), _ROWS):
        part = windows[at : at + _ROWS, latest_first]
        root = np.asarray(np.linalg.qr(np.concatenate([root, part]), mode="r"))
    left = np.cumsum(root[::-1, -1] ** 2)[::-1]  # of the squares, by orders 0, 1, ...
    if order is None:
        rows = len(v) - most
        order = int(np.argmin(rows * np.log(np.maximum(left, 1e-300)) + 2 * np.arange(most + 1)))
    past = np.linalg.lstsq(root[:order, :order], root[:order, -1], rcond=None)[0]
    return _with_deviation(v, np.ones(1), np.concatenate([np.ones(1), -past]))


def _with_deviation(v: Series, numerator: np.ndarray, denominator: np.ndarray) -> NoiseModel:
    model = NoiseModel(numerator, denominator, 1.0)
    rest = shocks_of(v, model)[model.order[0] :]
    return NoiseModel(numerator, denominator, float(np.sqrt(np.mean(rest**2))))


def _with_zeros(v: Series, poles: int, zeros: int) -> NoiseModel:
    """Gauss-Newton from Hannan and Rissanen's start. Source: Brockwell & Davis, Time Series: Theory
    and Methods, sec. 8.4 and 8.11."""
    if not zeros:
        return _autoregressive(v, poles)
    # Least squares on past samples and on the shocks of a long autoregression.
    shocks = shocks_of(v, _autoregressive(v, None))
    past = [_late(v, k + 1) for k in range(poles)] + [_late(shocks, k + 1) for k in range(zeros)]
    after = min(_MOST, len(v) // 20) + max(poles, zeros)
    start = np.linalg.lstsq(np.stack(past, axis=1)[after:], v[after:], rcond=1e-9)[0]
    model = _assembled(v, np.concatenate([-start[:poles], start[poles:]]), poles)
    for _ in range(_STEPS):
        shocks = shocks_of(v, model)
        step = -np.linalg.lstsq(shock_slopes(v, model), shocks, rcond=1e-9)[0]
        here = np.concatenate([model.denominator[1:], model.numerator[1:]])
        shorter = (_assembled(v, here + 0.5**k * step, poles) for k in range(12))
        better = next((one for one in shorter if one.deviation < model.deviation), None)
        if better is None or better.deviation > (1 - _STILL) * model.deviation:
            return better or model
        model = better
    return model


def _assembled(v: Series, coefficients: np.ndarray, poles: int) -> NoiseModel:
    """Zeros outside the unit circle are reflected into it: the spectrum stays."""
    ones = np.ones(1)
    numerator = np.concatenate([ones, coefficients[poles:]])
    zeros = np.roots(numerator)
    outside = np.abs(zeros) > 1
    if np.any(outside):
        inside = np.real(np.poly(np.where(outside, 1 / zeros.conj(), zeros)))
        numerator = np.concatenate([inside, np.zeros(len(numerator) - len(inside))])
    return _with_deviation(v, numerator, np.concatenate([ones, coefficients[:poles]]))


class Whitener(eqx.Module):
    """`shocks_of` as a convolution: noise models of any order make arrays of the same shapes."""

    spectrum: Complex[Array, "bins outputs"]  # of the filter from rest
    memory: Float[Array, "samples heads outputs"]  # what the first samples left in that filter
    start: Int[Array, " outputs"]  # the first sample that is predicted
    length: int = eqx.field(static=True)

    def __call__(
        self, x: Float[Array, "samples outputs *columns"]
    ) -> Float[Array, "samples outputs *columns"]:
        """The part of `x` that its past does not predict, output by output."""
        ones = (1,) * (x.ndim - 2)
        transform = jnp.fft.rfft(x, self.length, axis=0)
        spectrum = self.spectrum.reshape(*self.spectrum.shape, *ones)
        rest = jnp.fft.irfft(transform * spectrum, self.length, axis=0)[: len(x)]
        rest -= jnp.einsum("tho,ho...->to...", self.memory, x[: self.memory.shape[1]])
        predicted = jnp.arange(len(x))[:, None] >= self.start[None]
        return jnp.where(predicted.reshape(*predicted.shape, *ones), rest, 0.0)


def make_whitener(models: Sequence[NoiseModel], samples: int) -> Whitener:
    """The whitener of a record's outputs; shocks keep their size."""
    from scipy.fft import next_fast_len
    from scipy.signal import lfilter

    length = int(next_fast_len(2 * samples, real=True) or 2 * samples)
    heads = np.eye(samples, min(_LONGEST, samples))
    spectra, memories = [], []
    for model in models:
        from_rest = np.asarray(lfilter(model.denominator, model.numerator, heads, axis=0))
        spectra.append(np.fft.rfft(from_rest[:, 0], length))
        memories.append(from_rest - shocks_of(heads, model))
    return Whitener(
        jnp.asarray(np.stack(spectra, axis=1)),
        jnp.asarray(np.stack(memories, axis=2)),
        jnp.asarray([model.order[0] for model in models]),
        length,
    )


_LEAST = 4  # of the record's own frequencies on either side that are averaged into one
_SHARE = 0.1  # of the frequency, as far as the average reaches above that
_FLOOR = 0.05  # of a frequency that the fit leaves to the noise, at least


def projected_noise(
    columns: Float[np.ndarray, "samples outputs columns"],
    residual: Float[np.ndarray, "samples outputs"],
    nuisance: Float[np.ndarray, "samples outputs unknowns"],
    count: int,
) -> Float[np.ndarray, "columns columns"]:
    """Covariance of `columns`' v, for noise v with the spectrum of the residual.

    The spectrum is the residual's periodogram, averaged over neighbouring frequencies, with what
    the fit took out of it put back: orthonormal are the first `count` columns and the `nuisance`.
    Source: Klein & Morelli, Aircraft System Identification, sec. 6.3, with the residual's
    spectrum in place of its autocorrelation.
    """
    from scipy.fft import next_fast_len, rfft

    samples, outputs = residual.shape
    length = int(next_fast_len(2 * samples, real=True) or 2 * samples)
    turn = lambda series: np.asarray(rfft(series, length))
    rest, driven, smooth, left = [], [], [], []
    windows = _windows(length // 2 + 1, length / samples)
    for o in range(outputs):
        driven.append(turn(columns[:, o].T))
        others = turn(np.vstack([residual[:, o], nuisance[:, o].T]))
        rest.append(others[0])
        taken = _power(driven[o][:count]) + _power(others[1:])
        smooth.append(_averaged(_power(others[:1]) / samples, windows))
        left.append(np.sqrt(np.maximum(1 - _averaged(taken / samples, windows), _FLOOR)))
    twice = np.full(length // 2 + 1, 2.0 / length)
    twice[0] = 1.0 / length
    twice[-1] /= 2.0 if length % 2 == 0 else 1.0
    total = np.zeros((columns.shape[2],) * 2)
    # The real part of a sum of conj(weight one) other over the bins.
    product = lambda one, weight, other: (weight * one).view(float) @ other.view(float).T
    for o in range(outputs):
        total += product(driven[o], twice * smooth[o] / left[o] ** 2, driven[o])
    for i, j in itertools.permutations(range(outputs), 2):
        cross = _averaged(rest[i].conj() * rest[j] / samples, windows)
        total += product(driven[i], twice * cross / (left[i] * left[j]), driven[j])
    return 0.5 * (total + total.T)


def _power(spectra: Complex[np.ndarray, "series bins"]) -> Float[np.ndarray, " bins"]:
    """The sum of their squares."""
    parts = spectra.view(float)
    squares = np.einsum("sp,sp->p", parts, parts)
    return squares[::2] + squares[1::2]


def orthonormal(
    columns: Float[np.ndarray, "samples outputs columns"],
) -> Float[np.ndarray, "samples outputs columns"]:
    """An orthonormal basis of what the columns span over all samples and outputs."""
    flat = columns.reshape(-1, columns.shape[2])
    scale = np.sqrt([column @ column for column in flat.T])
    shows = scale > 1e-12 * np.max(scale, initial=0.0)
    if not np.all(shows):
        flat = flat / np.where(shows, scale, np.inf)
    return np.linalg.qr(flat)[0].reshape(columns.shape)


@ft.lru_cache(maxsize=8)
def _windows(bins: int, finer: float) -> tuple[np.ndarray, np.ndarray, int]:
    """Of a moving mean in a mirrored spectrum: first bins, those after the last, bins mirrored."""
    reach = np.ceil(np.maximum(_LEAST * finer, _SHARE * np.arange(bins))).astype(int)
    furthest = min(int(reach.max()), bins - 1)
    reach, centre = np.minimum(reach, furthest), np.arange(bins) + furthest
    return centre - reach, centre + reach + 1, furthest


def _averaged(x: np.ndarray, windows: tuple[np.ndarray, np.ndarray, int]) -> np.ndarray:
    """The mean over the windows around each bin, mirrored at the ends."""
    start, stop, furthest = windows
    mirrored = np.concatenate([x[furthest:0:-1].conj(), x, x[-2 : -furthest - 2 : -1].conj()])
    sums = np.concatenate([np.zeros(1, x.dtype), np.cumsum(mirrored)])
    return (sums[stop] - sums[start]) / (stop - start)
