import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ._placement import Placement
from ._transform import turn


_CHUNK = 512  # times taken at once, so that a long record fits the memory


class ErrorCovariance(eqx.Module):
    """Covariance of the random errors of all responses of an estimate, kept as factors.

    The error of the response of output o to input i at a frequency f is a sum over atoms of noise,

        dT[f, o, i] = sum_a share[f, o, i, g(a)] effect[f, i, a] V[a, o](f)

    where atoms come in groups g of `counts` each. V[a, o] is the transform of the noise of output
    o in window a of `windows`, or, without windows, independent noise of unit power. `noise[f]` is
    the root of the outputs' noise covariance: cov(V[o], V[p]) = sum_c noise[f, o, c]
    conj(noise[f, p, c]). Whole, the covariance of 20 outputs and 10 inputs would fill gigabytes;
    what a fit needs of it is a product with a few columns.
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
        """Mean squared error E|dT|^2 of each response, of atoms that are not windows."""
        if self.windows is not None or self.share is not None:
            raise ValueError("windows overlap: take the diagonal of errors.between(pair, pair)")
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
        """Places of independent noise: times in s, or the number of an atom; -1 is none."""
        atoms = np.arange(float(self.effect.shape[2]))
        places = jnp.asarray(atoms if self.windows is None else self.windows.times)
        chunk = min(_CHUNK, places.size)
        return jnp.pad(places, (0, -places.size % chunk), constant_values=-1.0).reshape(-1, chunk)

    def _at(
        self, times: Float[Array, " times"]
    ) -> Complex[Array, "frequencies groups inputs times"]:
        """What unit noise at these times adds to the errors, by group of atoms."""
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
    """Errors of variance E|dT|^2 that no two frequencies, outputs or inputs share."""
    share = jnp.sqrt(jnp.asarray(variance))
    count, outputs, inputs = share.shape
    effect = np.eye(count * inputs, dtype=complex).reshape(count, inputs, count * inputs)
    noise = np.broadcast_to(np.eye(outputs, dtype=complex), (count, outputs, outputs))
    return ErrorCovariance(
        jnp.asarray(omega), jnp.asarray(effect), jnp.asarray(noise), share[:, :, :, None]
    )
