"""What is known of a quantity before it is drawn."""

import abc
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import ArrayLike, Float

from ._law_values import as_numbers, check_axes, check_finite, number, Numbers, row


Shares = Float[np.ndarray, "rows members"]  # of the probability, 0 to 1
Values = Float[np.ndarray, "axes members"]


class Law(eqx.Module):
    """What is known of a quantity before it is drawn; numbers are one for all axes, or `[axes]`.

    All samplings share `quantile`, which makes values of shares of the probability, so that a law
    never gives a value outside its `support`.
    """

    @abc.abstractmethod
    def quantile(self, u: Shares) -> Values:
        """The values below which lies the share `u` of the probability."""

    @property
    @abc.abstractmethod
    def support(self) -> tuple[Numbers, Numbers]:
        """The least and the greatest value that can be drawn."""

    @property
    def varies(self) -> bool:
        """Whether members differ."""
        return True

    def levels(self, count: int) -> Float[np.ndarray, " count"]:
        """Shares of the probability that a grid of `count` values stands on."""
        return (np.arange(count) + 0.5) / count

    def about(self, value: Numbers | None, name: str) -> "Law":
        """The law where the quantity's own value is known: laws relative to it become absolute."""
        return self

    @property
    @abc.abstractmethod
    def text(self) -> str:
        """In words, for a table."""


class Fixed(Law):
    """One value for all members."""

    value: Numbers = eqx.field(converter=as_numbers)

    def __check_init__(self):
        check_axes(value=self.value)
        check_finite(value=self.value)

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


class Choice(Law):
    """One of several `values`, each as likely as the others."""

    values: Float[np.ndarray, "..."] = eqx.field(converter=as_numbers)  # one row

    def __check_init__(self):
        if self.values.ndim != 1 or self.values.size < 2:
            raise ValueError(f"Choice has values {self.values}: give two or more in one row")
        check_finite(values=self.values)

    def quantile(self, u: Shares) -> Values:
        count = self.values.size
        return self.values[np.minimum((u * count).astype(int), count - 1)]

    @property
    def support(self) -> tuple[Numbers, Numbers]:
        return np.asarray(self.values.min()), np.asarray(self.values.max())

    @property
    def text(self) -> str:
        return "one of " + ", ".join(f"{x:.4g}" for x in self.values)


def as_law(given: Law | ArrayLike | Sequence[Any]) -> Law:
    """A law as it is; a number, or one for each axis, is known exactly."""
    return given if isinstance(given, Law) else Fixed(given)


def law_or_none(given: Law | ArrayLike | Sequence[Any] | None) -> Law | None:
    return None if given is None else as_law(given)
