import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import is_concrete

from ._state_space import StateSpace
from ._transfer_function import TransferFunction


@eqx.filter_jit  # one compilation instead of one for each small operation
def realise(
    model: TransferFunction,
) -> tuple[
    Float[Array, "states states"],
    Float[Array, "states 1"],
    Float[Array, "1 states"],
    Float[Array, "1 1"],
]:
    """A, B, C, D of dx/dt = A x + B u, y = C x + D u: the model without its delay.

    The controllable canonical form, in a time measured in units of the fastest pole: written in
    seconds, its coefficients spread over many decades and its exponential loses digits.
    """
    states = model.denominator.size - 1
    missing = model.denominator.size - model.numerator.size
    a = (model.denominator / model.denominator[0])[1:]
    b = jnp.pad(model.numerator / model.denominator[0], (missing, 0))
    powers = jnp.arange(1, states + 1, dtype=a.dtype)
    speed = _fastest(a, powers)
    a, c = a / speed**powers, (b[1:] - b[0] * a) / speed**powers
    first = jnp.eye(states, 1, dtype=a.dtype)
    A = speed * (jnp.eye(states, k=-1, dtype=a.dtype) - first * a[None])
    return A, speed * first, c[None], b[:1, None]


def _fastest(a: Float[Array, " states"], powers: Float[Array, " states"]) -> Float[Array, ""]:
    # The input-output behaviour does not depend on this scale, hence neither does its gradient.
    speed = jnp.max(jax.lax.stop_gradient(jnp.abs(a)) ** (1 / powers), initial=0)
    return jnp.where(speed > 0, speed, 1)


def state_space(model: TransferFunction) -> StateSpace:
    """A transfer function as a `StateSpace`; its delay becomes that of the input.

    The states are those of `realise`. A direct passage from input to output, which H0 x + H1 x'
    does not have, becomes a share of x'.

    **Raises:**

    - `ValueError`: the model is a pure gain, which has no states.
    """
    A, B, C, D = realise(model)
    if not len(A):
        raise ValueError(
            f"numerator {model.numerator} and denominator {model.denominator} are a pure gain "
            "without states: scale G or H0 of a neighbouring model by it."
        )
    late = model.delay[None]
    if model.numerator.size < model.denominator.size:
        return StateSpace(F=A, G=B, H0=C, input_delay=late)
    # x' = A x + B u with B = (b, 0, ...): D / b of the first derivative holds D u.
    H1 = jnp.zeros_like(C).at[0, 0].set(D[0, 0] / B[0, 0])
    return StateSpace(F=A, G=B, H0=C - jnp.dot(H1, A, precision="highest"), H1=H1, input_delay=late)


def series(first: StateSpace, second: StateSpace) -> StateSpace:
    """Two models in series: the outputs of `first` drive the inputs of `second`.

    **Returns:**

    The model whose response is that of `second` times that of `first`.

    **Raises:**

    - `ValueError`: the numbers of outputs and inputs differ, or several signals between the two
        models have different delays, which no delay of an input or output can replace.
    """
    made, taken = first.H0.shape[0], second.G.shape[1]
    if made != taken:
        raise ValueError(
            f"The first model has {made} outputs, the second {taken} inputs: pick channels with "
            "model.select."
        )
    between = _common_delay(_add_delays(first.output_delay, second.input_delay))
    late = first.input_delay
    if between is not None:
        late = _add_delays(late, jnp.broadcast_to(between, (first.G.shape[1],)))
    driven = -_dot(second.G, _zeros_if_none(first.H1, first.H0))
    return StateSpace(
        F=_blocks(first.F, _dot(second.G, first.H0), second.F),
        G=jnp.concatenate([first.G, jnp.zeros((len(second.F), first.G.shape[1]), first.G.dtype)]),
        H0=_pad_left(first, second.H0),
        H1=None if second.H1 is None else _pad_left(first, second.H1),
        M=_mass(first, second, driven),
        input_delay=late,
        output_delay=second.output_delay,
    )


def _mass(first: StateSpace, second: StateSpace, driven: Array) -> Array | None:
    if first.M is None and second.M is None and first.H1 is None:
        return None
    ones = [jnp.eye(len(each.F), dtype=each.F.dtype) for each in (first, second)]
    return _blocks(_default(first.M, ones[0]), driven, _default(second.M, ones[1]))


def _blocks(upper: Array, across: Array, lower: Array) -> Float[Array, "states states"]:
    none = jnp.zeros((len(upper), len(lower)), upper.dtype)
    return jnp.block([[upper, none], [across, lower]])


def _pad_left(first: StateSpace, H: Array) -> Float[Array, "outputs states"]:
    return jnp.concatenate([jnp.zeros((len(H), len(first.F)), H.dtype), H], axis=1)


def _common_delay(late: Float[Array, " signals"] | None) -> Float[Array, ""] | None:
    if late is None or late.size == 1:
        return None if late is None else late[0]
    if is_concrete(late) and np.ptp(np.asarray(late)) == 0:
        return late[0]
    raise ValueError(
        f"The signals between the models have the delays {late} s: give them one known delay, or "
        "put the delays on the first inputs and the last outputs."
    )


def _add_delays(a: Array | None, b: Array | None) -> Array | None:
    return b if a is None else a if b is None else a + b


def _zeros_if_none(matrix: Array | None, like: Array) -> Array:
    return jnp.zeros_like(like) if matrix is None else matrix


def _default(matrix: Array | None, otherwise: Array) -> Array:
    return otherwise if matrix is None else matrix


def _dot(a: Array, b: Array) -> Array:
    return jnp.dot(a, b, precision="highest")
