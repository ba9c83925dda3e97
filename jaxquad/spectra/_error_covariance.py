import dataclasses
import functools as ft

import equinox as eqx
import numpy as np
from jaxtyping import Array, Complex, Float, Shaped

from jaxquad._core import pytree_node

from ._window import coefficients


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
Places = Shaped[np.ndarray, " places"]

_CHUNK = 512  # times taken at once, so that a long record fits the memory


@pytree_node
class ErrorCovariance:
    """Covariance of the random errors of all responses of an estimate, stored as factors.

    The error of the response of output o to input i at frequency f is a sum over atoms of noise,

        dT[f, o, i] = sum_a share[f, o, i, g(a)] effect[f, i, a] V[a, o](f)

    where atoms come in groups g of `counts` each. V[a, o] is the transform of the noise of output
    o in window a of `windows`, or, without windows, independent noise of unit power. `noise[f]` is
    the root of the outputs' noise covariance: cov(V[o], V[p]) = sum_c noise[f, o, c]
    conj(noise[f, p, c]). The full covariance matrix of 20 outputs and 10 inputs would fill
    gigabytes, but a fit needs only its product with a few columns.

    Real parameters p that the same noise W[a, c] has disturbed, as those of a model that all
    frequencies share, add `sensitivity[f, o, i, p] Re(sum_ac drive[p, a, c] W[a, c])`, where
    V[a, o] = sum_c noise[f, o, c] W[a, c]: an effect that is linear in the real and the imaginary
    part of the noise apart. They need atoms without windows and `share`; `drive` is that of the
    first atoms, and the others have none.
    """

    omega: Float[Numbers, " frequencies"]  # rad/s
    effect: Complex[Numbers, "frequencies inputs atoms"]
    noise: Complex[Numbers, "frequencies outputs roots"]
    share: Float[Numbers, "frequencies outputs inputs groups"] | None = None  # 1 without
    windows: Placement | None = None
    counts: tuple[int, ...] | None = eqx.field(static=True, default=None)  # one group without
    sensitivity: Complex[Numbers, "frequencies outputs inputs parameters"] | None = None
    drive: Complex[Numbers, "parameters driven roots"] | None = None

    def project(
        self, columns: Complex[Numbers, "frequencies outputs inputs columns"]
    ) -> Float[np.ndarray, "columns columns"]:
        """Covariance of Re(sum of `conj(columns) dT`) over frequencies, outputs and inputs."""
        columns, count = np.asarray(columns), columns.shape[3]
        weighted = columns.conj()[..., None, :] * _share(self)[..., None]  # f o i g p
        drawn = np.einsum("foigp,foc->figcp", weighted, np.asarray(self.noise))
        total, moved = np.zeros((count, count)), _moved(self, columns)
        for atoms in _chunks(self):
            seen = _at(self, atoms)
            frequencies, groups, inputs, places = seen.shape
            seen = seen.reshape(-1, places).T
            along = np.swapaxes(drawn, 1, 2).reshape(frequencies * groups * inputs, -1)
            part = (seen @ along).reshape(places, -1, count)
            if moved is not None and self.drive is not None:
                drive = np.asarray(self.drive)[:, atoms[0] : atoms[-1] + 1]
                part[: drive.shape[1]] += np.einsum("nac,np->acp", drive, moved)
            part = part.reshape(-1, count)
            total += 0.5 * np.real(part.T @ part.conj())
        return total

    def variance(self) -> Float[np.ndarray, "frequencies outputs inputs"]:
        """Mean squared error E|dT|^2 of each response, for independent atoms (no windows)."""
        if self.windows is not None or self.share is not None:
            raise ValueError(
                "the errors of overlapping windows are correlated: use the diagonal of "
                "errors.between(pair, pair)"
            )
        effect, noise = np.asarray(self.effect), np.asarray(self.noise)
        gain, power = (np.vecdot(each, each).real for each in (effect, noise))
        total = power[:, :, None] * gain[:, None, :]
        if self.sensitivity is None or self.drive is None:
            return total
        slope, drive = np.asarray(self.sensitivity), np.asarray(self.drive)
        both = np.sum(_with_parameters(self) * np.conj(slope), axis=3)
        flat = drive.reshape(len(drive), -1)
        moved = slope @ (0.5 * np.real(flat @ np.conj(flat).T))
        own = np.sum(moved * np.conj(slope), axis=3)
        return np.maximum(total + np.real(both + own), 0.0)

    def between(
        self, first: tuple[int, int], second: tuple[int, int]
    ) -> Complex[np.ndarray, "frequencies frequencies"]:
        """Covariance E[dT dT^H] of two pairs (output, input) between all pairs of frequencies."""
        noise, pairs = np.asarray(self.noise), (first,) if first == second else (first, second)
        if self.windows is None and self.share is None:
            seen = [np.asarray(self.effect)[:, i] for _, i in pairs]
        else:
            atoms, share = _at(self, _places(self)), _share(self)
            seen = [np.einsum("fgt,fg->ft", atoms[:, :, i], share[:, o, i]) for o, i in pairs]
        one, other = seen[0], seen[-1]
        shared = noise[:, first[0]] @ noise[:, second[0]].conj().T
        total = (one @ other.conj().T) * shared
        if self.sensitivity is None or self.drive is None:
            return total
        drive = np.asarray(self.drive)
        mine, its = (np.asarray(self.sensitivity)[:, o, i] for o, i in (first, second))
        local = [
            np.einsum(
                "ft,ntc,fc->fn",
                effect[:, : drive.shape[1]],
                np.conj(drive),
                noise[:, pair[0]],
                optimize=True,
            )
            for effect, pair in zip(seen, pairs, strict=True)
        ]
        flat = drive.reshape(len(drive), -1)
        moved = mine @ (0.5 * np.real(flat @ np.conj(flat).T)) @ its.conj().T
        return total + moved + 0.5 * (local[0] @ its.conj().T + mine @ local[-1].conj().T)

    def at_each_frequency(self) -> Complex[np.ndarray, "frequencies pairs pairs"]:
        """Covariance E[dT dT^H] of all pairs (output, input), output by output."""
        noise = np.asarray(self.noise)
        shape = (len(noise), noise.shape[1] * np.shape(self.effect)[1])
        spread = noise @ np.conj(np.swapaxes(noise, 1, 2))
        if self.windows is None and self.share is None:
            effect = np.asarray(self.effect)
            gain = effect @ np.conj(np.swapaxes(effect, 1, 2))
            total = spread[:, :, None, :, None] * gain[:, None, :, None, :]
        else:
            share = _share(self)
            total = np.zeros((*shape, shape[1]), complex)
            for atoms in _chunks(self):
                seen = np.einsum("foig,fgit->foit", share, _at(self, atoms))
                seen = seen.reshape(*shape, -1)
                total += seen @ np.conj(np.swapaxes(seen, 1, 2))
            total = total.reshape(-1, *2 * share.shape[1:3]) * spread[:, :, None, :, None]
        total = total.reshape(*shape, -1)
        if self.sensitivity is None or self.drive is None:
            return total
        slope, drive = np.asarray(self.sensitivity), np.asarray(self.drive)
        both = _with_parameters(self).reshape(*shape, -1)
        slope, flat = slope.reshape(*shape, -1), drive.reshape(len(drive), -1)
        adjoint = np.conj(np.swapaxes(slope, 1, 2))
        moved = slope @ (0.5 * np.real(flat @ np.conj(flat).T)) @ adjoint
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


