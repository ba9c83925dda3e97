import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Complex, Float

from ._parameters import as_float, is_zero, require_finite, require_nonnegative
from ._transfer_function import imaginary, TransferFunction


class LaggedIntegrator(eqx.Module):
    """An axis in its fewest numbers: K e^(-delay s) / (s^integrators (lag s + 1)).

    From a moment command to a rate with one integration, to an angle with two. Lag and delay trade
    off: over a narrow band a record determines only their sum.
    Raises ValueError for a negative lag or delay.
    """

    gain: Float[Array, ""] = eqx.field(converter=as_float)  # K, output unit / s^integrators
    lag: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)  # T, s
    delay: Float[Array, ""] = eqx.field(converter=as_float, default=0.0)  # tau, s
    integrators: int = eqx.field(static=True, default=1)

    def __check_init__(self):
        require_finite("gain", self.gain)
        for name in ("lag", "delay"):
            require_nonnegative(name, getattr(self, name), "give seconds, and 0 for none")
        if self.integrators not in (0, 1, 2, 3):
            raise ValueError(f"integrators is {self.integrators}: give 0 to 3")

    def frequency_response(
        self, omega: Float[Array, " frequencies"]
    ) -> Complex[Array, "frequencies 1 1"]:
        """Response at `omega` in rad/s."""
        s = imaginary(omega)
        gain, lag, delay = (x.astype(s.dtype) for x in (self.gain, self.lag, self.delay))
        return (gain * jnp.exp(-delay * s) / ((lag * s + 1) * s**self.integrators))[:, None, None]

    def transfer_function(self) -> TransferFunction:
        """The same model as a ratio of polynomials; a known lag of 0 is left out."""
        one, zero = jnp.ones_like(self.lag), jnp.zeros_like(self.lag)
        first = [one] if is_zero(self.lag) else [self.lag, one]
        denominator = jnp.stack([*first, *[zero] * self.integrators])
        return TransferFunction(self.gain[None], denominator, self.delay)
