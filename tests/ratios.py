"""Transfer functions as models, padded to one shape."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike

from jaxquad.models import imaginary


class Ratio(eqx.Module):
    """b(s) / a(s) exp(-delay s), padded to one shape so that all tests share their compiles."""

    b: jax.Array
    a: jax.Array
    delay: jax.Array

    def frequency_response(self, omega):
        s = imaginary(omega)
        b, a = (jnp.polyval(c.astype(s.dtype), s) for c in (self.b, self.a))
        return (b / a * jnp.exp(-self.delay.astype(s.dtype) * s))[:, None, None]


def ratio(b, a, delay: ArrayLike = 0.0):
    b, a = (np.concatenate([np.zeros(6 - np.size(c)), np.atleast_1d(c)]) for c in (b, a))
    return Ratio(jnp.asarray(b), jnp.asarray(a), jnp.asarray(delay, float))


def delayed_integrator(gain, delay):
    return ratio([gain], [1.0, 0.0], delay)
