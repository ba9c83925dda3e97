import equinox as eqx
import jax
import jax.numpy as jnp


class Airframe(eqx.Module):
    """K wn^2 / (s^2 + 2 zeta wn s + wn^2) / (tau s + 1) exp(-delay s)."""

    K: jax.Array
    tau: jax.Array
    zeta: jax.Array
    wn: jax.Array
    delay: jax.Array

    def frequency_response(self, omega):
        s = jax.lax.complex(jnp.zeros_like(omega), omega)
        leaves = (self.K, self.tau, self.zeta, self.wn, self.delay)
        K, tau, zeta, wn, delay = (leaf.astype(s.dtype) for leaf in leaves)
        rigid = K * wn**2 / (s * s + 2 * zeta * wn * s + wn**2)
        return (rigid / (tau * s + 1) * jnp.exp(-delay * s))[:, None, None]
