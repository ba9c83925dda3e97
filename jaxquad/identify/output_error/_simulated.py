"""Linear models over a record: what the inputs force, and what start and trim add to it."""

import functools as ft
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, PyTree

from jaxquad._compile import brief_options, Jit
from jaxquad._core import Message
from jaxquad.models import (
    DiscreteTransferFunction,
    explicit,
    free_responses,
    realise,
    require_sampled,
    simulate_linear,
    StateSpace,
    TransferFunction,
)
from jaxquad.records import Record


Numbers = Array | np.ndarray
Rational = TransferFunction | DiscreteTransferFunction
Plant = Rational | StateSpace


def band_gain(
    band: tuple[float, float] | None, record: Record
) -> Float[np.ndarray, " bins"] | None:
    """|H|^2 of a third-order Butterworth band-pass, forwards and backwards; None without a band.
    Raises ValueError for a band (rad/s) that does not rise or leaves the record's range."""
    if band is None:
        return None
    nyquist = np.pi / record.dt
    if np.shape(band) != (2,) or not 0 < band[0] < band[1] < nyquist:
        ends = " .. ".join(f"{float(end):.4g}" for end in np.ravel(band))
        raise ValueError(
            Message(
                f"band {ends} rad/s must rise and lie between 0 and the record's Nyquist frequency "
                f"{nyquist:.4g} rad/s ({nyquist / (2 * np.pi):.4g} Hz): give another band («band=»)"
            )
        )
    from scipy.signal import butter, sosfreqz

    sections = butter(3, np.asarray(band) / nyquist, "bandpass", output="sos")
    turn = np.linspace(0, np.pi, record.samples)
    response = sosfreqz(sections, turn)[1]  # pyright: ignore
    return np.abs(response) ** 2


def band_filter(
    x: Float[Numbers, " samples *columns"], gain: Float[Numbers, " bins"] | None
) -> Float[Numbers, " samples *columns"]:
    """`x` within the band; outside the record it continues mirrored through its two ends."""
    if gain is None:
        return x
    xp = np if isinstance(x, np.ndarray) else jnp
    # A straight line is far below any band, and what is left after it starts and ends at 0.
    ones = (1,) * (x.ndim - 1)
    along = xp.linspace(0.0, 1.0, len(x)).reshape(-1, *ones)
    level = x - x[:1] - along * (x[-1:] - x[:1])
    periodic = xp.concatenate([level, -level[-2:0:-1]])
    spectrum = xp.fft.rfft(periodic, axis=0)
    weighted = gain.reshape(-1, *ones).astype(spectrum.dtype) * spectrum
    return xp.fft.irfft(weighted, len(periodic), axis=0)[: len(x)]


def inputs_between_samples(
    record: Record, hold: str | None, plant: Plant | None = None
) -> tuple[Float[np.ndarray, "samples inputs"], str]:
    """The inputs, and how they run between samples: "zero" (held) or "first" (straight, unless the
    record says otherwise). What is held for less is straight, half its hold late. A discrete plant
    takes the samples as they are."""
    u = np.asarray(record.inputs)
    if isinstance(plant, DiscreteTransferFunction):
        require_sampled(plant.dt, samples=record.dt)
        if hold is not None:
            raise ValueError(
                Message(
                    f"hold is {hold!r}, but the model is discrete and has its hold in it: leave "
                    "«hold=» out, or give the continuous model, model.to_continuous()"
                )
            )
        return u, "zero"
    if hold not in ("first", "zero", None):
        raise ValueError(
            f'hold is {hold!r}: give "first" (straight between samples), "zero" (held), or None '
            "for what the record says (Record.hold)"
        )
    share = (record.hold or 0.0) / record.dt
    if hold or not share:
        return u, hold or "first"
    if share > 1 - 1e-6:
        return u, "zero"
    return u - 0.5 * share * np.diff(u, axis=0, prepend=u[:1]), "first"


_RELATIVE, _ABSOLUTE = 1e-8, 1e-10  # tolerances of the states within one sample
_STEPS = 64  # within one sample at most


@runtime_checkable
class DifferentialModel(Protocol):
    """A model that is given by its differential equation."""

    def init(self) -> PyTree:
        """The state at the first sample, unless it is estimated."""
        ...

    def derivative(
        self, state: PyTree, inputs: Float[Array, " inputs"], disturbance: Float[Array, "..."]
    ) -> PyTree:
        """Of the state, by time in s."""
        ...

    def measure(self, state: PyTree) -> Float[Array, "..."]:
        """The outputs."""
        ...


@runtime_checkable
class HasStateSpace(Protocol):
    """A model that can be written as a state space."""

    def state_space(self) -> StateSpace: ...


@runtime_checkable
class HasTransferFunction(Protocol):
    """A model that can be written as a transfer function, a discrete one of its own static `dt`."""

    def transfer_function(self) -> Rational: ...


Linear = Plant | HasStateSpace | HasTransferFunction


