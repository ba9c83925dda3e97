import dataclasses
import functools as ft
from collections.abc import Iterator

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float, Int

from jaxquad._core import pytree_node

from ._atoms import add_effects, Reach, reach_of, sums_of_products, times_drive
from ._windows import coefficients


_POINTS = 32  # times to the shortest window, on which overlaps are summed
_APART = 8  # window resolutions beyond which a tapered window has no response to a frequency


class Placement(eqx.Module):
    """Where the windows of an estimate lie in the records, which follow one another with gaps."""

    starts: Float[np.ndarray, " windows"]  # s
    lengths: Float[np.ndarray, " windows"]  # s
    times: Float[np.ndarray, " times"]  # s; close enough that no two frequencies alias
    dt: float = eqx.field(static=True)  # s
    shape: str = eqx.field(static=True)

    def at(self, times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "windows times"]:
        """Values of all windows, scaled so that a sum over `self.times` equals one over samples."""
        level, cosine = coefficients(self.shape)
        into = (times[None, :] - self.starts[:, None]) / self.lengths[:, None]
        values = level - cosine * np.cos(2 * np.pi * into)
        step = (self.times[1] - self.times[0]) / self.dt
        return np.where((into >= 0) & (into < 1), values, 0.0) * np.sqrt(step)


@ft.lru_cache(maxsize=16)
def place_windows(
    groups: tuple[tuple[int, tuple[int, ...]], ...], shape: str, dt: float, band: float
) -> Placement:
    """The places of windows of several lengths (samples); `band` is the range of omega, rad/s."""
    starts = np.concatenate([np.asarray(mine, float) for _, mine in groups]) * dt
    lengths = np.concatenate([np.full(len(mine), float(n)) for n, mine in groups]) * dt
    shortest, end = lengths.min(), np.max(starts + lengths)
    rate = band / (2 * np.pi) + 2 * _APART / shortest
    step = 1 / max(rate, _POINTS / shortest)
    times = np.arange(starts.min(), end, min(step, (end - starts.min()) / 2))
    return Placement(starts, lengths, times, dt, shape)


@ft.lru_cache(maxsize=16)
def window_products(
    groups: tuple[tuple[int, tuple[int, ...]], ...], shape: str
) -> Float[np.ndarray, "windows windows"]:
    """Sums over samples of the product of any two windows."""
    level, cosine = coefficients(shape)
    step = max(min(length for length, _ in groups) / _POINTS, 1.0)
    last = max(mine[-1] + length for length, mine in groups)
    times = np.arange(min(mine[0] for _, mine in groups), last, step)
    rows = []
    for length, mine in groups:
        into = (times[None, :] - np.asarray(mine)[:, None]) / length
        inside = (into >= 0) & (into < 1)
        rows.append(np.where(inside, level - cosine * np.cos(2 * np.pi * into), 0.0))
    values = np.concatenate(rows)
    return step * (values @ values.T)


Numbers = Array | np.ndarray

