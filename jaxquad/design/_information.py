"""The information that a record to come would hold, and powers of lines that buy the most of it."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, Int, PyTree

from jaxquad._core import require_x64
from jaxquad.excitation import Excitation
from jaxquad.identify import Free, Parameters, select_parameters
from jaxquad.models import evaluate_response, with_arrays
from jaxquad.spectra import SpectralDensity


_STEPS = 40_000
_BETWEEN = 25  # steps between two looks at the certificate
_TOLERANCE = 3e-4  # of the flight time

Power = Float[Array, " frequencies"]
PerPower = Float[Array, "models frequencies parameters parameters"]
Costs = Float[Array, "limits frequencies"]
Share = Float[Array, ""]
Information = Float[Array, "parameters parameters"]
Lines = Float[np.ndarray, " frequencies"]
Matrices = Complex[np.ndarray, "frequencies outputs outputs"]


class MeasuredNoise(eqx.Module):
    """The noise of `outputs` from a measured spectral density, interpolated over log frequency.

    **Arguments:**

    - `density`: of a record at rest, or of an excited one.
    - `outputs`: names of its channels.
    - `removed`: channels whose share is taken out, such as the input of an excited record. Only for
        an open loop: with feedback, part of the noise would count as explained.
    """

    density: SpectralDensity
    outputs: tuple[str, ...] = eqx.field(static=True)
    removed: tuple[str, ...] = eqx.field(static=True, default=())

    def __call__(self, omega: Lines) -> Matrices:
        """Covariances E[V V^H], one-sided, in output units squared per Hz."""
        measured = np.asarray(self.density.omega)
        outside = (omega < measured[0] * (1 - 1e-9)) | (omega > measured[-1] * (1 + 1e-9))
        if outside.any():
            raise ValueError(
                f"the noise is known from {measured[0]:.4g} to {measured[-1]:.4g} rad/s, not at "
                f"{omega[outside][0]:.4g} rad/s: narrow the band, or give spectral_density omega="
            )
        place, values = np.log(measured), self._unexplained()
        flat = values.reshape(measured.size, -1).T
        columns = [np.interp(np.log(omega), place, column) for column in flat]
        return np.stack(columns, axis=1).reshape(omega.size, *values.shape[1:])

    def _unexplained(self) -> Matrices:
        for name in (*self.outputs, *self.removed):
            if name not in self.density.names:
                raise ValueError(f"no channel {name!r}; there are: {', '.join(self.density.names)}")
        outputs, removed = (
            np.array([self.density.names.index(name) for name in names], int)
            for names in (self.outputs, self.removed)
        )
        # A density averages conj(X_a) X_b; the covariance of a column of outputs is its transpose.
        covariance = np.swapaxes(np.asarray(self.density.density), 1, 2)
        noise = covariance[:, outputs[:, None], outputs]
        if removed.size == 0:
            return noise
        cross = covariance[:, outputs[:, None], removed]
        gain = cross @ np.linalg.inv(covariance[:, removed[:, None], removed])
        return noise - gain @ np.conj(np.swapaxes(cross, 1, 2))


Noise = float | int | Sequence[float] | Callable[[Lines], np.ndarray] | MeasuredNoise


def noise_covariance(noise: Noise, omega: Lines, outputs: int) -> Matrices:
    """The noise of so many outputs at lines in rad/s as covariance matrices, one-sided per Hz.

    **Raises:** ValueError for a density of another shape, not finite or not above 0.
    """
    density = np.asarray(noise(omega) if callable(noise) else noise)
    if density.ndim == 1 and callable(noise):
        density = density[:, None]
    if density.ndim < 3:
        try:
            powers = np.broadcast_to(density, (omega.size, outputs))
        except ValueError as error:
            raise ValueError(
                f"noise of shape {density.shape} for {omega.size} lines and {outputs} outputs: "
                "give one density in units^2/Hz, one for each output, or a function of omega in "
                "rad/s"
            ) from error
        density = powers[:, :, None] * np.eye(outputs)
    if density.shape != (omega.size, outputs, outputs):
        raise ValueError(f"the noise is of {density.shape[1]} outputs, but the model has {outputs}")
    if not np.all(np.isfinite(density)):
        raise ValueError("the noise density is not finite at every line: check it for NaN and inf")
    least = np.linalg.eigvalsh(density)[:, 0]
    if least.min() <= 0:
        worst = least.argmin()
        raise ValueError(
            f"the noise density at {omega[worst]:.4g} rad/s is {least[worst]:.4g} units^2/Hz, but "
            "it must be above 0. White noise of standard deviation s, sampled at f Hz, has 2 s^2/f"
        )
    return density.astype(complex)


Informations = Float[np.ndarray, "frequencies parameters parameters"]
_SINGULAR = 1e-12  # of a correlation matrix: beyond it, rounding decides


@eqx.filter_jit
def response_and_slopes(
    model: PyTree, parameters: Parameters, omega: Float[Array, " frequencies"], input: int
) -> tuple[Complex[Array, "frequencies outputs"], Complex[Array, "frequencies outputs parameters"]]:
    """The response to one input, and its derivatives with respect to relative changes."""

    def parts(z):
        response = evaluate_response(parameters.insert(model, z), omega)
        if not 0 <= input < response.shape[2]:  # JAX would clamp it without a word.
            raise ValueError(f"input is {input}: the model has inputs 0 to {response.shape[2] - 1}")
        response = response[:, :, input]
        return jnp.stack([jnp.real(response), jnp.imag(response)])

    z = parameters.start[: parameters.count]
    value, slopes = parts(z), jax.jacfwd(parts)(z)
    return jax.lax.complex(value[0], value[1]), jax.lax.complex(slopes[0], slopes[1])


def information_per_energy(
    slopes: Complex[np.ndarray, "frequencies outputs parameters"],
    noise: Complex[np.ndarray, "frequencies outputs outputs"],
) -> Informations:
    """Fisher information of each frequency per unit of energy (mean square times seconds) there.

    2 Re(s^H S^-1 s) with the one-sided noise S. Source: Pintelon and Schoukens, System
    Identification, 2nd ed., section 5.4.2.
    """
    weighted = np.linalg.solve(noise, slopes)
    return 2 * np.real(np.conj(np.swapaxes(slopes, 1, 2)) @ weighted)


def check_distinct(
    total: Float[np.ndarray, "parameters parameters"], names: tuple[str, ...]
) -> None:
    """Raise ValueError where excitation at these lines does not determine every parameter."""
    size = np.sqrt(np.diagonal(total))
    for name, effect in zip(names, size, strict=True):
        if not effect > 0:
            raise ValueError(f"{name} does not change the response: leave it out of free=")
    values, vectors = np.linalg.eigh(total / np.outer(size, size))
    if values[0] < _SINGULAR * values[-1]:
        direction = vectors[:, 0]
        mixed = [n for n, x in zip(names, direction, strict=True) if abs(x) > 0.05]
        raise ValueError(
            f"no excitation at these lines determines {', '.join(mixed)} one by one: fix one of "
            "them (leave it out of free=), or offer more lines"
        )


class Prediction(eqx.Module):
    """The best standard errors that an experiment allows: the Cramer-Rao bound of its noise.

    Errors are relative to the parameters' values, or to the scale of a `jq.identify.Real`.
    `cramer_rao` is CIFER's, in per cent, as a fit with `jq.identify.MaximumLikelihood` prints it:
    sqrt(2) times the standard error.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    information: Float[np.ndarray, "parameters parameters"]  # of relative changes
    seconds: float = eqx.field(static=True)  # of excitation

    @property
    def covariance(self) -> Float[np.ndarray, "parameters parameters"]:
        """Of relative changes."""
        size = np.sqrt(np.diagonal(self.information))
        return np.linalg.inv(self.information / np.outer(size, size)) / np.outer(size, size)

    @property
    def standard_errors(self) -> Float[np.ndarray, " parameters"]:
        """Relative ones."""
        return np.sqrt(np.diagonal(self.covariance))

    @property
    def cramer_rao(self) -> Float[np.ndarray, " parameters"]:
        """In per cent."""
        return 100 * np.sqrt(2) * self.standard_errors

    @property
    def log_determinant(self) -> float:
        """Of the information."""
        return float(np.linalg.slogdet(self.information)[1])

    def seconds_for(self, standard_errors: ArrayLike) -> Float[np.ndarray, " parameters"]:
        """Seconds of the same excitation, repeated, for each of these relative standard errors."""
        return self.seconds * (self.standard_errors / np.asarray(standard_errors)) ** 2

    def __str__(self) -> str:
        width = max(9, *(len(name) for name in self.names))
        head = f"{'parameter':<{width}} {'std. error %':>12} {'CR %':>8}"
        rows = zip(self.names, 100 * self.standard_errors, self.cramer_rao, strict=True)
        return "\n".join([head, *(f"{n:<{width}} {e:12.3f} {c:8.3f}" for n, e, c in rows)])


