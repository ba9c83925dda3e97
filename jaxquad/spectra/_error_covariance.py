import functools as ft

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ._transform import turn
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

    def at(self, times: Float[Array, " times"]) -> Float[Array, "windows times"]:
        """Values of all windows, scaled so that a sum over `self.times` equals one over samples."""
        level, cosine = coefficients(self.shape)
        into = (times[None, :] - self.starts[:, None]) / self.lengths[:, None]
        values = level - cosine * jnp.cos(2 * np.pi * into)
        step = (self.times[1] - self.times[0]) / self.dt
        return jnp.where((into >= 0) & (into < 1), values, 0.0) * jnp.sqrt(step)


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


_CHUNK = 512  # times taken at once, so that a long record fits the memory


class ErrorCovariance(eqx.Module):
    """Covariance of the random errors of all responses of an estimate, stored as factors.

    The error of the response of output o to input i at frequency f is a sum over atoms of noise,

        dT[f, o, i] = sum_a share[f, o, i, g(a)] effect[f, i, a] V[a, o](f)

    where atoms come in groups g of `counts` each. V[a, o] is the transform of the noise of output
    o in window a of `windows`, or, without windows, independent noise of unit power. `noise[f]` is
    the root of the outputs' noise covariance: cov(V[o], V[p]) = sum_c noise[f, o, c]
    conj(noise[f, p, c]). The full covariance matrix of 20 outputs and 10 inputs would fill
    gigabytes, but a fit needs only its product with a few columns.
    """

    omega: Float[Array, " frequencies"]  # rad/s
    effect: Complex[Array, "frequencies inputs atoms"]
    noise: Complex[Array, "frequencies outputs roots"]
    share: Float[Array, "frequencies outputs inputs groups"] | None = None  # 1 without
    windows: Placement | None = None
    counts: tuple[int, ...] | None = eqx.field(static=True, default=None)  # one group without

    @eqx.filter_jit
    def project(
        self, columns: Complex[Array, "frequencies outputs inputs columns"]
    ) -> Complex[Array, "columns columns"]:
        """Covariance of the sums of `conj(columns) dT` over frequencies, outputs and inputs."""
        share = self._share()
        drawn = jnp.einsum(
            "foip,foc,foig->fgicp", jnp.conj(columns), self.noise, share.astype(columns.dtype)
        )
        count = columns.shape[3]
        start = jnp.zeros((count, count), columns.dtype)

        def add(total, times):
            part = jnp.einsum("fgit,fgicp->tcp", self._at(times), drawn).reshape(-1, count)
            return total + part.T @ jnp.conj(part), None

        return jax.lax.scan(add, start, self._times())[0]

    def variance(self) -> Float[Array, "frequencies outputs inputs"]:
        """Mean squared error E|dT|^2 of each response, for independent atoms (no windows)."""
        if self.windows is not None or self.share is not None:
            raise ValueError(
                "the errors of overlapping windows are correlated: use the diagonal of "
                "errors.between(pair, pair)"
            )
        gain = jnp.sum(jnp.abs(self.effect) ** 2, axis=2)
        power = jnp.sum(jnp.abs(self.noise) ** 2, axis=2)
        return power[:, :, None] * gain[:, None, :]

    def between(
        self, first: tuple[int, int], second: tuple[int, int]
    ) -> Complex[np.ndarray, "frequencies frequencies"]:
        """Covariance of two pairs (output, input) between all pairs of frequencies."""
        times = self._times().reshape(-1)
        atoms, share, noise = (np.asarray(x) for x in (self._at(times), self._share(), self.noise))
        one, other = (
            np.einsum("fgt,fg->ft", atoms[:, :, i], share[:, o, i]) for o, i in (first, second)
        )
        shared = noise[:, first[0]] @ noise[:, second[0]].conj().T
        return (one @ other.conj().T) * shared

    def _share(self) -> Float[Array, "frequencies outputs inputs groups"]:
        shape = (*self.noise.shape[:2], self.effect.shape[1], 1)
        return jnp.ones(shape) if self.share is None else self.share

    def _times(self) -> Float[Array, "chunks chunk"]:
        """Places of independent noise: times in s, or numbers of atoms; -1 is padding."""
        atoms = np.arange(float(self.effect.shape[2]))
        places = jnp.asarray(atoms if self.windows is None else self.windows.times)
        chunk = min(_CHUNK, places.size)
        return jnp.pad(places, (0, -places.size % chunk), constant_values=-1.0).reshape(-1, chunk)

    def _at(
        self, times: Float[Array, " times"]
    ) -> Complex[Array, "frequencies groups inputs times"]:
        """Contribution of unit noise at these times to the errors, by group of atoms."""
        if self.windows is None:
            place = jnp.maximum(times, 0.0).astype(int)
            inside = (times >= 0).astype(self.effect.dtype)
            return (jnp.take(self.effect, place, axis=2) * inside[None, None, :])[:, None]
        seen = self.windows.at(times)
        turned = turn(self.omega[:, None] * times[None, :])
        ends = np.cumsum(self.counts or (self.effect.shape[2],))
        parts = [
            jnp.einsum("fia,at->fit", effect, windows.astype(effect.dtype))
            for effect, windows in zip(
                jnp.split(self.effect, ends[:-1], axis=2), jnp.split(seen, ends[:-1]), strict=True
            )
        ]
        return jnp.stack(parts, axis=1) * turned[:, None, None, :]


def independent_errors(
    omega: Float[Array, " frequencies"], variance: Float[Array, "frequencies outputs inputs"]
) -> ErrorCovariance:
    """The covariance of uncorrelated errors.

    **Arguments:**

    - `omega`: frequencies in rad/s.
    - `variance`: E|dT|^2 of each response, shape `(frequencies, outputs, inputs)`.

    **Returns:** an `ErrorCovariance`.
    """
    share = jnp.sqrt(jnp.asarray(variance))
    count, outputs, inputs = share.shape
    effect = np.eye(count * inputs, dtype=complex).reshape(count, inputs, count * inputs)
    noise = np.broadcast_to(np.eye(outputs, dtype=complex), (count, outputs, outputs))
    return ErrorCovariance(
        jnp.asarray(omega), jnp.asarray(effect), jnp.asarray(noise), share[:, :, :, None]
    )
