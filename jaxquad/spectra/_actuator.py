"""Whether an actuator follows a rising command faster, or slower, than a falling one.

With a lag of T_u while it rises and T_d while it falls, an actuator moves by
m' = |u - m| / T_u or -|u - m| / T_d, which is m' = (u + b |u - m| - m) / T with
1 / T = (1 / T_u + 1 / T_d) / 2 and b = (T_d - T_u) / (T_d + T_u): a linear lag T, to whose input
b |u - m| is added. Of this, an even function of the command, a linear model explains nothing. It is
looked for in what the local linear model leaves, behind lags over the whole band. Then b, or both
lags, follow by least squares, in which what is linear is that from the added input.

An actuator that moves in steps q adds the rounding error of its command, a sawtooth of period q in
u. The transform of what is left, over the command and not over time, has a peak there.
"""

import dataclasses
from collections.abc import Sequence
from typing import cast, NamedTuple

import numpy as np
from jaxtyping import Complex, Float

from jaxquad.records import Record

from ._estimators import COHERENT, Method, Pair, Remark
from ._frequency_response import Estimate
from ._linearity import (
    factors_of,
    FEWEST,
    interpolated,
    left_over,
    LeftOver,
    local_mean,
    Signal,
    Spectra,
    transform_bins,
)


TWO_LAGS, STEPS = "two lags", "steps"  # kinds of remarks
_CLEAR = 4.0  # standard errors from which a remark is made; healthy records reached 3.3
# What a lag must add to a gain that differs for both signs: standard errors, and share of their
# square.
_MORE, _SHARE = 2.0, 0.1
_TRIED, _BELOW, _ABOVE = 10, 0.2, 3.0  # lags, from and to which multiple of 1 / omega
_DISTINCT = 0.005  # share of b |u - m| that no linear model explains
_TABLE, _AROUND = 7, 4.0  # lags for which b is estimated, by which factor around the clearest
_MOST = 0.9  # b
_STEPS, _LONGEST, _DIFFERENCE, _STILL = 8, 0.5, 1e-3, 0.05  # the last in standard errors
_DETERMINED = 0.3  # relative error of a lag that is printed

_FEWEST_STEPS, _MOST_STEPS = 3.0, 80.0  # over the range of a command
_PLACES, _PADDED, _PEAKS = 4096, 32, 6  # of the range; its transform's length; peaks that are tried
_CLEAR_STEPS, _LIKE = 5.0, (0.45, 1.25)  # standard errors; share of the rounding's size
_EVERYWHERE, _HALF = 3.0, (0.25, 1.25)  # likewise, for small and for large commands
_BIASED = 3.0  # random errors of the gain from which a remark is made

Commands = Sequence[Float[np.ndarray, " _samples"]]


