import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ._law import as_law, Law, law_or_none


class Payload(eqx.Module):
    """Inertia that members pick up in flight `at` a time in s, for `width` s (None: to the end).

    `added` is in units of the plant's own inertia: 1.0 doubles it, a negative number sets down what
    was carried from the start. Each of the three is a number or a law, of which each member has its
    own draw; times are rounded to samples. The controller is not told.
    Raises ValueError for times before the start.
    """

    added: Law = eqx.field(converter=as_law)
    at: Law = eqx.field(converter=as_law, kw_only=True)  # s
    width: Law | None = eqx.field(converter=law_or_none, default=None, kw_only=True)  # s


class Carried(eqx.Module):
    """The payload of each member."""

    inertia: Float[Array, "axes members"]  # kg m^2
    at: Float[Array, " members"]  # s
    until: Float[Array, " members"]  # s
    latest: float = eqx.field(static=True)  # s, that `at` can be

    def signal(self, samples: int, dt: float) -> Float[Array, "samples axes members"]:
        """The added inertia in kg m^2, sample by sample.

        Raises ValueError for a payload that can come after the last sample.
        """
        if self.latest >= samples * dt:
            raise ValueError(
                f"a payload is picked up as late as {self.latest:.6g} s, but the scenario ends at "
                f"{samples * dt:.6g} s: lengthen it, or let Payload(at=...) be earlier"
            )
        index = jnp.arange(samples)[:, None]
        first, last = (jnp.round(t / dt)[None] for t in (self.at, self.until))
        index = index.astype(first.dtype)
        return jnp.where((index >= first) & (index < last), 1.0, 0.0)[:, None] * self.inertia[None]
