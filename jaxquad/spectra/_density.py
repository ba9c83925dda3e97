from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Complex, Float

from jaxquad._core import one_blas_thread
from jaxquad.records import Record

from ._checks import check_compatible
from ._estimators import Welch
from ._leakage import cross_products
from ._welch import frequencies_for, transform_records
from ._windows import coefficients


class SpectralDensity(eqx.Module):
    """One-sided power and cross spectral densities of all channels of a record.

    `density[:, a, b]` is the average of conj(X_a) X_b, scaled so that its integral over the
    positive frequencies in Hz is a power; its unit is that of a times that of b, per Hz.
    """

    omega: Float[Array, " frequencies"]  # rad/s
    density: Complex[Array, "frequencies channels channels"]  # Hermitian
    names: tuple[str, ...] = eqx.field(static=True)

    def power(self, name: str) -> Float[Array, " frequencies"]:
        """Power spectral density of one channel."""
        return jnp.real(self.cross(name, name))

    def cross(self, a: str, b: str) -> Complex[Array, " frequencies"]:
        """Cross-spectral density of `a` and `b`: its phase is that of b minus that of a."""
        return self.density[:, self._position(a), self._position(b)]

    def coherence(self, a: str, b: str) -> Float[Array, " frequencies"]:
        """Magnitude-squared coherence, from 0 to 1."""
        return jnp.abs(self.cross(a, b)) ** 2 / (self.power(a) * self.power(b))

    def _position(self, name: str) -> int:
        if name not in self.names:
            raise ValueError(
                f"there is no channel {name!r}: the channels are {', '.join(self.names)}"
            )
        return self.names.index(name)


@one_blas_thread()
def spectral_density(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | float | int | None = None,
    *,
    welch: Welch | None = None,
) -> SpectralDensity:
    """Estimate the power and cross spectral densities of all channels.

    **Arguments:**

    - `record`: one `Record`, or several with the same channels and sample rate, which are taken
        together.
    - `omega`: frequencies in rad/s, increasing; by default 100 log-spaced ones from three cycles in
        a window to a tenth of the sample rate.
    - `welch`: window and overlap, by default `jq.spectra.Welch()`. Its integrators and delay apply
        to the outputs only.

    **Returns:** a `SpectralDensity`.

    **Raises:**

    - `ValueError`: for frequencies that the window does not resolve, and records that differ.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits; call `jq.enable_x64()` first.
    """
    records = [record] if isinstance(record, Record) else list(record)
    check_compatible(records)
    welch = Welch() if welch is None else welch
    omega = frequencies_for(omega, records, welch)
    segments = transform_records(records, omega, [welch])
    [transforms], [(length, _)] = segments.transforms, segments.groups
    level, cosine = coefficients(welch.shape)
    energy = length * (level**2 + cosine**2 / 2)
    scale = 2 * records[0].dt / (energy * transforms.shape[1])
    put = jax.device_put
    return SpectralDensity(put(omega), put(cross_products(transforms) * scale), records[0].names)
