"""The least-squares problem of an output-error fit, and of a record from a known loop."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import jax.scipy.linalg as jsl
import numpy as np
from jaxtyping import Array, Float, Int, PyTree

from jaxquad._core import Message, Normal, solve_definite
from jaxquad.models import simulate_linear, StateSpace
from jaxquad.records import Record

from ..frequency_domain._parameters import Numbers
from ..frequency_domain._problem import prior_misfits, Problem
from ._noise import Whitener
from ._simulated import (
    band_filter,
    forced_response,
    free_response,
    integrate_plant,
    linear_model,
    Motions,
    Plant,
)


Series = Float[Array, " samples"]
Outputs = Float[Array, "samples outputs"]
Columns = Float[Array, "samples outputs *columns"]
Unknowns = Float[Array, "samples outputs unknowns"]
Sizes = Float[np.ndarray, " outputs"]
_RIDGE = 1e-10  # of the squared length of a column, and taken out again by refinement
_LOOSE = 1e-2  # standard errors per unit of initial state: holds what has no effect
_FIRST = 64  # samples of a series that are inverted by a triangular solve


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
    """The command after a unit sample of the output; ValueError where no such loop was closed."""
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
    controller = loop.linear()
    if not np.isclose(controller.dt, record.dt, rtol=1e-6) or hold != "zero":
        raise ValueError(
            Message(
                f"the controller computes every {controller.dt:.6g} s a command that it holds, but "
                f"the record has samples every {record.dt:.6g} s and an input that is "
                f"{'held' if hold == 'zero' else 'not held'}: give a record at the controller's "
                "rate with «hold=» its interval"
            )
        )
    parts = (controller.A, controller.measurement_in, controller.C)
    A, state, C = (np.asarray(part, float) for part in parts)
    command = np.zeros(record.samples)
    command[0] = float(controller.measurement_through)
    for k in range(1, record.samples):
        command[k], state = C @ state, A @ state
    return command


def close_loop(
    plant: Plant,
    x: Columns,
    feedback: Series,
    dt: float,
    direct_samples: Float[Numbers, "outputs inputs"] | None = None,
) -> Columns:
    """What a disturbance `x` of the output becomes in the loop, which rested before: S x.

    S = 1 / (1 - G C) as a series in the delay, with the sampled plant G and C from the output to
    the input. Of x = y - G u it leaves y - T r, with the response T of the loop to its references:
    the noise that feedback returns to u is gone.
    Source: Ljung, System Identification, sec. 13.5 (indirect identification).
    """
    samples = len(x)
    pulse = jnp.zeros(samples).at[0].set(1.0)
    inputs = pulse[:, None] if isinstance(plant, StateSpace) else pulse
    response = simulate_linear(plant, inputs, dt, direct_samples=direct_samples)
    response = jnp.asarray(response).reshape(samples)
    sensitivity = invert_series(pulse - convolve(response, feedback))
    return convolve(sensitivity, x)


def convolve(
    kernel: Series, x: Float[Array, " samples *columns"]
) -> Float[Array, " samples *columns"]:
    """The first samples of a convolution; both begin at rest."""
    length = 2 * len(x)
    spectrum = jnp.fft.rfft(kernel, length).reshape(-1, *(1,) * (x.ndim - 1))
    return jnp.fft.irfft(spectrum * jnp.fft.rfft(x, length, axis=0), length, axis=0)[: len(x)]


def invert_series(a: Series) -> Series:
    """The series b with a * b = 1, 0, 0, ..., by Newton's method: each step doubles what is right.
    Source: Knuth, The Art of Computer Programming, vol. 2, sec. 4.7."""
    count = min(_FIRST, len(a))
    late = jnp.arange(count)[:, None] - jnp.arange(count)[None, :]
    matrix = jnp.where(late >= 0, a[jnp.abs(late)], 0.0)
    b = jsl.solve_triangular(matrix, jnp.zeros(count).at[0].set(1.0), lower=True)
    while count < len(a):
        count = min(2 * count, len(a))
        b = jnp.pad(b, (0, count - len(b)))
        b = convolve(b, (2 * jnp.zeros(count).at[0].set(1.0)) - convolve(a[:count], b))
    return b


class RecordTerm(eqx.Module):
    """A record as the fit sees it."""

    u: Float[Numbers, "samples inputs"]
    y: Float[Numbers, "samples outputs"]  # within the band
    weights: Float[Numbers, " outputs"]  # one over the residual's standard deviation
    gain: Float[Numbers, " bins"] | None  # of the band, over frequency
    motions: tuple[Float[Numbers, "states slow"], Float[Numbers, "states fast"]] | None
    start: Float[Numbers, " unknown"]  # units of an unknown initial state; none if it is eliminated
    dt: float = eqx.field(static=True)
    hold: str = eqx.field(static=True)
    whitener: Whitener | None = None  # of the noise, where it has a model
    feedback: Float[Numbers, " samples"] | None = None  # of a known loop, after a unit of output
    # After how many samples a held input passes directly, where a free delay would change it.
    direct_samples: Float[Numbers, "outputs inputs"] | None = None

    def weighted(self, x: Float[Numbers, "samples outputs *columns"]) -> Columns:
        """What counts of outputs: within the band, unpredicted by the noise, in units of it."""
        x = jnp.asarray(x)
        counted = band_filter(x, self.gain) if self.whitener is None else self.whitener(x)
        return jnp.asarray(counted) * self.weights.reshape(1, -1, *(1,) * (x.ndim - 2))

    @property
    def measured(self) -> Float[Numbers, "samples outputs"]:
        """The measured output as `weighted` sees it."""
        return self.y * self.weights[None] if self.whitener is None else self.weighted(self.y)

    @property
    def counted(self) -> Int[np.ndarray, " outputs"]:
        """Samples of each output that the noise model predicts."""
        samples, outputs = self.y.shape
        first = np.zeros(outputs, int) if self.whitener is None else self.whitener.start
        return samples - np.asarray(first)


class OutputError(eqx.Module):
    """Residuals of all records as a function of the free parameters and the initial states."""

    base: Problem  # model, parameters and priors
    terms: tuple[RecordTerm, ...]
    zeros: tuple[int, ...] = eqx.field(static=True)  # arrays of the model that are known to be 0

    def reweighted(self, sizes: Sequence[Sizes]) -> "OutputError":
        """The same problem with its residuals divided by `sizes`."""
        terms = [
            dataclasses.replace(term, weights=np.asarray(term.weights) / size)
            for term, size in zip(self.terms, sizes, strict=True)
        ]
        return dataclasses.replace(self, terms=tuple(terms))

    @property
    def unknown(self) -> int:
        """How many initial states follow the parameters in z."""
        return sum(term.start.size for term in self.terms)


def insert_parameters(z: Float[Numbers, " n"], problem: OutputError) -> PyTree:
    """The model at these parameters; what is 0 and fixed stays known to be 0 under jit."""
    model = problem.base.parameters.insert(problem.base.model, z)
    arrays, rest = eqx.partition(model, eqx.is_inexact_array)
    leaves, structure = jax.tree.flatten(arrays)
    for k in problem.zeros:
        leaves[k] = np.zeros(leaves[k].shape, leaves[k].dtype)
    return eqx.combine(jax.tree.unflatten(structure, leaves), rest)


def misfit_and_columns(
    model: PyTree, start: Float[Array, " unknown"], term: RecordTerm
) -> tuple[Outputs, Unknowns]:
    """Weighted misfit at zero start and trim, and what each unit of them adds to the output."""
    if term.motions is None:
        simulated = integrate_plant(model, term.u, term.start * start, term.dt, term.hold)
        shifts = jnp.eye(term.y.shape[1])[None]
        columns = jnp.broadcast_to(shifts, (*term.y.shape, term.y.shape[1]))
    else:
        plant = linear_model(model)
        direct = term.direct_samples
        simulated = forced_response(plant, term.u, term.dt, term.hold, direct)
        motions = Motions(*term.motions, ())
        columns = free_response(plant, motions, len(term.u), term.dt)
        if term.feedback is not None:
            feedback = jnp.asarray(term.feedback)
            closed = lambda x: term.weighted(close_loop(plant, x, feedback, term.dt, direct))
            return closed(term.y - simulated), closed(columns)
    return jnp.asarray(term.measured) - term.weighted(simulated), term.weighted(columns)


def project_out(misfit: Outputs, columns: Unknowns) -> Outputs:
    """The `misfit` that no start, trim or shift explains (variable projection)."""
    flat = columns.reshape(misfit.size, -1)
    square = jax.lax.stop_gradient(jnp.sum(flat**2, axis=0))
    flat = flat / jnp.sqrt(jnp.where(square > 1e-20 * jnp.max(square), square, 1.0))[None]
    normal = jnp.dot(flat.T, flat, precision="highest")
    aim = flat.T @ misfit.reshape(-1)
    ridged = normal + _RIDGE * jnp.eye(aim.size)

    def refine(_, unknowns):
        return unknowns + solve_definite(ridged, aim - normal @ unknowns)[0]

    unknowns = jax.lax.fori_loop(0, 3, refine, jnp.zeros_like(aim))
    return misfit - (flat @ unknowns).reshape(misfit.shape)


class Evaluation(NamedTuple):
    """Misfits, slopes and columns at one place, record by record; all weighted."""

    misfits: Sequence[Float[Numbers, "samples outputs"]]
    slopes: Sequence[Float[Numbers, "samples outputs n"]]  # by parameters, then initial states
    columns: Sequence[Float[Numbers, "samples outputs unknowns"]]  # of start, trim and shift
    normal: Normal  # of these, of the priors and of a hold on the initial states

    def reweighted(self, sizes: Sequence[Sizes]) -> "Evaluation":
        """The same, divided by `sizes`; the normal equations as they were."""
        sizes = [np.asarray(size) for size in sizes]
        divided = lambda parts: [
            part / size.reshape(1, -1, *(1,) * (part.ndim - 2))
            for part, size in zip(parts, sizes, strict=True)
        ]
        return Evaluation(*map(divided, self[:3]), normal=self.normal)


@eqx.filter_jit
def evaluate_misfits(z: Float[Numbers, " n"], problem: OutputError) -> Evaluation:
    """Everything at the first parameters and the initial states `z`."""

    def simulated(z):
        # The parameters, and then each record's initial state.
        ends = z.size - problem.unknown + np.cumsum([0, *(t.start.size for t in problem.terms)])
        values, *starts = map(jnp.asarray, jnp.split(z, ends[:-1]))
        model = insert_parameters(values, problem)
        parts = zip(starts, problem.terms, strict=True)
        pairs = [misfit_and_columns(model, start, term) for start, term in parts]
        left = [project_out(*pair) for pair in pairs]
        rest = [prior_misfits(values, problem.base), *(_LOOSE * start for start in starts)]
        return (left, rest), (left, rest, [columns for _, columns in pairs])

    (slopes, others), (left, rest, columns) = jax.jacfwd(simulated, has_aux=True)(z)
    r = jnp.concatenate([one.reshape(-1) for one in (*left, *rest)])
    J = jnp.concatenate([one.reshape(-1, z.size) for one in (*slopes, *others)])
    return Evaluation(left, slopes, columns, Normal(0.5 * jnp.sum(r**2), J.T @ r, J.T @ J))