def predict_accuracy(
    model: PyTree, excitation: Excitation, *, noise: Noise, free: Free = None,
    band: tuple[float, float] | None = None, input: int = 0,
) -> Prediction:  # fmt: skip
    """The standard errors to expect from a test signal: the Cramer-Rao bound.

    The signal's own transform weighs the information of each frequency; a multisine counts at its
    lines, settled from the first period.

    **Arguments:**

    - `model`, `free`: as in `jq.fit`.
    - `excitation`: a `jq.sweep`, `jq.multisine` or another `jq.excitation.Excitation`.
    - `noise`: one-sided spectral density of the outputs in units^2/Hz: a number, one for each
        output, a function of omega in rad/s, or a `jq.design.MeasuredNoise`.
    - `band`: (low, high) in rad/s; by default that of the excitation.
    - `input`: which input of the model is excited.

    **Returns:**

    `jq.design.Prediction`.

    **Raises:**

    - `ValueError`: the excitation does not determine every parameter.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits.
    """
    require_x64("a design")
    model = with_arrays(model)
    parameters = select_parameters(model, free)
    # Without padding, the harmonics of a periodic signal fall on single points.
    points = excitation.samples * (1 if excitation.kind == "multisine" else 2)
    dt = 1 / excitation.sample_rate
    omega = 2 * np.pi * np.fft.rfftfreq(points, dt)
    energy = 2 * dt * np.abs(np.fft.rfft(excitation.signal, points)) ** 2 / points
    low, high = (excitation.omega_min, excitation.omega_max) if band is None else band
    inside = (omega >= low * (1 - 1e-9)) & (omega <= high * (1 + 1e-9)) & (omega > 0)
    if not inside.any():
        raise ValueError(
            f"the band {low:.4g} .. {high:.4g} rad/s contains no frequency of the signal"
        )
    _, unit = unit_information(model, parameters, omega[inside], noise, input)
    total = np.einsum("f,fpq->pq", energy[inside], unit)
    check_distinct(total, parameters.names)
    return Prediction(parameters.names, total, excitation.duration)


