"""Noise models of residuals: how much of a sample the samples before it predict."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float


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
        if not (0 <= self.poles <= LONGEST and 0 <= self.zeros <= LONGEST):
            raise ValueError(
                f"ARMA({self.poles}, {self.zeros}): give 0 to {LONGEST} poles and zeros, or "
                "jq.identify.AutoRegressive(order) for more poles"
            )


Noise = AutoRegressive | ARMA | Literal["auto"]
LONGEST = 8  # poles or zeros of an ARMA model


class NoiseModel(eqx.Module):
    """An estimated model of one output's noise: white shocks through numerator / denominator."""

    numerator: Float[np.ndarray, " zero_coefficients"]  # of 1, q^-1, q^-2, ...; begins with 1
    denominator: Float[np.ndarray, " pole_coefficients"]
    deviation: float  # standard deviation of the shocks, in units of the output

    @property
    def order(self) -> tuple[int, int]:
        """Poles and zeros."""
        return len(self.denominator) - 1, len(self.numerator) - 1


def shocks_of(
    v: Float[np.ndarray, " samples *columns"], model: NoiseModel
) -> Float[np.ndarray, " samples *columns"]:
    """What of each sample those before it do not predict; zero until `poles` samples are past."""
    from scipy.signal import lfilter

    known = np.asarray(lfilter(model.denominator, [1.0], v, axis=0))
    known[: model.order[0]] = 0.0
    return np.asarray(lfilter([1.0], model.numerator, known, axis=0))


def shock_slopes(
    v: Float[np.ndarray, " samples"], model: NoiseModel
) -> Float[np.ndarray, "samples coefficients"]:
    """Derivatives of the shocks by the coefficients: those of the poles, then of the zeros."""
    from scipy.signal import lfilter

    poles, zeros = model.order
    shocks = shocks_of(v, model)
    past = [_late(v, k + 1) for k in range(poles)] + [-_late(shocks, k + 1) for k in range(zeros)]
    columns = np.stack(past, axis=1) if past else np.zeros((len(v), 0))
    columns[:poles] = 0.0
    return np.asarray(lfilter([1.0], model.numerator, columns, axis=0)) if zeros else columns


def estimate_noise(v: Float[np.ndarray, " samples"], noise: Noise) -> NoiseModel:
    """The model of the wanted kind that leaves the least mean square of shocks.

    "auto" is that of lowest Akaike criterion of autoregressive ones and of a few with zeros.
    """
    if isinstance(noise, ARMA):
        return _with_zeros(v, noise.poles, noise.zeros)
    if isinstance(noise, AutoRegressive):
        return _autoregressive(v, noise.order)
    found = _autoregressive(v, None)
    if found.order[0] <= _FEW:
        return found
    more = [_with_zeros(v, count, count) for count in (1, 2, 3)]
    return min([found, *more], key=lambda model: _criterion(v, model))


_MOST = 40  # poles
_FEW = 2  # poles that no zeros make fewer
_ROWS = 8192  # at once


def _late(x: np.ndarray, samples: int) -> np.ndarray:
    return np.concatenate([np.zeros(samples), x[:-samples]])


