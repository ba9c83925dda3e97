"""How much of an input's power comes from an output, by a joint autoregressive model of both."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float


Signals = Float[np.ndarray, "2 samples"]  # output, input
Grid = Float[np.ndarray, " frequencies"]

_ORDER = 12  # samples of both that the model remembers
_ENOUGH = 20 * _ORDER  # samples for a model
_LEVELS = (16.0, 4.0, 2.0, 1.0)  # half the sample rate over the highest frequency of interest
_ROUNDING = 1e-9  # of a signal's power, added as white noise: what rounding may make
_SEEN = 0.5  # of the largest median share, at the highest rate
_EXACT = 1e-7  # of its power: new parts of the output below it say nothing


class Share(NamedTuple):
    """Of the input's power at each frequency, that which the output's innovations make.

    Innovations are what the past of both signals does not predict. What both have in common at one
    sample counts as the output's in `output_first`, because a plant takes time to answer, and as
    the input's in `input_first`, because a logger may write an answer beside its cause.
    """

    output_first: Grid
    input_first: Grid


def share_from_output(
    records: Sequence[Float[np.ndarray, "2 _samples"]], dt: float, omega: Grid
) -> Share:
    """The directed share of Geweke (1982); zero where the records are too short for a model.

    At which sample rate innovations tell a loop's directions apart depends on its noise: of several
    rates, the one with the largest median counts. At a rate so slow that a plant answers within one
    sample, it can be mistaken for its controller: the highest rate has to show half of it, too.

    **Arguments:**

    - `records`: output and input, sampled every `dt` seconds.
    - `omega`: frequencies in rad/s, increasing.
    """
    prepared, found = _standardised(records), [Share(np.zeros(omega.size), np.zeros(omega.size))]
    for every in _decimations(dt, float(omega[-1])):
        slow = [_decimated(x, every) for x in prepared if x.shape[1] >= 2 * _ORDER * every]
        if sum(x.shape[1] - _ORDER for x in slow) < _ENOUGH:
            continue
        found.append(_share_at(_products(slow), omega * dt * every))
    best, quickest = max(found, key=_median), found[min(1, len(found) - 1)]
    return best if _median(quickest) > _SEEN * _median(best) else quickest


def _median(share: Share) -> float:
    return float(np.median(share.output_first))


def _decimations(dt: float, highest: float) -> Iterator[int]:
    ratios = [max(int(np.pi / (dt * level * highest)), 1) for level in _LEVELS]
    yield from dict.fromkeys(ratios)


def _standardised(records: Sequence[Float[np.ndarray, "2 _samples"]]) -> list[Signals]:
    """Without offset and trend, in units of the standard deviation."""
    flat = [_without_trend(x) for x in records]
    squares = sum(np.einsum("cs,cs->c", x, x) for x in flat)
    size = np.sqrt(squares / sum(x.shape[1] for x in flat))
    return [x / np.maximum(size, 1e-300)[:, None] for x in flat]


def _without_trend(x: Signals) -> Signals:
    time = np.linspace(-1.0, 1.0, x.shape[1])
    slope = x @ time / (time @ time)
    return x - np.mean(x, axis=1, keepdims=True) - slope[:, None] * time


def _decimated(x: Signals, every: int) -> Float[np.ndarray, "2 fewer"]:
    """Every so many samples, of what lies below half the new rate."""
    if every == 1:
        return x
    count = x.shape[1] // every
    return np.fft.irfft(np.fft.rfft(x[:, : count * every])[:, : count // 2 + 1], count)


def _products(records: Sequence[Float[np.ndarray, "2 _samples"]]) -> Float[np.ndarray, "lags lags"]:
    """Mean products of the present and past samples of both, with white noise of rounding."""
    total = sum(_sums_of_products(x) for x in records)
    total = total / sum(x.shape[1] - _ORDER for x in records)
    return total + _ROUNDING * np.diag(np.tile(np.diag(total)[:2], _ORDER + 1))


def _sums_of_products(x: Signals) -> Float[np.ndarray, "lags lags"]:
    """Of x[t - i] and x[t - j] over t: by their distance, but for samples at the record's ends."""
    n, p = x.shape[1], _ORDER
    sums = np.zeros((p + 1, 2, p + 1, 2))
    for k in range(p + 1):
        i, s = np.arange(p + 1 - k), np.arange(p - k)
        first, last = p - 1 - s, n - 1 - s
        entering = np.einsum("as,bs->sab", x[:, first], x[:, first - k])
        leaving = np.einsum("as,bs->sab", x[:, last], x[:, last - k])
        blocks = np.zeros((p + 1 - k, 2, 2)) + x[:, p:] @ x[:, p - k : n - k].T
        blocks[1:] += np.cumsum(entering - leaving, axis=0)
        sums[i, :, i + k], sums[i + k, :, i] = blocks, blocks.transpose(0, 2, 1)
    return sums.reshape(2 * p + 2, 2 * p + 2)


def _share_at(products: Float[np.ndarray, "lags lags"], angle: Grid) -> Share:
    """By the model's response at these angles per sample."""
    past = np.linalg.solve(products[2:, 2:], products[2:, :2])
    new = products[:2, :2] - products[:2, 2:] @ past
    if not new[0, 0] > _EXACT * products[0, 0]:
        return Share(np.zeros(angle.size), np.zeros(angle.size))
    from_output, from_input = paths = _to_input(past, angle).T
    power = np.maximum(np.einsum("if,ij,jf->f", paths.conj(), new, paths).real, 1e-300)
    both = new[0, 0] * np.abs(from_output + new[1, 0] / new[0, 0] * from_input) ** 2
    alone = max(new[0, 0] - new[0, 1] ** 2 / max(new[1, 1], 1e-300), 0.0)
    return Share(both / power, alone * np.abs(from_output) ** 2 / power)


def _to_input(
    past: Float[np.ndarray, "lags 2"], angle: Grid
) -> Complex[np.ndarray, "frequencies 2"]:
    """From the innovations of output and input to the input."""
    late = np.exp(-1j * angle[:, None] * np.arange(1, _ORDER + 1))
    taken = np.einsum("fk,kij->fji", late, past.reshape(_ORDER, 2, 2))
    return np.linalg.inv(np.eye(2) - taken)[:, 1]