def count_states(plant: DifferentialModel) -> int:
    """How many numbers the state has."""
    return ravel_pytree(plant.init())[0].size


def integrate_plant(
    plant: DifferentialModel,
    u: Float[Numbers, "samples inputs"],
    start: Float[Numbers, " states"],
    dt: float,
    hold: str,
) -> Float[Array, "samples outputs"]:
    """Simulate a differential equation over sampled inputs, without disturbance.

    Tsit5 within each sample, so that steps end where a held input jumps or a straight one bends.

    **Arguments:**

    - `plant`: with `init()`, `derivative(state, inputs, disturbance)` and `measure(state)`.
    - `u`: the inputs.
    - `start`: change of `plant.init()`, flattened.
    - `dt`: sample interval in s.
    - `hold`: "first" (straight between samples) or "zero" (held).

    **Returns:** The outputs; not finite where a sample takes too many steps.
    """
    # Imported late: diffrax triples the time of `import jaxquad`.
    import diffrax as dfx

    origin, rebuild = ravel_pytree(plant.init())
    calm = jnp.zeros_like(plant.measure(rebuild(origin)))
    controller = dfx.PIDController(rtol=_RELATIVE, atol=_ABSOLUTE)

    def slope(t, state, line):
        value, change = line
        inputs = value + (t / dt) * change
        return ravel_pytree(plant.derivative(rebuild(state), inputs, calm))[0]

    def sample(state, line):
        solution = dfx.diffeqsolve(
            dfx.ODETerm(slope), dfx.Tsit5(), 0.0, dt, dt, state, line,
            stepsize_controller=controller, adjoint=dfx.ForwardMode(),
            max_steps=_STEPS, throw=False,
        )  # fmt: skip
        assert solution.ys is not None
        after = jnp.where(solution.result == dfx.RESULTS.successful, solution.ys[0], jnp.nan)
        return after, jnp.atleast_1d(plant.measure(rebuild(state)))

    change = jnp.diff(u, axis=0, append=u[-1:]) if hold == "first" else jnp.zeros_like(u)
    return jax.lax.scan(sample, origin + start, (u, change))[1]


_SLOW = 15.0  # a fifth of a record over which a motion decays by e^-15 leaves 5 % of it
_SUDDEN = 1e-12  # size of a pole in z below which its motion ends at once
_OUTGROWN = 1e10  # growth over a record that leaves too few digits for what is measured


class Motions(NamedTuple):
    """Which unknown motions of the states are allowed for: unit vectors by column.

    Biases act on x' of the slow states and initial values on the fast ones. With a shift of each
    output they span all that constant biases, initial state and shifts can do, and no two of them
    look alike: a bias on a fast state is the transient of an initial value and a shift.
    """

    slow: Float[Numbers, "states slow"]
    fast: Float[Numbers, "states fast"]  # the slower ones first
    groups: tuple[int, ...]  # how many of the fast columns belong to each speed


def linear_model(model: PyTree) -> Plant:
    """The model as one that `simulate_linear` takes."""
    if isinstance(model, Plant):
        return model
    if isinstance(model, HasStateSpace):
        return model.state_space()
    kind = type(model).__name__
    if isinstance(model, HasTransferFunction):
        plant = model.transfer_function()
        if isinstance(plant, DiscreteTransferFunction) and getattr(model, "dt", None) != plant.dt:
            raise ValueError(
                f"{kind}.transfer_function() is discrete, dt = {plant.dt:.6g} s, and {kind} does "
                "not say so: give it the field dt: float = eqx.field(static=True)"
            )
        return plant
    if hasattr(model, "model"):
        raise ValueError(f"a {kind} is no model: give the one that it holds, {kind.lower()}.model")
    raise ValueError(
        f"{kind} has no transfer_function() and no state_space(): give a "
        "jq.TransferFunction, a jq.StateSpace, or a model with one of these methods"
    )


def sample_interval(model: PyTree) -> float | None:
    """Of a discrete model, in s, whose hold is a part of it; None of a continuous one."""
    if isinstance(model, HasTransferFunction) and isinstance(getattr(model, "dt", None), float):
        model = eqx.filter_eval_shape(lambda model: model.transfer_function(), model)
    return model.dt if isinstance(model, DiscreteTransferFunction) else None


def check_channels(plant: Plant, record: Record) -> None:
    """Raise ValueError for a model of other channels than the record's."""
    inputs, outputs = 1, 1
    if isinstance(plant, StateSpace):
        inputs, outputs = plant.G.shape[1], len(plant.H0)
    if (len(record.input_names), len(record.output_names)) != (inputs, outputs):
        count = lambda number, what: f"one {what}" if number == 1 else f"{number} {what}s"
        raise ValueError(
            Message(
                f"the model has {count(inputs, 'input')} and {count(outputs, 'output')}, the "
                f"record has {', '.join(record.input_names)} and {', '.join(record.output_names)}: "
                "«pick channels with jq.records.select»"
            )
        )


