from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


Information = Float[Array, "parameters parameters"]


@runtime_checkable
class Criterion(Protocol):
    """What a design maximises: the logarithm of an amount of information.

    The amount has to be concave in the information matrix, and twice as large for two flights as
    for one, so that the ratio of two amounts is a ratio of flight times. `exponent` is that of the
    multiplicative update under which it never falls. Any object with these two members will do.
    """

    @property
    def exponent(self) -> float: ...

    def log_information(
        self, information: Information, names: tuple[str, ...]
    ) -> Float[Array, ""]: ...


class DOptimal(eqx.Module):
    """The smallest joint confidence region: log det M, over the number of parameters."""

    @property
    def exponent(self) -> float:
        return 1.0

    def log_information(self, information: Information, names: tuple[str, ...]) -> Float[Array, ""]:
        return jnp.linalg.slogdet(information)[1] / len(names)


class AOptimal(eqx.Module):
    """The smallest sum of the relative variances of the named parameters, or of all.

    With one name it is c-optimality: the smallest standard error of that parameter alone.
    """

    names: tuple[str, ...] = eqx.field(static=True, default=())

    @property
    def exponent(self) -> float:
        return 0.5

    def log_information(self, information: Information, names: tuple[str, ...]) -> Float[Array, ""]:
        wanted = _positions(self.names or names, names)
        return -jnp.log(jnp.sum(jnp.diagonal(jnp.linalg.inv(information))[wanted]))


class LargestError(eqx.Module):
    """The smallest worst relative error, as the `power` norm of the relative variances.

    A higher power is closer to the maximum, and slower: at 8, the worst of p equal variances
    counts p^(1/8) times itself.
    """

    power: int = eqx.field(static=True, default=8)

    def __check_init__(self):
        if not 1 <= self.power <= 32:
            raise ValueError(
                f"power is {self.power}: give 1 (the sum of variances) to 32; 8 is usual"
            )

    @property
    def exponent(self) -> float:
        return 1 / (1 + self.power)

    def log_information(self, information: Information, names: tuple[str, ...]) -> Float[Array, ""]:
        logs = jnp.log(jnp.diagonal(jnp.linalg.inv(information)))
        top = jnp.max(logs)
        return -top - jnp.log(jnp.sum(jnp.exp(self.power * (logs - top)))) / self.power


def _positions(wanted: tuple[str, ...], names: tuple[str, ...]) -> np.ndarray:
    for name in wanted:
        if name not in names:
            raise ValueError(f"{name!r} is no free parameter; free are: {', '.join(names)}")
    return np.array([names.index(name) for name in wanted])
