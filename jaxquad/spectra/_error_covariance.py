"""Covariance of the random errors of responses, stored as the effect of independent noise."""

import dataclasses
import functools as ft
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, Int

from jaxquad._core import pytree_node

from ._estimators import adjoint, Pairs, Places
from ._fourier_sums import coefficients, Layout


_POINTS = 32  # times to the shortest window, on which overlaps are summed
_FAR = 8  # window resolutions beyond which a tapered window has no response to a frequency


class Placement(eqx.Module):
    """Where the windows of an estimate lie in the records, which follow one another with gaps."""

    starts: Float[np.ndarray, " windows"]  # s
    lengths: Float[np.ndarray, " windows"]  # s
    times: Float[np.ndarray, " times"]  # s; close enough that no two frequencies alias
    dt: float = eqx.field(static=True)  # s
    shape: str = eqx.field(static=True)

    def at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "windows times"]:
        """Values of all windows, scaled so that a sum over `self.times` equals one over samples."""
        step = (self.times[1] - self.times[0]) / self.dt
        place = (times[None, :] - self.starts[:, None]) / self.lengths[:, None]
        return _window_at(self.shape, place) * np.sqrt(step)


def _window_at(shape: str, place: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """At a place from 0 to 1 in the window; 0 beyond."""
    level, cosine = coefficients(shape)
    values = level - cosine * np.cos(2 * np.pi * place)
    return np.where((place >= 0) & (place < 1), values, 0.0)


@ft.lru_cache(maxsize=16)
def place_windows(groups: Layout, shape: str, dt: float, band: float) -> Placement:
    """The places of windows of several lengths (samples); `band` is the range of omega, rad/s."""
    starts = np.concatenate([np.asarray(mine, float) for _, mine in groups]) * dt
    lengths = np.concatenate([np.full(len(mine), float(n)) for n, mine in groups]) * dt
    shortest, end = lengths.min(), np.max(starts + lengths)
    rate = band / (2 * np.pi) + 2 * _FAR / shortest
    step = 1 / max(rate, _POINTS / shortest)
    times = np.arange(starts.min(), end, min(step, (end - starts.min()) / 2))
    return Placement(starts, lengths, times, dt, shape)


@ft.lru_cache(maxsize=16)
def window_products(groups: Layout, shape: str) -> Float[np.ndarray, "windows windows"]:
    """Sums over samples of the product of any two windows."""
    step = max(min(length for length, _ in groups) / _POINTS, 1.0)
    last = max(mine[-1] + length for length, mine in groups)
    times = np.arange(min(mine[0] for _, mine in groups), last, step)
    places = [(times[None, :] - np.asarray(mine)[:, None]) / n for n, mine in groups]
    values = np.concatenate([_window_at(shape, place) for place in places])
    return step * (values @ values.T)


Numbers = Array | np.ndarray
Effect = Complex[np.ndarray, "frequencies inputs width"]

_CHUNK = 512  # times taken at once, so that a long record fits the memory
_ATOMS = 8192  # the same of atoms without windows
_TOGETHER = 32  # frequencies that are multiplied at once
_NARROW = 4  # atoms of an effect, up to which places are fewer steps than frequencies


@pytree_node
class ErrorCovariance:
    """Covariance of the random errors of all responses of an estimate, stored as factors.

    The error of the response of output o to input i at frequency f is a sum over atoms of noise,

        dT[f, o, i] = sum_a share[f, o, i, g(a)] effect[f, i, a] V[a, o](f)

    where atoms come in groups g of `counts` each. V[a, o] is the transform of the noise of output
    o in window a of `windows`, or, without windows, independent noise of unit power: few atoms of
    a record reach a frequency, and `effect[f]` is of those from number `first[f]` on, or from the
    first one. `noise[f]` is the root of the outputs' noise covariance: cov(V[o], V[p]) = sum_c
    noise[f, o, c] conj(noise[f, p, c]). The full covariance matrix of 20 outputs and 10 inputs
    would fill gigabytes, but a fit needs only its product with a few columns.

    Real parameters p that the same noise W[a, c] has disturbed, as those of a model that all
    frequencies share, add `sensitivity[f, o, i, p] Re(sum_ac drive[p, a, c] W[a, c])`, where
    V[a, o] = sum_c noise[f, o, c] W[a, c]: an effect that is linear in the real and the imaginary
    part of the noise apart. They need atoms without windows and `share`; `drive` is that of the
    atoms `driven`, whose numbers rise, and the others have none.
    """

    omega: Float[Numbers, " frequencies"]  # rad/s
    effect: Complex[Numbers, "frequencies inputs width"]
    noise: Complex[Numbers, "frequencies outputs roots"]
    share: Float[Numbers, "frequencies outputs inputs groups"] | None = None  # 1 without
    windows: Placement | None = None
    counts: tuple[int, ...] | None = eqx.field(static=True, default=None)  # one group without
    sensitivity: Complex[Numbers, "frequencies outputs inputs parameters"] | None = None
    drive: Complex[Numbers, "parameters driven roots"] | None = None
    first: Int[Numbers, " frequencies"] | None = None
    driven: Int[Numbers, " driven"] | None = None

    def project(
        self, columns: Complex[Numbers, "frequencies outputs inputs columns"]
    ) -> Float[np.ndarray, "columns columns"]:
        """Covariance of Re(sum of `conj(columns) dT`) over frequencies, outputs and inputs."""
        columns, count = np.asarray(columns), columns.shape[3]
        weighted = columns.conj()[..., None, :] * self._shares[..., None]  # f o i g p
        drawn = np.einsum("foigp,foc->figcp", weighted, np.asarray(self.noise))
        total = np.zeros((count, count))
        if self.windows is not None:
            along = np.swapaxes(drawn, 1, 2).reshape(-1, drawn.shape[3] * count)
            for effect in self._in_pieces():
                part = (effect.reshape(-1, effect.shape[3]).T @ along).reshape(-1, count)
                total += 0.5 * np.real(part.T @ part.conj())
            return total
        effect, reach, driven = np.asarray(self.effect), self._reach, self._driven
        values, drive = drawn.reshape(*effect.shape[:2], -1), np.zeros((0, 0, 0), complex)
        begin, end, moved = int(np.min(reach.first)), int(np.max(reach.last)), None
        if self.sensitivity is not None and self.drive is not None:
            slope, drive = np.asarray(self.sensitivity), np.asarray(self.drive)
            moved = np.real(np.tensordot(slope, columns.conj(), axes=((0, 1, 2), (0, 1, 2))))
            begin, end = min(begin, int(driven[0])), max(end, int(driven[-1]) + 1)
        for low in range(begin, end, _ATOMS):
            part = np.zeros((min(_ATOMS, end - low), values.shape[2]), complex)
            high = low + len(part)
            if effect.shape[2] <= _NARROW and np.all(np.diff(reach.first) > 0):
                for place in range(effect.shape[2]):  # no two frequencies have the same atom there
                    atoms = reach.first + place
                    here = (atoms >= low) & (atoms < high) & (atoms < reach.last)
                    moving = np.einsum("fi,fip->fp", effect[here, :, place], values[here])
                    part[atoms[here] - low] += moving
            else:
                for f in np.flatnonzero((reach.first < high) & (reach.last > low)):
                    first, last = max(reach.first[f], low), min(reach.last[f], high)
                    few = effect[f, :, first - reach.first[f] : last - reach.first[f]]
                    part[first - low : last - low] += few.T @ values[f]
            if moved is not None:
                taken = slice(*np.searchsorted(driven, (low, low + len(part))))
                both = np.einsum("nac,np->acp", drive[:, taken], moved)
                part[driven[taken] - low] += both.reshape(len(both), part.shape[1])
            part = part.reshape(-1, count)
            total += 0.5 * np.real(part.T @ part.conj())
        return total

    @staticmethod
    def project_each(
        errors: "Sequence[ErrorCovariance]",
        columns: Complex[np.ndarray, "members frequencies outputs inputs columns"],
    ) -> Float[np.ndarray, "members columns columns"]:
        """As `project`, of many; all at once where no two frequencies share an atom."""
        alone = columns.shape[2:4] == (1, 1) and all(
            one.windows is None and one.sensitivity is None and one.effect.shape[2] == 1
            and one.noise.shape[2] == 1 and one.first is not None
            for one in errors
        )  # fmt: skip
        rises = lambda: np.diff(np.stack([np.asarray(one.first) for one in errors]), axis=1) > 0
        if not (alone and np.all(rises())):
            pairs = zip(errors, columns, strict=True)
            return np.stack([type(one).project(one, mine) for one, mine in pairs])
        parts = columns[:, :, 0, 0].conj()
        if any(one.share is not None for one in errors):
            parts = parts * np.stack([one._shares[:, 0, 0] for one in errors])
        for factor in ([one.noise for one in errors], [one.effect for one in errors]):
            parts = parts * np.asarray(factor)[:, :, 0]
        return 0.5 * np.real(np.swapaxes(parts, 1, 2) @ parts.conj())

    def variance(self) -> Pairs:
        """Mean squared error E|dT|^2 of each response, for independent atoms (no windows)."""
        if self.windows is not None:
            raise ValueError(
                "the errors of overlapping windows are correlated: use the diagonal of "
                "errors.between(pair, pair)"
            )
        gain, power = (np.vecdot(x, x).real for x in map(np.asarray, (self.effect, self.noise)))
        total = power[:, :, None] * gain[:, None, :] * self._shares[..., 0] ** 2
        if self.sensitivity is None or self.drive is None:
            return total
        slope = np.asarray(self.sensitivity)
        moved = self._with_parameters() + slope @ self._parameters()
        return np.maximum(total + np.real(np.sum(moved * np.conj(slope), axis=3)), 0.0)

    def between(
        self, first: tuple[int, int], second: tuple[int, int]
    ) -> Complex[np.ndarray, "frequencies frequencies"]:
        """Covariance E[dT dT^H] of two pairs (output, input) between all pairs of frequencies."""
        noise, share = np.asarray(self.noise), self._shares
        pairs = (first,) if first == second else (first, second)
        if self.windows is None:
            effects = [np.asarray(self.effect)[:, i] * share[:, o, i] for o, i in pairs]
            total = sums_of_products(effects[0], effects[-1], self._reach)
        else:
            at = self._at(self.windows.times)
            effects = [np.einsum("fgt,fg->ft", at[:, :, i], share[:, o, i]) for o, i in pairs]
            total = effects[0] @ effects[-1].conj().T
        total *= noise[:, first[0]] @ noise[:, second[0]].conj().T
        if self.sensitivity is None or self.drive is None:
            return total
        slopes = [np.asarray(self.sensitivity)[:, o, i] for o, i in (first, second)]
        crossed = [self.pair(*pair)._with_parameters()[:, 0, 0] for pair in pairs]
        moved = slopes[0] @ self._parameters() @ slopes[1].conj().T
        mixed = crossed[0] @ slopes[1].conj().T + slopes[0] @ crossed[-1].conj().T
        return total + moved + 0.5 * mixed

    def independent(self, input: int, rows: Int[np.ndarray, " some"]) -> bool:
        """Whether no two of some frequencies share any noise in the responses to an input."""
        if self.windows is not None or self.sensitivity is not None:
            return False
        first = None if self.first is None else np.asarray(self.first)[rows]
        reach = reach_of(np.asarray(self.effect)[rows, input, None], first)
        order = np.argsort(reach.first, kind="stable")
        begin, end = reach.first[order], reach.last[order]
        return bool(np.all(begin[1:] >= np.maximum.accumulate(end)[:-1]))

    def at_each_frequency(self) -> Complex[np.ndarray, "frequencies pairs pairs"]:
        """Covariance E[dT dT^H] of all pairs (output, input), output by output."""
        noise, share = np.asarray(self.noise), self._shares
        shape = (len(noise), share.shape[1] * share.shape[2])
        spread = noise @ adjoint(noise)
        if self.windows is None:
            parts = iter([share[:, :, :, 0, None] * np.asarray(self.effect)[:, None]])
        else:
            parts = (np.einsum("foig,fgit->foit", share, effect) for effect in self._in_pieces())
        total = np.zeros((*shape, shape[1]), complex)
        for part in parts:
            part = part.reshape(*shape, -1)
            total += part @ adjoint(part)
        total = total.reshape(-1, *2 * share.shape[1:3]) * spread[:, :, None, :, None]
        total = total.reshape(*shape, -1)
        if self.sensitivity is None or self.drive is None:
            return total
        slope = np.asarray(self.sensitivity).reshape(*shape, -1)
        moved = slope @ self._parameters() @ adjoint(slope)
        mixed = 0.5 * (self._with_parameters().reshape(*shape, -1) @ adjoint(slope))
        return total + moved + mixed + adjoint(mixed)

    def pair(self, output: int, input: int) -> "ErrorCovariance":
        """That of a single response."""
        o, i, slope = slice(output, output + 1), slice(input, input + 1), self.sensitivity
        return dataclasses.replace(
            self,
            effect=np.asarray(self.effect)[:, i],
            noise=np.asarray(self.noise)[:, o],
            share=None if self.share is None else np.asarray(self.share)[:, o, i],
            sensitivity=None if slope is None else np.asarray(slope)[:, o, i],
        )

    def scaled(self, factor: Complex[Numbers, " frequencies"]) -> "ErrorCovariance":
        """That of the errors times `factor`."""
        columns, slope = np.asarray(factor)[:, None, None], self.sensitivity
        turned = None if slope is None else np.asarray(slope) * columns[..., None]
        effect = np.asarray(self.effect) * columns
        return dataclasses.replace(self, effect=effect, sensitivity=turned)

    @property
    def _shares(self) -> Float[np.ndarray, "frequencies outputs inputs groups"]:
        shape = (*self.noise.shape[:2], self.effect.shape[1], 1)
        return np.ones(shape) if self.share is None else np.asarray(self.share)

    @property
    def _reach(self) -> "Reach":
        return reach_of(np.asarray(self.effect), self.first)

    @property
    def _driven(self) -> Int[np.ndarray, " driven"]:
        if self.drive is None:
            return np.zeros(0, int)
        return np.arange(self.drive.shape[1]) if self.driven is None else np.asarray(self.driven)

    def _parameters(self) -> Float[np.ndarray, "parameters parameters"]:
        """Covariance of the real parameters."""
        drive = np.ascontiguousarray(np.asarray(self.drive))
        parts = drive.reshape(len(drive), -1).view(float)  # real and imaginary ones in turn
        return 0.5 * (parts @ parts.T)

    def _with_parameters(self) -> Complex[np.ndarray, "frequencies outputs inputs parameters"]:
        """Twice the covariance of what atoms do to each response with the real parameters."""
        effect, reach, driven = np.asarray(self.effect), self._reach, self._driven
        drive = np.asarray(self.drive)
        parameters, _, roots = drive.shape
        rows = np.conj(np.swapaxes(drive, 0, 1))
        rows = np.ascontiguousarray(rows).reshape(driven.size, -1)
        crossed = np.zeros((*effect.shape[:2], parameters * roots), complex)
        begins, ends = np.searchsorted(driven, reach.first), np.searchsorted(driven, reach.last)
        for f in np.flatnonzero(begins < ends):
            taken = slice(begins[f], ends[f])
            crossed[f] = effect[f][:, driven[taken] - reach.first[f]] @ rows[taken]
        crossed = crossed.reshape(*effect.shape[:2], parameters, roots)
        return np.einsum("finc,foc->foin", crossed, np.asarray(self.noise), optimize=True)

    def _in_pieces(self) -> Iterator[Complex[np.ndarray, "frequencies groups inputs times"]]:
        """`_at` all times, some at once: those of a long record would not fit the memory."""
        assert self.windows is not None
        times = self.windows.times
        return (self._at(times[k : k + _CHUNK]) for k in range(0, times.size, _CHUNK))

    def _at(
        self, times: Float[np.ndarray, " times"]
    ) -> Complex[np.ndarray, "frequencies groups inputs times"]:
        """Contribution of unit noise at these times to the errors, by group of windows."""
        assert self.windows is not None
        effect, windows = np.asarray(self.effect), self.windows.at(times)
        turned = np.exp(-1j * np.asarray(self.omega)[:, None] * times[None, :])
        ends = np.cumsum(self.counts or (effect.shape[2],))[:-1]
        groups = zip(np.split(effect, ends, axis=2), np.split(windows, ends), strict=True)
        return np.stack([part @ few for part, few in groups], axis=1) * turned[:, None, None]


def independent_errors(
    omega: Float[Numbers, " frequencies"], variance: Float[Numbers, "frequencies outputs inputs"]
) -> ErrorCovariance:
    """The covariance of uncorrelated errors; `variance` is E|dT|^2 of each response."""
    share = np.sqrt(np.asarray(variance))
    count, outputs, inputs = share.shape
    effect = np.broadcast_to(np.eye(inputs, dtype=complex), (count, inputs, inputs))
    noise = np.broadcast_to(np.eye(outputs, dtype=complex), (count, outputs, outputs))
    first = inputs * np.arange(count)
    return ErrorCovariance(np.asarray(omega), effect, noise, share[:, :, :, None], first=first)


class Reach(NamedTuple):
    """The atoms from `first` to before `last` that have an effect at each frequency."""

    first: Places
    last: Places

    def reached(self, count: int) -> Bool[np.ndarray, " count"]:
        """Which of `count` atoms have an effect on any frequency."""
        edges = np.bincount(self.first, minlength=count + 1).astype(int)
        edges -= np.bincount(self.last, minlength=count + 1)
        return np.cumsum(edges)[:count] > 0


def reach_of(effect: Effect, first: Int[Numbers, " frequencies"] | None) -> Reach:
    """Of effects that begin with the atom `first`; all with the same one, without it."""
    used = np.any(effect != 0, axis=1)
    width = np.where(np.any(used, axis=1), used.shape[1] - np.argmax(used[:, ::-1], axis=1), 0)
    begin = np.zeros(len(effect), int) if first is None else np.asarray(first)
    return Reach(begin, begin + width)


def sums_of_products(
    one: Complex[np.ndarray, "frequencies width"],
    other: Complex[np.ndarray, "frequencies width"],
    reach: Reach,
) -> Complex[np.ndarray, "frequencies frequencies"]:
    """Of `one` and the conjugate `other`, over the atoms that two frequencies share."""

    def by_atom(effect: np.ndarray, rows: np.ndarray, low: int, high: int) -> np.ndarray:
        """The effects of the atoms from `low` to before `high` at some frequencies."""
        aligned = np.zeros((rows.size, high - low), complex)
        for row, f in zip(aligned, rows, strict=True):
            begin, end = max(reach.first[f], low), min(reach.last[f], high)
            row[begin - low : end - low] = effect[f, begin - reach.first[f] : end - reach.first[f]]
        return aligned

    total = np.zeros((len(one), len(one)), complex)
    for begin in range(0, len(one), _TOGETHER):
        rows = np.arange(begin, min(begin + _TOGETHER, len(one)))
        low, high = int(np.min(reach.first[rows])), int(np.max(reach.last[rows]))
        near = np.flatnonzero((reach.first < high) & (reach.last > low))
        if one is other:  # the half above the diagonal says all
            near = near[near >= begin]
        both = by_atom(one, rows, low, high), by_atom(other, near, low, high)
        total[np.ix_(rows, near)] = both[0] @ both[1].conj().T
    if one is other:
        below = np.tril_indices(len(one), -1)
        total[below] = total.T[below].conj()
    return total