def _criterion(v: np.ndarray, model: NoiseModel) -> float:
    """Akaike's, over samples that every model predicts."""
    rest = shocks_of(v, model)[min(_MOST, len(v) // 20) :]
    return len(rest) * float(np.log(np.mean(rest**2))) + 2 * sum(model.order)


def _autoregressive(v: Float[np.ndarray, " samples"], order: int | None) -> NoiseModel:
    most = min(_MOST, len(v) // 20) if order is None else order
    if most >= len(v) // 2:
        raise ValueError(
            f"a noise of order {most} cannot be estimated from {len(v)} samples: give a lower one"
        )
    root = _root_of_lags(v, most)
    left = np.cumsum(root[::-1, -1] ** 2)[::-1]  # of the squares, by orders 0, 1, ...
    if order is None:
        rows = len(v) - most
        order = int(np.argmin(rows * np.log(np.maximum(left, 1e-300)) + 2 * np.arange(most + 1)))
    past = np.linalg.lstsq(root[:order, :order], root[:order, -1], rcond=None)[0]
    return _with_deviation(v, np.ones(1), np.concatenate([np.ones(1), -past]))


def _root_of_lags(v: Float[np.ndarray, " samples"], most: int) -> Float[np.ndarray, "all all"]:
    """The triangular factor of the `most` samples before each, the latest first, and itself."""
    windows = np.lib.stride_tricks.sliding_window_view(v, most + 1)
    latest_first = [*range(most - 1, -1, -1), most]
    root = np.zeros((most + 1, most + 1))
    for at in range(0, len(windows), _ROWS):
        part = windows[at : at + _ROWS, latest_first]
        root = np.asarray(np.linalg.qr(np.concatenate([root, part]), mode="r"))
    return root


def _with_deviation(v: np.ndarray, numerator: np.ndarray, denominator: np.ndarray) -> NoiseModel:
    model = NoiseModel(numerator, denominator, 1.0)
    rest = shocks_of(v, model)[model.order[0] :]
    return NoiseModel(numerator, denominator, float(np.sqrt(np.mean(rest**2))))


_STEPS = 40  # of Gauss and Newton
_STILL = 1e-9  # relative change of the mean square that no longer matters


def _with_zeros(v: Float[np.ndarray, " samples"], poles: int, zeros: int) -> NoiseModel:
    """Gauss-Newton from Hannan and Rissanen's start.

    Source: Brockwell & Davis, Time Series: Theory and Methods, sec. 8.4 and 8.11.
    """
    if not zeros:
        return _autoregressive(v, poles)
    model = _first_with_zeros(v, poles, zeros)
    for _ in range(_STEPS):
        shocks = shocks_of(v, model)
        step = -np.linalg.lstsq(shock_slopes(v, model), shocks, rcond=1e-9)[0]
        better = _shorter_until_better(v, model, step)
        if better is None:
            return model
        still = better.deviation > (1 - _STILL) * model.deviation
        model = better
        if still:
            break
    return model


def _first_with_zeros(v: Float[np.ndarray, " samples"], poles: int, zeros: int) -> NoiseModel:
    """Least squares on past samples and on the shocks that a long autoregression finds."""
    shocks = shocks_of(v, _autoregressive(v, None))
    past = [_late(v, k + 1) for k in range(poles)] + [_late(shocks, k + 1) for k in range(zeros)]
    after = min(_MOST, len(v) // 20) + max(poles, zeros)
    found = np.linalg.lstsq(np.stack(past, axis=1)[after:], v[after:], rcond=1e-9)[0]
    return _assembled(v, np.concatenate([-found[:poles], found[poles:]]), poles)


def _shorter_until_better(
    v: Float[np.ndarray, " samples"], model: NoiseModel, step: np.ndarray
) -> NoiseModel | None:
    here = np.concatenate([model.denominator[1:], model.numerator[1:]])
    for halvings in range(12):
        there = _assembled(v, here + 0.5**halvings * step, model.order[0])
        if there.deviation < model.deviation:
            return there
    return None


def _assembled(v: np.ndarray, coefficients: np.ndarray, poles: int) -> NoiseModel:
    ones = np.ones(1)
    zeros = np.concatenate([ones, coefficients[poles:]])
    return _with_deviation(v, _invertible(zeros), np.concatenate([ones, coefficients[:poles]]))


def _invertible(
    numerator: Float[np.ndarray, " zero_coefficients"],
) -> Float[np.ndarray, " zero_coefficients"]:
    """Zeros outside the unit circle are reflected into it: the spectrum stays."""
    zeros = np.roots(numerator)
    outside = np.abs(zeros) > 1
    if not np.any(outside):
        return numerator
    found = np.real(np.poly(np.where(outside, 1 / zeros.conj(), zeros)))
    return np.concatenate([found, np.zeros(len(numerator) - len(found))])
