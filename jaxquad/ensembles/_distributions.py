"""Probability distributions for uncertain parameters, and points to draw from them at."""

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Key

from jaxquad._core import as_array, is_concrete, require_finite, require_positive


Numbers = Float[np.ndarray, "..."]  # [] or [axes]


def as_numbers(value: ArrayLike | Sequence[float]) -> Numbers:
    """In double precision, outside JAX: members are drawn before anything is compiled."""
    return np.asarray(value, dtype=float)


def row(value: Numbers) -> Float[np.ndarray, "axes 1"]:
    """`value` as a column that broadcasts over members."""
    return np.atleast_1d(value)[:, None]


def number(value: Numbers) -> str:
    """For a table: one number, or one for each axis."""
    return "/".join(f"{float(x):.4g}" for x in np.atleast_1d(value))


def check_axes(**values: Numbers) -> None:
    """Raise ValueError for values of more than one dimension, or of different numbers of axes."""
    shapes = {name: value.shape for name, value in values.items()}
    if any(len(shape) > 1 for shape in shapes.values()) or len(set(shapes.values()) - {()}) > 1:
        text = ", ".join(f"{name} {shape}" for name, shape in shapes.items())
        raise ValueError(
            f"the numbers of a distribution have the shapes {text}: give one for all axes, or "
            "one for each axis"
        )


Shares = Float[np.ndarray, "rows members"]  # of the probability, 0 to 1
Values = Float[np.ndarray, "axes members"]


