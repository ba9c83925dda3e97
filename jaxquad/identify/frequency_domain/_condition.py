"""How a model differs in one of several records."""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad._core import pytree_node, require_finite, require_positive

from ._parameters import find_place, Numbers, with_values


Condition = Callable[[PyTree], PyTree]


@pytree_node
class _ByFunction:
    """A condition that is a function, into which JAX cannot look."""

    change: Condition = eqx.field(static=True)

    def __call__(self, model: PyTree) -> PyTree:
        return self.change(model)


def _same(model: PyTree) -> PyTree:
    return model


UNCHANGED = _ByFunction(_same)  # the condition of a record that was taken on the model as it is


@pytree_node
class Changed:
    """A known change of one parameter, in one of the records of a fit.

    A weight on the arms, another propeller: it tells parameters apart of which one record shows
    the ratio alone. The parameter counts as `times * value + plus`.

    **Arguments:**

    - `parameter`: its name, as in `free=`.
    - `plus`: what is added, in the parameter's unit.
    - `times`: a factor, above 0.

    **Raises:** ValueError for what is not one finite number each, and where both change nothing.

    A function of the model does the same. This one pickles, and fits with it keep their compiled
    program for the next process.

    !!! example

        ```python
        loaded = jq.identify.Changed("J_x", plus=0.0276)
        fit = jq.fit(model, (frf, frf_loaded), conditions=(None, loaded))
        ```
    """

    parameter: str = eqx.field(static=True)
    plus: float | Float[Numbers, ""] = 0.0
    times: float | Float[Numbers, ""] = 1.0

    def __post_init__(self):
        for name in ("plus", "times"):  # arrays: other numbers run the same program
            number = np.asarray(getattr(self, name), dtype=float)
            if number.ndim:
                raise ValueError(f"{name} has the shape {number.shape}: give one number")
            object.__setattr__(self, name, number)
        require_finite("plus", self.plus)
        require_positive("times", self.times)
        if self.plus == 0.0 and self.times == 1.0:
            raise ValueError(f"{self.parameter} is not changed: give plus= or times=")

    def __call__(self, model: PyTree) -> PyTree:
        """The model with the change."""
        place = find_place(model, self.parameter, "for a condition")
        arrays = [leaf for leaf in jax.tree.leaves(model) if eqx.is_inexact_array(leaf)]
        value = self.times * arrays[place.leaf].reshape(-1)[place.index] + self.plus
        return with_values(model, (place,), value[None])


def require_conditions(
    model: PyTree, conditions: Sequence[Condition | None] | None, count: int
) -> list[Condition]:
    """One for each of `count` responses, all of them pytrees.

    ValueError for another number, and for what is no condition.
    """
    given = [None] * count if conditions is None else list(conditions)
    if len(given) != count:
        raise ValueError(
            f"{len(given)} conditions for {count} responses: give one for each, None where the "
            "model holds as it is"
        )
    for each in given:
        if isinstance(each, Changed):
            find_place(model, each.parameter, "for a condition")
        elif each is not None and not callable(each):
            raise ValueError(
                f"condition {each!r} is no change of the model: give None, "
                "jq.identify.Changed(name, change), or a function from a model to a model"
            )
    return [_as_node(each) for each in given]


def _as_node(condition: Condition | None) -> Condition:
    if condition is None:
        return UNCHANGED
    return _ByFunction(condition) if jax.tree_util.all_leaves([condition]) else condition