def _moved(
    errors: ErrorCovariance, columns: Complex[np.ndarray, "frequencies outputs inputs columns"]
) -> Float[np.ndarray, "parameters columns"] | None:
    """What each real parameter adds to Re(sum of `conj(columns) dT`)."""
    if errors.sensitivity is None or errors.drive is None:
        return None
    slope = np.asarray(errors.sensitivity)
    return np.real(np.tensordot(slope, columns.conj(), axes=((0, 1, 2), (0, 1, 2))))


def _with_parameters(
    errors: ErrorCovariance,
) -> Complex[np.ndarray, "frequencies outputs inputs parameters"]:
    """Twice the covariance of what atoms do to each response with the real parameters."""
    effect, drive = np.asarray(errors.effect), np.asarray(errors.drive)
    both = np.tensordot(effect[:, :, : drive.shape[1]], np.conj(drive), axes=(2, 1))
    return np.einsum("finc,foc->foin", both, np.asarray(errors.noise), optimize=True)


def _share(errors: ErrorCovariance) -> Float[np.ndarray, "frequencies outputs inputs groups"]:
    shape = (*errors.noise.shape[:2], errors.effect.shape[1], 1)
    return np.ones(shape) if errors.share is None else np.asarray(errors.share)


def _places(errors: ErrorCovariance) -> Places:
    """Where there is independent noise: times in s, or numbers of atoms."""
    return np.arange(errors.effect.shape[2]) if errors.windows is None else errors.windows.times


def _chunks(errors: ErrorCovariance) -> list[Places]:
    places = _places(errors)
    return [places[k : k + _CHUNK] for k in range(0, places.size, _CHUNK)]


def _at(
    errors: ErrorCovariance, places: Places
) -> Complex[np.ndarray, "frequencies groups inputs places"]:
    """Contribution of unit noise at these places to the errors, by group of atoms."""
    effect = np.asarray(errors.effect)
    if errors.windows is None:
        return effect[:, None, :, places[0] : places[-1] + 1]
    seen = errors.windows.at(places)
    turned = np.exp(-1j * np.asarray(errors.omega)[:, None] * places[None, :])
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
    effect = np.eye(count * inputs, dtype=complex).reshape(count, inputs, count * inputs)
    noise = np.broadcast_to(np.eye(outputs, dtype=complex), (count, outputs, outputs))
    return ErrorCovariance(np.asarray(omega), effect, noise, share[:, :, :, None])
