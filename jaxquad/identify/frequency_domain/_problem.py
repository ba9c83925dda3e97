"""The least-squares problem of a fit: models, records, weights and priors."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float, PyTree

from jaxquad._compile import evaluate_once, FEW, no_fuse
from jaxquad._core import (
    is_traced,
    Message,
    Normal,
    normal_equations,
    on_host,
    pytree_node,
)
from jaxquad.models import evaluate_response, LaggedIntegrator, StateSpace, TransferFunction
from jaxquad.spectra import FrequencyResponse

from ._cost import mix_parts, Mixing, unmixed
from ._parameters import Condition, find_place, Numbers, Parameters, require_conditions
from ._sampled import Aliases, evaluate_sampled, hold_before, plan_aliases


_FEW = 5  # frequencies of the trial of a model
_OURS = (LaggedIntegrator, StateSpace, TransferFunction)

Part = Float[Array, "outputs inputs frequencies"]


class Prior(eqx.Module):
    """A known value of a parameter, or of a function of the model, with its standard error.

    A data-sheet value, a thrust stand, a static torque: it counts as one more measurement.

    **Arguments:**

    - `quantity`: a parameter's name, or a function from the model to a number.
    - `value`: in the quantity's unit.
    - `standard_error`: likewise, above 0.

    !!! example

        ```python
        priors = [jq.identify.Prior("K_t", 0.1188, 0.002),
                  jq.identify.Prior(lambda m: m.L * m.K_t, 0.0234, 0.0003)]
        ```
    """

    quantity: str | Callable[[PyTree], Float[Array, ""]] = eqx.field(static=True)
    value: float | Float[Numbers, ""]
    standard_error: float | Float[Numbers, ""]

    def __check_init__(self):
        if is_traced(self):  # by a derivative
            return
        if not (0 < self.standard_error < np.inf and np.isfinite(self.value)):
            raise ValueError(
                f"a prior of {self.value} with standard error {self.standard_error}: give a finite "
                "value and a positive standard error"
            )


@pytree_node
class Problem:
    """One least-squares problem: residuals as a function of `z`, with all that they depend on."""

    model: PyTree
    parameters: Parameters
    conditions: tuple[Condition, ...]
    quantities: tuple[Condition, ...] = eqx.field(static=True)  # that a prior speaks of
    omega: tuple[Float[Numbers, " frequencies"], ...]
    measured: tuple[Complex[Numbers, "frequencies outputs inputs"], ...]
    weights: tuple[Float[Numbers, "frequencies outputs inputs 2"], ...]  # of magnitude and phase
    prior: Float[Numbers, "priors 2"]  # value, standard error
    aliases: tuple[Aliases | None, ...] = ()  # of the responses whose input was held
    silent: tuple[tuple[tuple[int, int], ...], ...] = eqx.field(static=True, default=())
    mixings: tuple[Mixing | None, ...] = ()  # of the responses, after their weights

    @property
    def silences(self) -> list[Bool[np.ndarray, "outputs inputs"]]:
        """The pairs of each response that the model has none of, whatever its parameters are."""
        masks = [np.zeros(measured.shape[1:], dtype=bool) for measured in self.measured]
        for mask, pairs in zip(masks, self.silent, strict=True):
            for pair in pairs:
                mask[pair] = True
        return masks

    @property
    def is_single(self) -> bool:
        """Whether it is one record, and nothing else."""
        return len(self.omega) == 1 and not self.quantities

    def parts(self) -> list["Problem"]:
        """Problems of one record each, and one of the priors, for what no weight matters to."""
        if self.is_single:
            return [self.weighted(())]
        names = ("conditions", "omega", "measured", "aliases", "silent")
        empty = dict.fromkeys((*names, "weights", "mixings"), ())
        none = dataclasses.replace(self, **empty)
        bare = dataclasses.replace(none, quantities=(), prior=np.zeros((0, 2)))
        rows = zip(*(getattr(self, name) for name in names), strict=True)
        records: list[Problem] = [
            dataclasses.replace(bare, **{name: (x,) for name, x in zip(names, row, strict=True)})
            for row in rows
        ]
        return [*records, none] if self.quantities else records

    def weighted(
        self,
        weights: Sequence[Float[Numbers, "..."]],
        mixings: Sequence[Mixing | None] | None = None,
    ) -> "Problem":
        """The same problem under other weights, with points that share noise taken together."""
        mixings = [None] * len(weights) if mixings is None else mixings
        return dataclasses.replace(self, weights=tuple(weights), mixings=tuple(mixings))

    def mixed(self) -> "Problem":
        """The same with the identity as mixing where points share no noise: of one structure."""
        pairs = zip(self.mixings, self.measured, strict=True)
        return self.weighted(self.weights, [mixing or unmixed(x.shape) for mixing, x in pairs])


def make_problem(
    model: PyTree,
    parameters: Parameters,
    frfs: Sequence[FrequencyResponse],
    conditions: Sequence[Condition | None] | None = None,
    priors: Sequence[Prior] = (),
) -> Problem:
    """The least-squares problem of a fit, under weights of zero: see `Problem.weighted`.

    **Raises:** ValueError for another number of conditions than of responses, or no condition.
    """
    changes = require_conditions(model, conditions, len(frfs))
    numbers = [[prior.value, prior.standard_error] for prior in priors]
    measured = [np.asarray(frf.response) for frf in frfs]
    pairs = list(zip(changes, frfs, strict=True))
    quantities = (prior.quantity for prior in priors)
    return Problem(
        model=model,
        parameters=parameters,
        conditions=tuple(changes),
        quantities=tuple(_Named(q) if isinstance(q, str) else q for q in quantities),
        omega=tuple(np.asarray(frf.omega) for frf in frfs),
        # Where a response is unknown its weight is zero, and nan times zero is not.
        measured=tuple(np.where(np.isfinite(x), x, 1.0) for x in measured),
        weights=tuple(np.zeros((*x.shape, 2)) for x in measured),
        mixings=(None,) * len(measured),
        prior=np.asarray(numbers, dtype=float).reshape(-1, 2),
        aliases=tuple(
            plan_aliases(change(on_host(model)), frf) if hold_before(model, frf) else None
            for change, frf in pairs
        ),
        silent=tuple(_silent_pairs(model, parameters, *pair) for pair in pairs),
    )


def on_device(model: PyTree) -> PyTree:
    """The model with JAX's arrays in the place of NumPy's."""
    hosted, rest = eqx.partition(model, lambda leaf: isinstance(leaf, np.ndarray))
    if not jax.tree.leaves(hosted):
        return model
    return eqx.combine(jax.device_put(hosted), rest)


def _silent_pairs(
    model: PyTree, parameters: Parameters, condition: Condition, frf: FrequencyResponse
) -> tuple[tuple[int, int], ...]:
    """Output and input of the pairs that a model has no response of."""
    if np.prod(frf.response.shape[1:]) == 1:
        return ()
    start = np.asarray(parameters.start)[: parameters.count]
    moved = start + 0.1 * np.random.default_rng(0).uniform(0.5, 1.0, start.size)
    tried = condition(parameters.insert(model, moved))
    omega = np.asarray(frf.omega)[[0, frf.omega.size // 2, -1]]
    response = np.asarray(_evaluate(tried, jax.device_put(omega)))
    pairs = np.argwhere(np.all(response == 0, axis=0)).tolist()
    return tuple((output, source) for output, source in pairs)


_evaluate = eqx.filter_jit(evaluate_response)


def _log_ratios(z: Float[Array, " n"], problem: Problem) -> list[tuple[Part, Part]]:
    """`ln|T/T^|` and wrapped phase of `T/T^` in rad, per record in its condition."""
    # Frequencies come last until all is done: derivatives are then fast loops over them.
    model, logs = problem.parameters.insert(problem.model, z), []
    records = zip(problem.conditions, problem.omega, problem.aliases, strict=True)
    responses = [evaluate_sampled(change(model), w, aliases) for change, w, aliases in records]
    for response, measured, silent in zip(
        responses, problem.measured, problem.silences, strict=True
    ):
        if response.shape != measured.shape:  # broadcasting would fit one output to all of them
            raise ValueError(
                Message(
                    f"the model's response has shape {response.shape}, the measured one "
                    f"{measured.shape} (frequencies, outputs, inputs): «pick channels with "
                    "jq.records.select», or extend the model"
                )
            )
        # Of a response that is zero the logarithm would be infinite: such pairs count as explained.
        response = jnp.where(silent, measured, response) if np.any(silent) else response
        here, there = (jnp.moveaxis(x, 0, -1) for x in (response, measured))
        power = jnp.real(there) ** 2 + jnp.imag(there) ** 2
        c, s = jnp.real(there) / power, jnp.imag(there) / power
        logs.append(_logarithm(*_rotate(jnp.real(here), jnp.imag(here), c, s)))
    return logs


@jax.custom_jvp
def _logarithm(real: Part, imag: Part) -> tuple[Part, Part]:
    """Of a complex number, in two parts."""
    return 0.5 * jnp.log(real * real + imag * imag), jnp.arctan2(imag, real)


@_logarithm.defjvp
def _logarithm_jvp(primals, tangents):
    # One reciprocal for all tangents: complex divisions would cost most of a fit.
    power = primals[0] * primals[0] + primals[1] * primals[1]
    c, s = (part / power for part in primals)
    return _logarithm(*primals), no_fuse(_rotate, *tangents, c, s)


def _rotate(real: Part, imag: Part, c: Part, s: Part) -> tuple[Part, Part]:
    return real * c + imag * s, imag * c - real * s


def prior_misfits(z: Float[Numbers, " n"], problem: Problem) -> Float[Array, " priors"]:
    """Departures of the priors' quantities, in standard errors."""
    model = problem.parameters.insert(problem.model, z)
    values = [quantity(model) for quantity in problem.quantities]
    if not values:
        return jnp.zeros(0, dtype=z.dtype)
    return (jnp.stack(values) - problem.prior[:, 0]) / problem.prior[:, 1]


