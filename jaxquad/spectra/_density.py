from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad.records import Record

from ._checks import check_alike
from ._estimators import Welch
from ._welch import checked_omega, transform_records
from ._window import window


class SpectralDensity(eqx.Module):
    """Power and cross spectral densities of all channels of a record, one-sided.

    `density[:, a, b]` is the average of conj(X_a) X_b, scaled so that its integral over
    the positive frequencies in Hz is a power; its unit is that of a times that of b, per Hz.
    """

    omega: Float[Array, " frequencies"]  # rad/s
    density: Complex[Array, "frequencies channels channels"]  # Hermitian
    names: tuple[str, ...] = eqx.field(static=True)

    def power(self, name: str) -> Float[Array, " frequencies"]:
        """Power spectral density of one channel."""
        return jnp.real(self.cross(name, name))

    def cross(self, a: str, b: str) -> Complex[Array, " frequencies"]:
        """Cross-spectral density from channel `a` to `b`: the phase is that of b less that of a."""
        return self.density[:, self._position(a), self._position(b)]

    def coherence(self, a: str, b: str) -> Float[Array, " frequencies"]:
        """Magnitude-squared coherence, from 0 to 1."""
        return jnp.abs(self.cross(a, b)) ** 2 / (self.power(a) * self.power(b))

    def _position(self, name: str) -> int:
        if name not in self.names:
            raise ValueError(f"no channel {name!r}: choose one of {', '.join(self.names)}")
        return self.names.index(name)


def spectral_density(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | None = None,
    *,
    welch: Welch | None = None,
) -> SpectralDensity:
    """Power and cross spectra of every channel of one record, or of several taken together.

    `omega` in rad/s, by default 100 log-spaced values within what the window can resolve. The
    integrators and the delay of `welch` (default `Welch()`) apply to the outputs only.
    Raises `ValueError` for an unusable band or record, `PrecisionError` in 32 bits.
    """
    records = [record] if isinstance(record, Record) else list(record)
    check_alike(records)
    welch = Welch() if welch is None else welch
    omega = checked_omega(omega, records, welch)
    [transforms], [(length, _)] = transform_records(records, omega, [welch])
    energy = np.sum(window(welch.shape, length) ** 2)
    density = _averaged(transforms, np.asarray(2 * records[0].dt / energy))
    return SpectralDensity(jnp.asarray(omega), density, records[0].names)


@eqx.filter_jit
def _averaged(
    transforms: Complex[Array, "segments frequencies channels"], scale: Float[ArrayLike, ""]
) -> Complex[Array, "frequencies channels channels"]:
    products = jnp.einsum("sfa,sfb->fab", jnp.conj(transforms), transforms)
    return products * (jnp.asarray(scale) / transforms.shape[0]).astype(products.dtype)