def growth_rate(plant: Plant) -> float:
    """Of the fastest unstable motion, in 1/s; 0 without one."""
    return float(np.max(np.real(np.asarray(plant.poles)), initial=0.0))


def diverges(plant: Plant, duration: float) -> bool:
    """Whether motions grow so much that a simulation has no digits left for what is measured."""
    return not growth_rate(plant) * duration < np.log(_OUTGROWN)


def check_growth(plant: Plant, duration: float, remedy: str) -> None:
    """Raise ValueError where a simulation of `duration` s diverges."""
    if diverges(plant, duration):
        raise ValueError(
            Message(
                f"the model is unstable (poles {np.asarray(plant.poles)} rad/s) and its response "
                f"grows by e^{growth_rate(plant) * duration:.3g} within {duration:.4g} s: {remedy}"
            )
        )


def forced_response(
    plant: Plant,
    u: Float[Numbers, "samples inputs"],
    dt: float | Float[Array, ""],
    hold: str,
    direct_samples: Float[Numbers, "outputs inputs"] | None = None,
) -> Float[Array, "samples outputs"]:
    """The outputs under inputs that stood at their first values before the record, from rest."""
    u = u - u[:1]
    options = {"hold": hold, "direct_samples": direct_samples}
    if isinstance(plant, StateSpace):
        return simulate_linear(plant, u, dt, **options)
    return simulate_linear(plant, u[:, 0], dt, **options)[:, None]


def unknown_motions(plant: Plant, duration: float) -> Motions:
    """The invariant subspaces of all speeds; slow is what a fifth of the record does not damp."""
    A = np.asarray((explicit(plant) if isinstance(plant, StateSpace) else realise(plant))[0])
    if not len(A):
        return Motions(np.zeros((0, 0)), np.zeros((0, 0)), ())
    samples = duration / plant.dt if isinstance(plant, DiscreteTransferFunction) else None

    def speed_of(re: np.ndarray | float, im: np.ndarray | float) -> np.ndarray | float:
        """In decays by e over the record, of which slow motions have less than 15."""
        if samples is None:
            return -re * duration / _SLOW
        return -samples / _SLOW * np.log(np.hypot(re, im) + _SUDDEN)

    poles = np.linalg.eigvals(A)
    speeds = np.asarray(speed_of(np.real(poles), np.imag(poles)))
    # One speed ends and the next begins between poles, from the end of the slow ones at 1 on.
    # Equal poles scatter by a root of the rounding, and have to stay together.
    ordered = np.sort(np.maximum(speeds, 0.2))
    gaps = np.flatnonzero(ordered[1:] > 1.001 * ordered[:-1])
    middles = np.sqrt(ordered[gaps] * ordered[gaps + 1])
    edges = [0.0] if ordered[0] > 1 else []
    edges += [*middles[ordered[gaps + 1] > 1].tolist(), np.inf]

    def basis(low: float, high: float) -> Float[np.ndarray, "states within"]:
        """Orthonormal, of the motions that decay faster than at `low`, up to `high`."""
        inside = (low < speeds) & (speeds <= high)
        if not np.any(inside) or np.all(inside):
            return np.eye(len(A), int(np.sum(inside)))
        from scipy.linalg import schur

        parts = schur(A, output="real", sort=lambda re, im: low < speed_of(re, im) <= high)
        return parts[1][:, : int(parts[-1])]

    slow = basis(-np.inf, edges[0])
    parts = [basis(low, high) for low, high in zip(edges, edges[1:], strict=False)]
    parts = parts or [slow[:, :0]]
    groups = tuple(part.shape[1] for part in parts if part.shape[1])
    return Motions(slow, np.concatenate(parts, axis=1), groups)


def free_response(
    plant: Plant, motions: Motions, samples: int, dt: float | Float[Array, ""]
) -> Float[Array, "samples outputs unknowns"]:
    """The outputs of a unit shift of each output, of unit biases and of unit initial values."""
    outputs = len(plant.H0) if isinstance(plant, StateSpace) else 1
    shifts = jnp.broadcast_to(jnp.eye(outputs)[None], (samples, outputs, outputs))
    if not len(motions.slow):
        return shifts
    start, bias = free_responses(plant, samples, dt)
    if not isinstance(plant, StateSpace):
        start, bias = start[:, None], bias[:, None]
    dot = lambda x, way: jnp.einsum("toi,ik->tok", x, jnp.asarray(way), precision="highest")
    return jnp.concatenate([shifts, dot(bias, motions.slow), dot(start, motions.fast)], axis=2)


@ft.partial(Jit, options=brief_options)
def forced_and_free(
    plant: Plant,
    motions: Motions,
    u: Float[Numbers, "samples inputs"],
    dt: Float[Numbers, ""],
    hold: str,
) -> tuple[Float[Array, "samples outputs"], Float[Array, "samples outputs unknowns"]]:
    """`forced_response` and `free_response` by one program."""
    dt = jnp.asarray(dt)
    free = free_response(plant, motions, len(u), dt)
    return forced_response(plant, u, dt, hold), free