def residuals(z: Float[Array, " n"], problem: Problem) -> Float[Array, " residuals"]:
    """All weighted misfits in one vector: half its squared norm is what the solver lowers."""
    parts = []
    for k, log in enumerate(_log_ratios(z, problem)):
        parts += [part.reshape(-1) for part in weigh_parts(problem, k, *log)]
    return jnp.concatenate([*parts, prior_misfits(z, problem)])


def problem_normal(z: Float[Array, " parameters"], problem: Problem) -> Normal:
    """Cost, gradient and Gauss-Newton Hessian of the residuals, from the free parameters `z`."""
    return evaluate_once(lambda z: normal_equations(residuals, z, problem), least=FEW)(z)


def weigh_parts(problem: Problem, k: int, magnitude: Part, phase: Part) -> tuple[Part, Part]:
    """Misfits of record `k`, or slopes of them, as the residuals count them."""
    weight = problem.weights[k]
    both = zip((magnitude, phase), (weight[..., 0], weight[..., 1]), strict=True)
    return mix_parts(problem.mixings[k], *(part * jnp.moveaxis(w, 0, -1) for part, w in both))


def misfits(z: Float[Array, " n"], problem: Problem) -> Float[Array, " residuals"]:
    """The magnitudes and then the phases of one record after the other, then the priors. Each is
    (outputs, inputs, frequencies), flattened."""
    parts = [part.reshape(-1) for log in _log_ratios(z, problem) for part in log]
    return jnp.concatenate([*parts, prior_misfits(z, problem)])


