"""Records from a loop whose controller is known: residuals as the loop leaves them."""

from typing import Protocol, runtime_checkable

import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import Message
from jaxquad.models import simulate_linear, StateSpace, TransferFunction
from jaxquad.records import Record


@runtime_checkable
class SampledFeedback(Protocol):
    """x[k+1] = A x + By y, u = C x + Dy y: a controller from the output to the input.

    Its reference does not matter. By and Dy carry the sign of the feedback.
    """

    @property
    def A(self) -> Float[Array, "states states"]: ...
    @property
    def measurement_in(self) -> Float[Array, " states"]: ...  # By
    @property
    def C(self) -> Float[Array, " states"]: ...
    @property
    def measurement_through(self) -> Float[Array, ""]: ...  # Dy
    @property
    def dt(self) -> float: ...  # s


@runtime_checkable
class KnownController(Protocol):
    """A controller that can say what it does without its limits, as `jq.PID` and `jq.LADRC` do."""

    def linear(self, axis: int = 0) -> SampledFeedback:
        """One axis."""
        ...


def feedback_response(
    loop: KnownController, record: Record, hold: str
) -> Float[np.ndarray, " samples"]:
    """The command of a controller after a unit sample of the output, over the record.

    Raise ValueError for a record that it cannot have closed a loop in.
    """
    if not isinstance(loop, KnownController):
        raise ValueError(
            f"loop is a {type(loop).__name__}: give the controller that closed the loop, with a "
            "method linear(), as jq.PID and jq.LADRC"
        )
    if len(record.input_names) != 1 or len(record.output_names) != 1:
        raise ValueError(
            Message(
                "loop= is for one input and one output, the record has "
                f"{', '.join(record.input_names)} and {', '.join(record.output_names)}: "
                "«pick channels with jq.records.select»"
            )
        )
    known = loop.linear()
    if not np.isclose(known.dt, record.dt, rtol=1e-6) or hold != "zero":
        raise ValueError(
            Message(
                f"the controller computes every {known.dt:.6g} s a command that it holds, but the "
                f"record has samples every {record.dt:.6g} s and an input that is "
                f"{'held' if hold == 'zero' else 'not held'}: give a record at the controller's "
                "rate with «hold=» its interval"
            )
        )
    A, B, C = (np.asarray(x, float) for x in (known.A, known.measurement_in, known.C))
    found, state = np.zeros(record.samples), B
    found[0] = float(known.measurement_through)
    for k in range(1, record.samples):
        found[k], state = C @ state, A @ state
    return found


_FIRST = 64  # samples of a series that are inverted by a triangular solve


def close_loop(
    plant: TransferFunction | StateSpace,
    x: Float[Array, "samples outputs *columns"],
    feedback: Float[Array, " samples"],
    dt: float,
) -> Float[Array, "samples outputs *columns"]:
    """What a disturbance `x` of the output becomes in the loop, which rested before: S x.

    S = 1 / (1 - G C) as a series in the delay, with the sampled plant G and C from the output to
    the input. Of x = y - G u it leaves y - T r, with the response T of the loop to its references:
    the noise that feedback returns to u is gone.
    Source: Ljung, System Identification, sec. 13.5 (indirect identification).
    """
    samples = len(x)
    pulse = jnp.zeros(samples).at[0].set(1.0)
    inputs = pulse if isinstance(plant, TransferFunction) else pulse[:, None]
    response = jnp.asarray(simulate_linear(plant, inputs, dt)).reshape(samples)
    sensitivity = invert_series(pulse - convolve(response, feedback))
    return convolve(sensitivity, x)


def convolve(
    kernel: Float[Array, " samples"], x: Float[Array, " samples *columns"]
) -> Float[Array, " samples *columns"]:
    """The first samples of a convolution; both begin at rest."""
    length = 2 * len(x)
    spectrum = jnp.fft.rfft(kernel, length).reshape(-1, *(1,) * (x.ndim - 1))
    return jnp.fft.irfft(spectrum * jnp.fft.rfft(x, length, axis=0), length, axis=0)[: len(x)]


def invert_series(a: Float[Array, " samples"]) -> Float[Array, " samples"]:
    """The series b with a * b = 1, 0, 0, ..., by Newton's method: each step doubles what is right.

    Source: Knuth, The Art of Computer Programming, vol. 2, sec. 4.7.
    """
    known = min(_FIRST, len(a))
    rows = jnp.arange(known)
    late = rows[:, None] - rows[None, :]
    matrix = jnp.where(late >= 0, a[jnp.abs(late)], 0.0)
    found = jsl.solve_triangular(matrix, jnp.zeros(known).at[0].set(1.0), lower=True)
    while known < len(a):
        known = min(2 * known, len(a))
        found = jnp.pad(found, (0, known - len(found)))
        left = (2 * jnp.zeros(known).at[0].set(1.0)) - convolve(a[:known], found)
        found = convolve(found, left)
    return found