def unit_information(
    model: PyTree, parameters: Parameters, omega: Float[np.ndarray, " frequencies"], noise: Noise,
    input: int,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """The response to one input, (frequencies, outputs), and the information per energy."""
    parts = response_and_slopes(model, parameters, jnp.asarray(omega), input)
    response, slopes = map(np.asarray, parts)
    for part in (response, slopes):
        finite = np.isfinite(part).reshape(omega.size, -1).all(axis=1)
        if not finite.all():
            raise ValueError(f"the model's response is not finite at {omega[~finite][0]:.4g} rad/s")
    return response, information_per_energy(
        slopes, noise_covariance(noise, omega, response.shape[1])
    )


@runtime_checkable
class Criterion(Protocol):
    """What a design maximises: the logarithm of an amount of information.

    The amount has to be concave in the information matrix, and twice as large for two flights as
    for one, so that the ratio of two amounts is a ratio of flight times. `exponent` is that of the
    multiplicative update under which it never falls. Any object with these two members will do.
    """

    @property
    def exponent(self) -> float: ...

    def log_information(self, information: Information, names: tuple[str, ...]) -> Share: ...


class DOptimal(eqx.Module):
    """The smallest joint confidence region: log det M, over the number of parameters."""

    exponent = 1.0

    def log_information(self, information: Information, names: tuple[str, ...]) -> Share:
        return jnp.linalg.slogdet(information)[1] / len(names)


class AOptimal(eqx.Module):
    """The smallest sum of the relative variances of the named parameters, or of all.

    With one name it is c-optimality: the smallest standard error of that parameter alone.
    """

    names: tuple[str, ...] = eqx.field(static=True, default=())

    exponent = 0.5

    def log_information(self, information: Information, names: tuple[str, ...]) -> Share:
        for name in self.names:
            if name not in names:
                raise ValueError(f"{name!r} is no free parameter; free are: {', '.join(names)}")
        wanted = np.array([names.index(name) for name in self.names or names])
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

    def log_information(self, information: Information, names: tuple[str, ...]) -> Share:
        logs = jnp.log(jnp.diagonal(jnp.linalg.inv(information)))
        top = jnp.max(logs)
        return -top - jnp.log(jnp.sum(jnp.exp(self.power * (logs - top)))) / self.power


class Powers(NamedTuple):
    """Mean squares of the lines, and the price of each limit in information; prices sum to 1."""

    power: Power
    price: Float[Array, " limits"]


class Certificate(NamedTuple):
    """How far powers are from the best, by the equivalence theorem."""

    dispersion: Power  # information that a line buys per cost, to all there is: 1 at best
    gap: Float[Array, ""]  # the best design's log information exceeds this one's by no more


class PowerProblem(NamedTuple):
    """What powers of lines buy and cost: each limit's `costs @ power` is at most 1."""

    per_power: PerPower
    costs: Costs
    criterion: Criterion
    names: tuple[str, ...]  # of the parameters
    share: Share  # of what the limits leave a line alone, which it takes at most

    @property
    def cap(self) -> Power:
        return self.share / jnp.max(self.costs, axis=0)

    def feasible(self, power: Power) -> Power:
        return power / jnp.maximum(jnp.max(self.costs @ power), 1.0)


def optimal_powers(problem: PowerProblem) -> Powers:
    """Maximise the mean of the models' log information within the limits.

    Each step multiplies the powers by the information that a unit of cost buys at each line, to the
    criterion's exponent, and the prices of the limits by their use. With a single limit that is the
    algorithm of Silvey, Titterington and Torsney (1978), under which D- and A-optimality never fall
    (Yu, 2010).
    """
    limits = problem.costs.shape[0]
    price = jnp.full(limits, 1 / limits, problem.costs.dtype)
    start = Powers(problem.feasible(problem.cap), price)
    return _improve(start, problem, jnp.asarray(_STEPS))[0]


def certify_powers(powers: Powers, problem: PowerProblem) -> Certificate:
    """Bound what any powers within the limits could gain over these, whatever they are.

    Weak duality; with one limit and no cap, the equivalence theorem of Kiefer and Wolfowitz (1960).
    """
    return _improve(powers, problem, jnp.asarray(0))[1]


@eqx.filter_jit
def _improve(
    powers: Powers, problem: PowerProblem, steps: Int[Array, ""]
) -> tuple[Powers, Certificate]:
    """At most so many steps on; with none, only the certificate, at no second compilation."""
    costs, criterion, cap = problem.costs, problem.criterion, problem.cap

    def information(power):
        totals = jnp.einsum("f,mfpq->mpq", power, problem.per_power)
        return jnp.mean(jax.vmap(lambda m: criterion.log_information(m, problem.names))(totals))

    slope = jax.grad(information)

    def step(_, state):
        price = state.price * (costs @ state.power)
        price = price / jnp.sum(price)
        cost = price @ costs
        wanted = state.power * (slope(state.power) / cost) ** criterion.exponent

        # Scaled to a cost of 1; what exceeds a line's cap goes to the other lines.
        def rescale(_, scale):
            full = scale * wanted >= cap
            left = 1 - jnp.sum(jnp.where(full, cost * cap, 0.0))
            open = jnp.sum(jnp.where(full, 0.0, cost * wanted))
            return jnp.where(open > 0, left / jnp.where(open > 0, open, 1.0), scale)

        scale = jax.lax.fori_loop(0, 12, rescale, 1 / jnp.sum(cost * wanted))
        return Powers(jnp.minimum(scale * wanted, cap), price)

    def certificate(state):
        power, cost = problem.feasible(state.power), state.price @ costs
        slopes = slope(power)
        # Any powers within the limits could do better by so much: concavity, and the best filling.
        order = jnp.argsort(-slopes / cost)
        room = (cost * cap)[order]
        taken = jnp.clip(1 - (jnp.cumsum(room) - room), 0, room)
        gap = jnp.sum(taken * (slopes / cost)[order]) - slopes @ power
        return Certificate(slopes / cost, gap)

    def improve(carry):
        state, _, done = carry
        state = jax.lax.fori_loop(0, jnp.minimum(_BETWEEN, steps), step, state)
        return state, certificate(state), done + _BETWEEN

    def unfinished(carry):
        _, proof, done = carry
        return (done == 0) | ((proof.gap > _TOLERANCE) & (done < steps))

    unknown = Certificate(jnp.zeros_like(powers.power), jnp.asarray(jnp.inf))
    start = (powers, unknown, jnp.zeros_like(steps))
    state, proof, _ = jax.lax.while_loop(unfinished, improve, start)
    return state._replace(power=problem.feasible(state.power)), proof