class _Named(NamedTuple):
    """Reads one named number; equal for equal names, so that it does not recompile."""

    name: str

    def __call__(self, model: PyTree) -> Float[Array, ""]:
        return find_place(model, self.name, "for a prior").number(model)


def require_model(function: str, model: object) -> None:
    if isinstance(model, type):
        raise ValueError(
            f"{function} needs a model with the values to start from, not the class "
            f"{model.__name__}: give {model.__name__}(...)"
        )
    if not isinstance(model, eqx.Module) or isinstance(model, FrequencyResponse):
        raise ValueError(
            f"{function} needs a model to start from, such as jq.LaggedIntegrator(gain, lag, "
            f"delay), not a {type(model).__name__}; it comes first: jq.{function}(model, data)"
        )


_sound: set[tuple] = set()  # what was tried before


def require_model_response(model: PyTree, frf: FrequencyResponse) -> None:
    """Raise ValueError for a model whose response is none of this shape, or is not complex."""
    if isinstance(model, _OURS):
        return
    leaves, structure = jax.tree.flatten(model)
    kind = (structure, tuple(map(np.shape, leaves)), frf.response.shape[1:])
    if kind in _sound:
        return
    name = f"{type(model).__name__}.frequency_response(omega)"
    respond = getattr(model, "frequency_response", None)
    if respond is None:
        raise ValueError(f"{type(model).__name__} has no frequency_response(omega) to fit: add it")
    omega = jax.ShapeDtypeStruct((_FEW,), np.float64)
    try:
        result = eqx.filter_eval_shape(lambda model, w: model.frequency_response(w), model, omega)
    except jax.errors.TracerArrayConversionError as error:
        raise ValueError(
            f"{name} computes with NumPy, which has no derivatives: use jax.numpy in it"
        ) from error
    shape, pairs = np.shape(result), frf.response.shape[1:]
    alone = shape == (_FEW,) and pairs == (1, 1)
    if not alone and shape != (_FEW, *pairs):
        raise ValueError(
            f"{name} has the shape {shape} for {_FEW} frequencies, but the measured response has "
            f"{pairs[0]} outputs and {pairs[1]} inputs: return {(_FEW, *pairs)}"
            f"{f' or ({_FEW},)' if pairs == (1, 1) else ''}"
        )
    if not np.issubdtype(result.dtype, np.complexfloating):
        raise ValueError(f"{name} is real: return complex numbers, with magnitude and phase")
    _sound.add(kind)


def require_priors(model: PyTree, priors: Sequence[Prior]) -> None:
    """Raise ValueError for what is no list of priors, and for parameters that do not exist."""
    listed = isinstance(priors, Sequence) and not isinstance(priors, str)
    if not (listed and all(isinstance(prior, Prior) for prior in priors)):
        raise ValueError(
            f"priors is {priors!r}: give a list, "
            "priors=[jq.identify.Prior(name or function, value, standard error)]"
        )
    for prior in priors:
        if isinstance(prior.quantity, str):
            find_place(model, prior.quantity, "for a prior")