_CHUNK = 512  # times taken at once, so that a long record fits the memory
_ATOMS = 8192  # the same of atoms without windows


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
        weighted = columns.conj()[..., None, :] * _share(self)[..., None]  # f o i g p
        drawn = np.einsum("foigp,foc->figcp", weighted, np.asarray(self.noise))
        parts = _by_atoms(self, drawn, columns) if self.windows is None else _by_times(self, drawn)
        total = np.zeros((count, count))
        for part in parts:
            part = part.reshape(-1, count)
            total += 0.5 * np.real(part.T @ part.conj())
        return total

    def variance(self) -> Float[np.ndarray, "frequencies outputs inputs"]:
        """Mean squared error E|dT|^2 of each response, for independent atoms (no windows)."""
        if self.windows is not None:
            raise ValueError(
                "the errors of overlapping windows are correlated: use the diagonal of "
                "errors.between(pair, pair)"
            )
        effect, noise = np.asarray(self.effect), np.asarray(self.noise)
        gain, power = (np.vecdot(each, each).real for each in (effect, noise))
        total = power[:, :, None] * gain[:, None, :] * _share(self)[..., 0] ** 2
        if self.sensitivity is None or self.drive is None:
            return total
        slope = np.asarray(self.sensitivity)
        both = np.sum(_with_parameters(self) * np.conj(slope), axis=3)
        own = np.sum(slope @ _products_of_drives(self) * np.conj(slope), axis=3)
        return np.maximum(total + np.real(both + own), 0.0)

    def between(
        self, first: tuple[int, int], second: tuple[int, int]
    ) -> Complex[np.ndarray, "frequencies frequencies"]:
        """Covariance E[dT dT^H] of two pairs (output, input) between all pairs of frequencies."""
        noise, share = np.asarray(self.noise), _share(self)
        pairs = (first,) if first == second else (first, second)
        if self.windows is None:
            effect = np.asarray(self.effect)
            seen = [effect[:, i] * share[:, o, i] for o, i in pairs]
            total = sums_of_products(seen[0], seen[-1], _reach(self))
        else:
            at = _at(self, self.windows.times)
            seen = [np.einsum("fgt,fg->ft", at[:, :, i], share[:, o, i]) for o, i in pairs]
            total = seen[0] @ seen[-1].conj().T
        total *= noise[:, first[0]] @ noise[:, second[0]].conj().T
        if self.sensitivity is None or self.drive is None:
            return total
        mine, its = (np.asarray(self.sensitivity)[:, o, i] for o, i in (first, second))
        both = [_with_parameters(self.pair(*each))[:, 0, 0] for each in pairs]
        moved = mine @ _products_of_drives(self) @ its.conj().T
        mixed = both[0] @ its.conj().T + mine @ both[-1].conj().T
        return total + moved + 0.5 * mixed

    def independent(self, input: int, rows: Int[np.ndarray, " some"]) -> bool:
        """Whether no two of some frequencies share any noise in the responses to an input."""
        if self.windows is not None or self.sensitivity is not None:
            return False
        first = None if self.first is None else np.asarray(self.first)[rows]
        return reach_of(np.asarray(self.effect)[rows, input, None], first).disjoint()

    def at_each_frequency(self) -> Complex[np.ndarray, "frequencies pairs pairs"]:
        """Covariance E[dT dT^H] of all pairs (output, input), output by output."""
        noise, share = np.asarray(self.noise), _share(self)
        shape = (len(noise), share.shape[1] * share.shape[2])
        spread = noise @ np.conj(np.swapaxes(noise, 1, 2))
        if self.windows is None:
            effect = share[:, :, :, 0, None] * np.asarray(self.effect)[:, None]
            parts = iter((effect.reshape(*shape, -1),))
        else:
            seen = (_at(self, times) for times in _chunks(self))
            parts = (np.einsum("foig,fgit->foit", share, e).reshape(*shape, -1) for e in seen)
        total = np.zeros((*shape, shape[1]), complex)
        for part in parts:
            total += part @ np.conj(np.swapaxes(part, 1, 2))
        total = total.reshape(-1, *2 * share.shape[1:3]) * spread[:, :, None, :, None]
        total = total.reshape(*shape, -1)
        if self.sensitivity is None or self.drive is None:
            return total
        both = _with_parameters(self).reshape(*shape, -1)
        slope = np.asarray(self.sensitivity).reshape(*shape, -1)
        adjoint = np.conj(np.swapaxes(slope, 1, 2))
        moved = slope @ _products_of_drives(self) @ adjoint
        mixed = 0.5 * (both @ adjoint)
        return total + moved + mixed + np.conj(np.swapaxes(mixed, 1, 2))

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


def _reach(errors: ErrorCovariance) -> Reach:
    return reach_of(np.asarray(errors.effect), errors.first)


def _driven(errors: ErrorCovariance) -> Int[np.ndarray, " driven"]:
    if errors.drive is None:
        return np.zeros(0, int)
    return np.arange(errors.drive.shape[1]) if errors.driven is None else np.asarray(errors.driven)