class TwoLags(Remark):
    """A remark that knows how the difference of the lags depends on what their mean is.

    `lags` are values of T in s, `differences` the b that belongs to each, with their errors,
    and `changes` what the actuator's response is relative to that of the lag T; `further` is this
    where b is larger by its error.
    """

    lags: Float[np.ndarray, " lags"]
    differences: Float[np.ndarray, " lags"]
    errors: Float[np.ndarray, " lags"]
    changes: Complex[np.ndarray, "lags frequencies"]
    further: Complex[np.ndarray, "lags frequencies"]
    clear: float  # standard errors

    def at(self, lag: float | None) -> "LagsOf":
        """Where T is `lag`, within the table; without one in its middle."""
        grid = np.log(self.lags)
        place = grid[grid.size // 2] if lag is None else np.log(max(lag, 1e-9))
        b, error = (float(np.interp(place, grid, x)) for x in (self.differences, self.errors))
        tables = self.changes, self.further
        changes = [np.array([np.interp(place, grid, x) for x in one.T]) for one in tables]
        return LagsOf(b, error, *changes)


class LagsOf(NamedTuple):
    """What belongs to one lag T: b with its error, and the change of the response by both lags,
    for b and for what is larger by its error."""

    difference: float
    error: float
    change: Complex[np.ndarray, " frequencies"]
    further: Complex[np.ndarray, " frequencies"]


def input_of_one_lag(u: Signal, up: float, down: float, record: Record) -> Signal:
    """What an actuator of one lag, 2 / (1 / up + 1 / down), gets to move as that of two lags."""
    aims = u if record.hold else np.append(0.5 * (u[1:] + u[:-1]), u[-1])
    rises, falls = np.exp(-record.dt / up), np.exp(-record.dt / down)
    reached, place = [], float(u[0])
    for aim in aims.tolist():
        reached.append(place)
        ahead = place - aim
        place = aim + ahead * (falls if ahead > 0 else rises)
    left = u - np.array(reached)
    size = np.abs(left)
    if record.hold:  # its mean over the sample
        share = record.dt / np.where(left > 0, up, down)
        size *= -np.expm1(-share) / share
    return u + (down - up) / (down + up) * size


def remarks_on_actuator(
    records: Sequence[Record], method: Method, estimate: Estimate
) -> tuple[tuple[Remark, ...], Sequence[Record], Estimate]:
    """For each input whose actuator has clearly two lags, or steps, by its most precise output.
    Records and estimate are those from the input of one lag, without steps."""
    finite, remarks, first = np.isfinite(estimate.response).all(axis=2), [], records[0]
    response = np.array(estimate.response)
    inputs = [record.inputs.copy() for record in records]
    for i, source in enumerate(first.input_names):
        usable = finite & (estimate.coherence[:, :, i] >= COHERENT)
        error = np.where(usable, estimate.random_error[:, :, i], np.inf)
        o = int(np.argmax(np.sum(error**-2.0, axis=0)))
        if np.sum(used := usable[:, o]) >= FEWEST:
            pair = (first.output_names[o], source)
            search = _Search(records, method, estimate, used, (o, i))
            steps = search.remark_on_steps(pair, error[used, o])
            if steps is not None:
                remarks.append(steps)
                for mine, u in zip(inputs, search.commands, strict=True):
                    mine[:, i] = u
            remark = search.remark(pair)
            if remark is None:
                continue
            remarks.append(remark)
            middle = len(remark.lags) // 2
            response[:, :, i] /= remark.changes[middle][:, None]
            changed = search.inputs_of(remark.lags[middle], remark.differences[[middle]])
            for mine, u in zip(inputs, changed, strict=True):
                mine[:, i] = u
    if not remarks:
        return (), records, estimate
    pairs = zip(records, inputs, strict=True)
    records = [dataclasses.replace(record, inputs=mine) for record, mine in pairs]
    return tuple(remarks), records, estimate._replace(response=response)


class _Search:
    """For what two lags of one input's actuator leave in one output."""

    def __init__(
        self, records: Sequence[Record], method: Method, estimate: Estimate, used: np.ndarray,
        place: tuple[int, int],
    ):  # fmt: skip
        o, i = self.place = place
        self.records, self.method, self.grid = records, method, np.asarray(estimate.omega)
        self.omega, self.response = self.grid[used], np.asarray(estimate.response)[used, o]
        self.covariance = lambda: estimate.errors.between((o, i), (o, i))[np.ix_(used, used)]
        scale = float(np.sqrt(np.mean([np.var(record.inputs[:, i]) for record in records])))
        self.spectra = [Spectra.of(record, i, method, scale) for record in records]
        self.commands = [record.inputs[:, i] for record in records]
        # Without what noise adds through feedback: uncorrelated with the noise that is left.
        self.moved = [part.input for part in self.spectra]

    def examine(self, inputs: Commands, added: Sequence[np.ndarray]) -> LeftOver | None:
        """What local linear models of these inputs leave, and columns that are looked for in it."""
        parts = []
        for part, u, columns in zip(self.spectra, inputs, added, strict=True):
            count, changed = part.input.size, part.inputs.copy()
            changed[:, self.place[1]] = transform_bins(u[:count, None])[:, 0]
            moving = changed if self.method == "direct" else part.moving
            rows = transform_bins(columns[:count])
            parts.append(part._replace(inputs=changed, moving=moving, added=rows))
        return left_over(parts, self.omega, self.response, self.place)

    def remark(self, pair: Pair) -> TwoLags | None:
        """Where two lags are clear."""
        # The last is so long that |u - m| is |u|: a gain that differs for both signs.
        omega = self.omega
        tried = np.append(np.geomspace(_BELOW / omega[-1], _ABOVE / omega[0], _TRIED), np.inf)
        sizes = [self._sizes(*one, tried) for one in zip(self.records, self.commands, strict=True)]
        left = self.examine(self.commands, sizes)
        if left is None:
            return None
        single = [factors_of(left, left.added[:, [k]]) for k in range(tried.size)]
        distinct = left.share[: tried.size] > _DISTINCT
        clear = np.where(distinct, [one[2] for one in single], 0.0)
        best = int(np.argmax(clear[:-1]))
        static = clear[-1] ** 2
        if clear[best] < _CLEAR or clear[best] ** 2 - static < max(_MORE**2, _SHARE * static):
            return None
        b = np.clip(single[best][0], -_MOST, _MOST)
        table, rows = np.geomspace(tried[best] / _AROUND, tried[best] * _AROUND, _TABLE), {}
        for k in sorted(range(_TABLE), key=lambda k: abs(k - _TABLE // 2)):  # from the middle
            start = b if not rows else rows[min(rows, key=lambda other: abs(other - k))][0]
            value, covariance = self._descend(table[k], start)
            error = covariance[0, 0] ** 0.5
            inputs = [self.inputs_of(table[k], value + shift) for shift in (0.0, error)]
            rows[k] = value, error, *map(self._change, inputs)
        columns = zip(*(rows[k] for k in range(_TABLE)), strict=True)
        differences, errors, changes, further = (np.array(column) for column in columns)
        differences = differences[:, 0]
        z, covariance = self._descend(tried[best], np.append(b, 0.0))
        side = ("falls", "rises") if differences[_TABLE // 2] > 0 else ("rises", "falls")
        middle, half = tried[best] * np.exp(z[1]), np.array([1.0, -1.0])
        lags = middle / (1 + half * z[0])
        slopes, relative = np.stack([-half / (1 + half * z[0]), np.ones(2)]), np.full(2, np.inf)
        if np.all(np.isfinite(covariance)):
            relative = np.sqrt(np.sum(slopes * (covariance @ slopes), axis=0))
        numbers = ""
        if np.all(relative < _DETERMINED):
            up, down = (f"{x:.3g} +- {x * e:.2g} s" for x, e in zip(lags, relative, strict=True))
            numbers = f": {up} while it rises, {down} while it falls"
        text = (
            f"the actuator is slower while its command {side[0]} than while it {side[1]} "
            f"({clear[best]:.2g} standard errors){numbers}. Lag and delay of a linear model are "
            "biased, which the error bars do not include. «Fit.explain()» fits the plant behind "
            "an actuator of two lags; or record what the actuator does (its position or rpm) as "
            "the input"
        )
        remark = cast(TwoLags, TwoLags(text, pair=pair, kind=TWO_LAGS))
        remark.lags, remark.differences, remark.errors = table, differences, errors
        remark.changes, remark.further, remark.clear = changes, further, float(clear[best])
        return remark

    def remark_on_steps(self, pair: Pair, error: np.ndarray) -> Remark | None:
        """Where steps bias the gain by more than its random error; then these are the commands."""
        low = min(float(np.min(u)) for u in self.moved)
        width = max(float(np.max(u)) for u in self.moved) - low
        total, i = np.zeros(_PLACES), self.place[1]
        for part in self.spectra:  # what is left, weighted, over the command
            ends = np.searchsorted(part.grid, [self.omega[0], self.omega[-1]])
            band = slice(max(int(ends[0]), 1), int(ends[1]))
            plant = interpolated(part.grid[band], self.omega, self.response)
            rest = part.outputs[band, self.place[0]] - np.sum(plant * part.inputs[band], axis=1)
            rest, weighted = rest / plant[:, i], np.zeros(part.grid.size, complex)
            weighted[band] = rest / np.maximum(local_mean(np.abs(rest) ** 2, band.start), 1e-280)
            where = ((part.input - low) / width * (_PLACES - 1)).astype(int)
            left = np.fft.irfft(weighted, part.input.size)
            total += np.bincount(where, weights=left, minlength=_PLACES)
        ends = int(_PADDED * _FEWEST_STEPS), int(_PADDED * _MOST_STEPS)
        sums = np.conj(np.fft.rfft(total, _PADDED * _PLACES)[: ends[1] + 2])
        height = np.abs(sums)
        nearby, inner = np.sqrt(local_mean(height**2, 0)) + 1e-280, np.arange(*ends)
        tops = inner[(height[inner] >= height[inner - 1]) & (height[inner] >= height[inner + 1])]
        # The highest, and those that rise highest above what is nearby.
        tops = {k for x in (height, height / nearby) for k in tops[np.argsort(-x[tops])][:_PEAKS]}
        sizes = [width * _PADDED / k for k in sorted(tops)]
        offsets = [
            low + (np.angle(sums[k]) / (2 * np.pi) + 0.25) * size
            for k, size in zip(sorted(tops), sizes, strict=True)
        ]
        if not sizes:
            return None
        rounding = lambda u, q, at: q * np.round((u - at) / q) - (u - at)
        steps = list(zip(sizes, offsets, strict=True))
        added = [np.stack([rounding(u, *one) for one in steps], axis=1) for u in self.moved]
        left = self.examine(self.commands, added)
        if left is None:
            return None
        single = [factors_of(left, left.added[:, [k]]) for k in range(len(steps))]
        factor = np.array([one[0][0] for one in single])
        like = (factor > _LIKE[0]) & (factor < _LIKE[1]) & (left.share[: factor.size] > _DISTINCT)
        clear = np.where(like, [one[2] for one in single], 0.0)
        best = int(np.argmax(clear))
        if clear[best] < _CLEAR_STEPS:
            return None
        size, offset = steps[best]
        # Steps are there at small and at large commands; a saturation or a deadband is not.
        halves = []
        for u in self.moved:
            error_of_steps, outer = rounding(u, size, offset), np.abs(u) > 0.3 * width
            halves.append(np.stack([error_of_steps * ~outer, error_of_steps * outer], axis=1))
        left = self.examine(self.commands, halves)
        if left is None:
            return None
        both, covariance, _ = factors_of(left, left.added[:, :2])
        least = np.maximum(_EVERYWHERE * np.sqrt(np.diagonal(covariance)), _HALF[0])
        if np.any(both < least) or np.any(both > _HALF[1]):
            return None
        moved = [u + rounding(u, size, offset) for u in self.moved]
        change = np.real(self._change(moved, self.moved))[np.isin(self.grid, self.omega)] - 1
        shares = error**-2.0 / np.sum(error**-2.0)
        bias, scaled = float(factor[best] * shares @ change), shares / self.response[:, i]
        variance = 0.5 * np.real(scaled @ self.covariance() @ np.conj(scaled))
        if not abs(bias) > _BIASED * np.sqrt(variance):
            return None
        shifts = [
            np.mean(u[: mine.size]) for u, mine in zip(self.commands, self.moved, strict=True)
        ]
        self.commands = [
            u + rounding(u - shift, size, offset)
            for u, shift in zip(self.commands, shifts, strict=True)
        ]
        text = (
            f"the actuator moves in steps of {size:.3g}, {width / size:.2g} over the range of its "
            f"command: what the model leaves follows their rounding ({clear[best]:.2g} standard "
            f"errors). The gain is biased by about {100 * bias:+.2g} %, which the error bars do "
            "not include, and differs at other amplitudes. Repeat with a larger amplitude, or "
            "record what the actuator does (its position or rpm) as the input"
        )
        return Remark(text, pair=pair, kind=STEPS)

    def inputs_of(
        self, lag: float, z: np.ndarray, commands: Commands | None = None
    ) -> list[Signal]:
        """For b = z[0] and T = lag e^z[1]."""
        b, middle = float(np.clip(z[0], -0.99, 0.99)), lag * np.exp(z[1] if z.size > 1 else 0.0)
        pairs = zip(commands or self.commands, self.records, strict=True)
        return [input_of_one_lag(u, middle / (1 + b), middle / (1 - b), r) for u, r in pairs]

    def _descend(self, lag: float, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least squares from `z`, and its covariance; infinite where it does not converge."""
        unknown = np.full((z.size, z.size), np.inf)
        for _ in range(_STEPS):
            ends = [
                self.inputs_of(lag, z + sign * _DIFFERENCE * axis, self.moved)
                for axis in np.eye(z.size)
                for sign in (1, -1)
            ]
            slopes = [
                np.stack(columns[::2], axis=1) - np.stack(columns[1::2], axis=1)
                for columns in zip(*ends, strict=True)
            ]
            slopes = [columns / (2 * _DIFFERENCE) for columns in slopes]
            left = self.examine(self.inputs_of(lag, z), slopes)
            if left is None:
                return z, unknown
            step, covariance, _ = factors_of(left, left.added[:, : z.size])
            z = z + np.clip(step, -_LONGEST, _LONGEST)
            z[0] = np.clip(z[0], -_MOST, _MOST)
            if z.size > 1 and abs(z[1]) > np.log(_AROUND):
                break
            if np.all(np.abs(step) < _STILL * np.sqrt(np.diagonal(covariance))):
                return z, covariance
        return z, unknown if z.size > 1 else covariance

    def _change(
        self, inputs: Commands, commands: Commands | None = None
    ) -> Complex[np.ndarray, " frequencies"]:
        """The response of these inputs to the commands, at the frequencies of the estimate."""

        def near(
            grid: Float[np.ndarray, " bins"], product: Complex[np.ndarray, " bins"]
        ) -> Complex[np.ndarray, " frequencies"]:
            mean = local_mean(np.real(product), 0) + 1j * local_mean(np.imag(product), 0)
            return np.asarray(np.interp(self.grid, grid, mean))

        i, above, below = self.place[1], 0.0, 0.0
        for part, u, v in zip(self.spectra, inputs, commands or self.commands, strict=True):
            moving = part.moving[:, min(i, part.moving.shape[1] - 1)]
            changed, plain = transform_bins(np.stack([u, v], axis=1)[: part.input.size]).T
            above = above + near(part.grid, changed * np.conj(moving))
            below = below + near(part.grid, plain * np.conj(moving))
        return np.asarray(above / below)

    def _sizes(self, record: Record, u: Signal, lags: Float[np.ndarray, " lags"]) -> np.ndarray:
        """|u - m| behind each of the lags."""
        count = u.size + u.size // 4
        omega = 2 * np.pi / (count * record.dt) * np.arange(count // 2 + 1)
        wave = np.fft.rfft(u - np.mean(u), count)[:, None]
        turned = 1j * omega[:, None] * lags[:-1]
        passed = np.hstack([wave * turned / (1 + turned), wave])
        return np.abs(np.fft.irfft(passed, count, axis=0)[: u.size])