class Distribution(eqx.Module):
    """A probability distribution of one quantity; its numbers are scalars, or `[axes]`.

    All samplings go through `quantile`, so no value outside the `support` is ever drawn.
    """

    @abc.abstractmethod
    def quantile(self, u: Shares) -> Values:
        """The values that are exceeded with the probability 1 - `u`."""

    @property
    @abc.abstractmethod
    def support(self) -> tuple[Numbers, Numbers]:
        """The least and the greatest value that can be drawn."""

    @property
    def varies(self) -> bool:
        """Whether members differ."""
        return True

    @property
    def relative(self) -> bool:
        """Whether its numbers are in units of the nominal value."""
        return False

    def grid_levels(self, count: int) -> Float[np.ndarray, " count"]:
        """The probabilities at which a grid of `count` levels has its values."""
        return (np.arange(count) + 0.5) / count

    def about(self, nominal: Numbers | None, name: str) -> "Distribution":
        """The distribution in SI units, given the `nominal` value of the quantity `name`."""
        return self

    def log_density(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """The natural logarithm of the density at `x`, -inf outside the `support`; by JAX.

        **Raises:** ValueError for a distribution without a density.
        """
        raise ValueError(
            f"a jq.ensembles.{type(self).__name__} has no density: give Uniform, LogUniform, "
            "Normal or LogNormal"
        )

    @property
    @abc.abstractmethod
    def text(self) -> str:
        """In words, for a table."""


class Fixed(Distribution):
    """One value for all members.

    **Arguments:**

    - `value`: a number, or one for each axis.
    """

    value: Numbers = eqx.field(converter=as_numbers)

    def __check_init__(self):
        check_axes(value=self.value)
        require_finite("value", self.value)

    def quantile(self, u: Shares) -> Values:
        return row(self.value) + np.zeros_like(u)

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        return self.value, self.value

    @property
    def varies(self) -> bool:
        return False

    @property
    def text(self) -> str:
        return number(self.value)


class Choice(Distribution):
    """One of several values, all equally likely.

    **Arguments:**

    - `values`: two or more, in one row.

    **Raises:**

    - `ValueError`: there are fewer, or one is not finite.
    """

    values: Float[np.ndarray, "..."] = eqx.field(converter=as_numbers)  # one row

    def __check_init__(self):
        if self.values.ndim != 1 or self.values.size < 2:
            raise ValueError(f"Choice has values {self.values}: give two or more in one row")
        require_finite("values", self.values)

    def quantile(self, u: Shares) -> Values:
        count = self.values.size
        return self.values[np.minimum((u * count).astype(int), count - 1)]

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        return np.asarray(self.values.min()), np.asarray(self.values.max())

    @property
    def text(self) -> str:
        return "one of " + ", ".join(f"{x:.4g}" for x in self.values)


def as_distribution(value: Distribution | ArrayLike | Sequence[float]) -> Distribution:
    """A distribution as it is; a number, or one for each axis, as `Fixed`."""
    return value if isinstance(value, Distribution) else Fixed(value)


def distribution_or_none(
    value: Distribution | ArrayLike | Sequence[float] | None,
) -> Distribution | None:
    return None if value is None else as_distribution(value)


REACH = 4.0  # standard deviations at which normal distributions end
_TAIL = 3.167124183311998e-05  # of the normal distribution beyond the reach
_DEVIATION = "it is a standard deviation; for a quantity that does not vary give a plain number"


class Uniform(Distribution):
    """Uniform between two values.

    **Arguments:**

    - `low`, `high`: the ends, scalars or one for each axis.

    **Raises:**

    - `ValueError`: unless low < high, both finite.
    """

    low: Numbers = eqx.field(converter=as_numbers)
    high: Numbers = eqx.field(converter=as_numbers)

    def __check_init__(self):
        check_axes(low=self.low, high=self.high)
        require_finite("low", self.low)
        require_finite("high", self.high)
        if not np.all(self.low < self.high):
            raise ValueError(
                f"a distribution from {number(self.low)} to {number(self.high)} is empty: give low "
                "< high, or a plain number for a quantity that does not vary"
            )

    def quantile(self, u: Shares) -> Values:
        low, high = row(self.low), row(self.high)
        return np.clip(low + (high - low) * u, low, high)

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        return self.low, self.high

    def log_density(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        inside = (x >= self.low) & (x <= self.high)
        return jnp.where(inside, -jnp.log(self.high - self.low), -np.inf)

    def grid_levels(self, count: int) -> Float[np.ndarray, " count"]:
        return np.linspace(0.0, 1.0, count) if count > 1 else np.array([0.5])  # with both ends

    @property
    def text(self) -> str:
        return f"uniform {number(self.low)} .. {number(self.high)}"


class LogUniform(Uniform):
    """Uniform in the logarithm, for quantities that are known up to a factor.

    **Arguments:** and **Raises:** as of `jq.ensembles.Uniform`; both ends are above 0.
    """

    def __check_init__(self):
        Uniform.__check_init__(self)  # what it says comes first
        remedy = "a ratio needs it; use jq.ensembles.Uniform for a range with 0"
        require_positive("low", self.low, remedy)

    def quantile(self, u: Shares) -> Values:
        low, high = row(self.low), row(self.high)
        return np.clip(low * (high / low) ** u, low, high)

    def log_density(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        inside = (x >= self.low) & (x <= self.high)
        density = -jnp.log(jnp.where(inside, x, 1.0)) - jnp.log(jnp.log(self.high / self.low))
        return jnp.where(inside, density, -np.inf)

    @property
    def text(self) -> str:
        return f"log-uniform {number(self.low)} .. {number(self.high)}"


class Normal(Distribution):
    """Normal, truncated at 4 standard deviations.

    **Arguments:**

    - `deviation`: the standard deviation. Without a `mean` it is relative to the nominal value:
        `Normal(0.05)` is 5 % of it.
    - `mean`: in the unit of the quantity; by default the nominal value.

    **Raises:**

    - `ValueError`: the deviation is not above 0.
    """

    deviation: Numbers = eqx.field(converter=as_numbers)
    mean: Numbers | None = eqx.field(
        converter=lambda x: None if x is None else as_numbers(x), default=None
    )

    def __check_init__(self):
        check_axes(deviation=self.deviation, mean=self._mean)
        require_positive("deviation", self.deviation, _DEVIATION)
        require_finite("mean", self._mean)

    @property
    def _mean(self) -> Numbers:
        return np.asarray(1.0) if self.mean is None else self.mean

    def quantile(self, u: Shares) -> Values:
        return row(self._mean) + row(self.deviation) * normal_scores(u)

    def log_density(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        if self.mean is None:
            raise ValueError(
                "a relative jq.ensembles.Normal has no density: give Normal(deviation, mean=...)"
            )
        return _log_normal((x - self.mean) / self.deviation) - jnp.log(self.deviation)

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        reach = REACH * self.deviation
        return np.asarray(self._mean - reach), np.asarray(self._mean + reach)

    @property
    def relative(self) -> bool:
        return self.mean is None

    def about(self, nominal: Numbers | None, name: str) -> Distribution:
        if self.mean is not None:
            return self
        if nominal is None:
            raise ValueError(
                f"{name} is Normal({number(self.deviation)}), relative to a nominal value that the "
                "loop does not have: give the mean, jq.ensembles.Normal(deviation, mean=...)"
            )
        return Normal(self.deviation * np.abs(nominal), nominal)

    @property
    def text(self) -> str:
        return f"normal {number(self._mean)} +- {number(self.deviation)}"


class LogNormal(Distribution):
    """Log-normal, truncated at 4 standard deviations of the logarithm.

    For spreads too wide for `jq.ensembles.Normal`, whose values would reach 0.

    **Arguments:**

    - `deviation`: the standard deviation of the natural logarithm.
    - `median`: in the unit of the quantity.

    **Raises:**

    - `ValueError`: the deviation or the median is not above 0.
    """

    deviation: Numbers = eqx.field(converter=as_numbers)
    median: Numbers = eqx.field(converter=as_numbers, default=1.0)

    def __check_init__(self):
        check_axes(deviation=self.deviation, median=self.median)
        require_positive("deviation", self.deviation, _DEVIATION)
        require_positive("median", self.median, "logarithms need it")

    def quantile(self, u: Shares) -> Values:
        return row(self.median) * np.exp(row(self.deviation) * normal_scores(u))

    def log_density(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        logarithm = jnp.log(jnp.where(x > 0, x, 1.0))
        density = _log_normal((logarithm - jnp.log(self.median)) / self.deviation)
        return jnp.where(x > 0, density - jnp.log(self.deviation) - logarithm, -np.inf)

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        factor = np.exp(REACH * self.deviation)
        return np.asarray(self.median / factor), np.asarray(self.median * factor)

    @property
    def text(self) -> str:
        return f"log-normal {number(self.median)} */ exp({number(self.deviation)})"


def _log_normal(score: Float[Array, "..."]) -> Float[Array, "..."]:
    """Of the standard normal distribution without its tails."""
    density = -0.5 * score**2 - 0.5 * np.log(2 * np.pi) - np.log1p(-2 * _TAIL)
    return jnp.where(jnp.abs(score) <= REACH, density, -np.inf)


def normal_scores(u: Shares) -> Shares:
    """Standard normal values at the probabilities `u`, between -4 and 4."""
    from scipy.special import ndtri

    return ndtri(_TAIL + (1 - 2 * _TAIL) * u)


SAMPLINGS = ("latin", "random", "sobol", "grid")


def make_generator(key: Key[Array, ""]) -> np.random.Generator:
    """Random numbers of a key, outside JAX: nothing is compiled, and both precisions get the same.

    Raise ValueError under jit.
    """
    if not is_concrete(key):
        raise ValueError("members are drawn outside jit, vmap and grad: pass drawn members in")
    return np.random.default_rng(np.asarray(jax.random.key_data(key)).ravel())


def make_member_keys(key: Key[Array, ""], members: int) -> Key[Array, " members"]:
    """A key for each member; more members leave the first ones' as they are."""
    random = make_generator(jax.random.fold_in(key, 1))
    words = random.integers(0, 2**32, (members, 2), dtype=np.uint32)
    # Other generators draw numbers under vmap that depend on how many members there are.
    return jax.random.wrap_key_data(as_array(words), impl="threefry2x32")


def draw_unit_points(sampling: str, key: Key[Array, ""], rows: int, members: int) -> Shares:
    """Probabilities, one row for each number that a member draws."""
    random = make_generator(key)
    if sampling == "sobol":
        from scipy.stats import qmc

        if not rows:
            return np.zeros((0, members))
        # Powers of two are balanced; what is cut off is the end of a scrambled sequence.
        seeded: Any = {"seed": random}  # the name in SciPy 1.13, taken by those that call it rng
        return qmc.Sobol(rows, **seeded).random_base2((members - 1).bit_length())[:members].T
    inside = random.random((rows, members))
    if sampling == "random":
        return inside
    cells = np.stack([random.permutation(members) for _ in range(rows)]) if rows else inside
    return (cells + inside) / members


def make_grid(distributions: Sequence[Distribution], members: int) -> Shares:
    """Every combination of equally many levels of each; the last one changes fastest.

    Raise ValueError where `members` is no such number.
    """
    if not distributions:
        return np.zeros((0, members))
    count = round(members ** (1 / len(distributions)))
    if count ** len(distributions) != members:
        below = int(members ** (1 / len(distributions)))
        near = " or ".join(str(k ** len(distributions)) for k in (below, below + 1))
        raise ValueError(
            f"a grid over {len(distributions)} quantities has equally many levels of each, so "
            f"{members} members do not fill one: draw {near}, or use "
            'sampling="latin" for any number'
        )
    levels = np.meshgrid(*(one.grid_levels(count) for one in distributions), indexing="ij")
    return np.stack([level.ravel() for level in levels])