def _by_atoms(
    errors: ErrorCovariance,
    drawn: Complex[np.ndarray, "frequencies inputs 1 roots columns"],
    columns: Complex[np.ndarray, "frequencies outputs inputs columns"],
) -> Iterator[Complex[np.ndarray, "atoms roots_columns"]]:
    """What atoms of unit power do to Re(sum of `conj(columns) dT`), some atoms at a time."""
    effect, reach, driven = np.asarray(errors.effect), _reach(errors), _driven(errors)
    values, moved = drawn.reshape(*effect.shape[:2], -1), None
    begin, end = int(np.min(reach.first)), int(np.max(reach.last))
    if errors.sensitivity is not None and errors.drive is not None:
        slope, drive = np.asarray(errors.sensitivity), np.asarray(errors.drive)
        moved = np.real(np.tensordot(slope, columns.conj(), axes=((0, 1, 2), (0, 1, 2))))
        begin, end = min(begin, int(driven[0])), max(end, int(driven[-1]) + 1)
    for low in range(begin, end, _ATOMS):
        part = np.zeros((min(_ATOMS, end - low), values.shape[2]), complex)
        add_effects(part, low, effect, reach, values)
        if moved is not None:
            taken = slice(*np.searchsorted(driven, (low, low + len(part))))
            both = np.einsum("nac,np->acp", drive[:, taken], moved)
            part[driven[taken] - low] += both.reshape(len(both), part.shape[1])
        yield part


def _by_times(
    errors: ErrorCovariance, drawn: Complex[np.ndarray, "frequencies inputs groups roots columns"]
) -> Iterator[Complex[np.ndarray, "times roots_columns"]]:
    """The same of the noise at the times that windows overlap."""
    along = np.swapaxes(drawn, 1, 2).reshape(-1, drawn.shape[3] * drawn.shape[4])
    for times in _chunks(errors):
        seen = _at(errors, times)
        yield seen.reshape(-1, seen.shape[3]).T @ along


def _products_of_drives(errors: ErrorCovariance) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance of the real parameters."""
    drive = np.ascontiguousarray(errors.drive)
    parts = drive.reshape(len(drive), -1).view(float)  # real and imaginary ones in turn
    return 0.5 * (parts @ parts.T)


def _with_parameters(
    errors: ErrorCovariance,
) -> Complex[np.ndarray, "frequencies outputs inputs parameters"]:
    """Twice the covariance of what atoms do to each response with the real parameters."""
    drive = np.asarray(errors.drive)
    both = times_drive(np.asarray(errors.effect), _reach(errors), _driven(errors), drive)
    return np.einsum("finc,foc->foin", both, np.asarray(errors.noise), optimize=True)


def _share(errors: ErrorCovariance) -> Float[np.ndarray, "frequencies outputs inputs groups"]:
    shape = (*errors.noise.shape[:2], errors.effect.shape[1], 1)
    return np.ones(shape) if errors.share is None else np.asarray(errors.share)


def _chunks(errors: ErrorCovariance) -> list[Float[np.ndarray, " times"]]:
    assert errors.windows is not None
    times = errors.windows.times
    return [times[k : k + _CHUNK] for k in range(0, times.size, _CHUNK)]


def _at(
    errors: ErrorCovariance, times: Float[np.ndarray, " times"]
) -> Complex[np.ndarray, "frequencies groups inputs times"]:
    """Contribution of unit noise at these times to the errors, by group of windows."""
    assert errors.windows is not None
    effect, seen = np.asarray(errors.effect), errors.windows.at(times)
    turned = np.exp(-1j * np.asarray(errors.omega)[:, None] * times[None, :])
    ends = np.cumsum(errors.counts or (effect.shape[2],))
    groups = zip(np.split(effect, ends[:-1], axis=2), np.split(seen, ends[:-1]), strict=True)
    return np.stack([part @ windows for part, windows in groups], axis=1) * turned[:, None, None]


def independent_errors(
    omega: Float[Numbers, " frequencies"], variance: Float[Numbers, "frequencies outputs inputs"]
) -> ErrorCovariance:
    """The covariance of uncorrelated errors.

    **Arguments:**

    - `omega`: frequencies in rad/s.
    - `variance`: E|dT|^2 of each response, shape `(frequencies, outputs, inputs)`.

    **Returns:** an `ErrorCovariance`.
    """
    share = np.sqrt(np.asarray(variance))
    count, outputs, inputs = share.shape
    effect = np.broadcast_to(np.eye(inputs, dtype=complex), (count, inputs, inputs))
    noise = np.broadcast_to(np.eye(outputs, dtype=complex), (count, outputs, outputs))
    first = inputs * np.arange(count)
    return ErrorCovariance(np.asarray(omega), effect, noise, share[:, :, :, None], first=first)
