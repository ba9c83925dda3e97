"""Steady-state observers that predict a record some samples ahead, and the noise behind them."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float, Int

from jaxquad._core import Message
from jaxquad.models import DiscreteTransferFunction, explicit, realise, sample_states, StateSpace
from jaxquad.records import Record

from ._noise import NoiseModel, orthonormal, projected_noise
from ._simulated import check_growth, inputs_between_samples, Plant


Outputs = Float[np.ndarray, "samples outputs"]
Square = Float[np.ndarray, "states states"]
NORMAL = 1.96  # standard deviations that hold 95 % of Gaussian errors
_LAGS = 20  # of the test of whiteness
_REACH = 50  # samples within which a shock of a state counts as seen
_LONGEST = 20_000  # samples from which noise is estimated
_RANGE = (-7.0, 3.0)  # decades of noise: nothing, and more than all of the output
_SETTLED = 1e-6  # relative change of the likelihood's logarithm


class WhiteNoise(eqx.Module):
    """White noise on the derivatives of the states and on the outputs: a Kalman filter's.

    The states are those of the `jq.StateSpace`, or of `jq.models.realise(transfer_function)`.
    Source: Jategaonkar, Flight Vehicle System Identification, ch. 5 (filter error method).
    """

    process: Float[np.ndarray, " states"]  # root of the two-sided density, state per s^0.5
    measurement: Float[np.ndarray, " outputs"]  # standard deviation of a sample


class Prediction(eqx.Module):
    """How a record was predicted: each sample from the outputs up to `horizon` samples before."""

    horizon: int = eqx.field(static=True)  # samples
    seconds: float = eqx.field(static=True)
    deviation: Float[np.ndarray, " outputs"]  # of the errors, by the noise
    coverage: Float[np.ndarray, " outputs"]  # share of the record's errors within 1.96 of it
    whiteness: Float[np.ndarray, " outputs"]  # p-value of the one-step errors (Ljung and Box)
    factor: Float[np.ndarray, " inputs"]  # of each input's effect, estimated, over the model's
    factor_error: Float[np.ndarray, " inputs"]  # its standard error; inf of an input at rest
    noise: WhiteNoise | tuple[NoiseModel, ...]
    origin: Message = eqx.field(static=True)  # of the noise, as its `kind` says

    def __str__(self) -> str:
        reach = ", ".join(f"{NORMAL * size:.4g}" for size in self.deviation)
        share = ", ".join(f"{100 * part:.1f}" for part in self.coverage)
        chance = ", ".join(f"{p:.2g}" for p in self.whiteness)
        pairs = zip(self.factor, self.factor_error, strict=True)
        factor = ", ".join(f"{one:.3g} +- {NORMAL * error:.2g}" for one, error in pairs)
        return (
            f"95 % of the errors within +-{reach}, by the noise (in this record {share} %); "
            f"one-step errors white with p = {chance}; "
            f"effect of the inputs over the model's {factor} (95 %); {self.origin}"
        )


OF_FIT, AS_STATED, ESTIMATED = "of the fit", "as stated", "estimated"  # kinds of `origin`
_WORDS = {
    OF_FIT: "the noise is that of the fit",
    AS_STATED: "the noise is as stated («noise=»)",
    ESTIMATED: "the model has no noise model: process and measurement noise were estimated from "
    "this record (maximum likelihood)",
}


class _System(NamedTuple):
    """x[k+1] = A x + pushed + w, y = C x + direct + v: plant, noise and shifts of the outputs."""

    A: Square
    C: Float[np.ndarray, "outputs states"]
    pushed: Float[np.ndarray, "samples states"]
    y: Outputs  # without what passes directly
    by_input: tuple[tuple[np.ndarray, Outputs], ...]  # what of `pushed` and direct is whose
    start: Int[np.ndarray, " unknown"]  # states whose first value is estimated
    noisy: Int[np.ndarray, " moving"]  # those that an observer corrects; constants are not


class _Covariances(NamedTuple):
    """Of w, of w with v, and of v."""

    Q: Float[np.ndarray, "moving moving"]
    S: Float[np.ndarray, "moving outputs"]
    R: Float[np.ndarray, "outputs outputs"]


class _Filtered(NamedTuple):
    """What an observer makes of a record."""

    gain: Float[np.ndarray, "states outputs"]
    error: Float[np.ndarray, "moving moving"]  # covariance of the predicted state
    start: Float[np.ndarray, " unknown"]
    innovations: Outputs
    columns: Float[np.ndarray, "samples outputs unknown"]  # innovations per unit of `start`


def predict_record(
    plant: Plant,
    record: Record,
    horizon: int | float,
    noise: WhiteNoise | Sequence[NoiseModel] | None,
    kind: str,
    hold: str | None,
) -> tuple[Outputs, Prediction, tuple[np.ndarray, ...]]:
    """The predicted outputs, how they came about, and shift, bias and start of `Verification`."""
    if not horizon >= 1 or (np.isfinite(horizon) and horizon != int(horizon)):
        raise ValueError(
            f"horizon is {horizon}: give the samples ahead, 1 or more; np.inf simulates from the "
            "estimated start"
        )
    y = np.asarray(record.outputs, float)
    steps, outputs = int(min(horizon, len(y))), y.shape[1]
    check_growth(plant, steps * record.dt, "predict fewer samples ahead« (horizon=)»")
    A = np.asarray((explicit(plant) if isinstance(plant, StateSpace) else realise(plant))[0])
    count, models = len(A), ()
    if noise is not None and not isinstance(noise, WhiteNoise):
        models = tuple(noise)
        if len(models) != outputs:
            raise ValueError(f"{len(models)} noise models for {outputs} outputs: give one for each")
    system, push = _system_of(plant, record, hold, models, count)
    if models:
        R = np.diag([model.deviation**2 for model in models])
        covariances, origin = _Covariances(push @ R @ push.T, push @ R, R), models
    else:
        discrete = isinstance(plant, DiscreteTransferFunction)  # noise enters at each sample
        alone = np.eye(count)[:, :, None] * np.eye(count)[:, None]
        shares = alone if discrete else _shares_of_states(A, system, record.dt)
        origin = noise if isinstance(noise, WhiteNoise) else _estimate_white(system, shares)
        _check_white(origin, count, outputs)
        covariances = _white(shares, origin)
    filtered = _filter(system, covariances)
    left, deviation = _errors_ahead(system, covariances, filtered, steps)
    factor, factor_error = _factors(system, covariances, filtered)
    prediction = Prediction(
        horizon=steps,
        seconds=steps * record.dt,
        deviation=deviation,
        coverage=np.mean(np.abs(left) < NORMAL * deviation, axis=0),
        whiteness=np.array([_ljung_box(one) for one in filtered.innovations.T]),
        factor=factor,
        factor_error=factor_error,
        noise=origin,
        origin=Message(_WORDS[kind], kind),
    )
    start = np.zeros(len(system.A))
    start[system.start] = filtered.start
    return y - left, prediction, (start[-outputs:], start[count : 2 * count], start[:count])


def _errors_ahead(
    system: _System, covariances: _Covariances, filtered: _Filtered, steps: int
) -> tuple[Outputs, Float[np.ndarray, " outputs"]]:
    """Errors so many samples ahead, the first terms of the noise as a filter of the one-step
    errors, and their standard deviation by the noise. Source: Ljung, eq. 3.31."""
    A, C = system.A[np.ix_(system.noisy, system.noisy)], system.C[:, system.noisy]
    e, spread = filtered.innovations, filtered.error
    pushed = e @ filtered.gain[system.noisy].T
    for _ in range(steps - 1):
        spread = A @ spread @ A.T + covariances.Q
    deviation = np.sqrt(np.diagonal(C @ spread @ C.T + covariances.R))
    return e + _late(_windowed(A, pushed, steps - 1), 1) @ C.T, deviation


def _system_of(
    plant: Plant,
    record: Record,
    hold: str | None,
    models: Sequence[NoiseModel],
    count: int,
) -> tuple[_System, Float[np.ndarray, "noisy shocks"]]:
    """States, biases, what delays remember, noise and shifts; where shocks of the models enter."""
    from scipy.linalg import block_diag

    u, between = inputs_between_samples(record, hold, plant)
    parts = sample_states(plant, u - u[:1], record.dt, hold=between)
    outputs, first = len(parts.rows), len(parts.step)
    alone = (np.where(np.arange(u.shape[1]) == k, u - u[:1], 0.0) for k in range(u.shape[1]))
    single = [sample_states(plant, one, record.dt, hold=between) for one in alone]
    tails = [_noise_states(model) for model in models]
    behind, shown, push = np.zeros((0, 0)), np.zeros((outputs, 0)), np.zeros((0, outputs))
    if tails:
        behind, shown, push = (
            np.asarray(block_diag(*blocks))
            for blocks in (
                [A for A, _ in tails],
                [np.eye(1, len(A)) for A, _ in tails],
                [k[:, None] for _, k in tails],
            )
        )
    A = np.asarray(block_diag(parts.step, behind, np.eye(outputs)))
    shifts = np.arange(len(A) - outputs, len(A))
    noisy = np.setdiff1d(np.arange(len(A) - outputs), np.arange(count, 2 * count))
    system = _System(
        A,
        np.concatenate([parts.rows, shown, np.eye(outputs)], axis=1),
        np.pad(parts.pushed, ((0, 0), (0, len(A) - first))),
        np.asarray(record.outputs, float) - parts.direct,
        tuple((np.pad(one.pushed, ((0, 0), (0, len(A) - first))), one.direct) for one in single),
        np.concatenate([np.arange(first), shifts]),
        noisy,
    )
    return system, np.pad(push, ((len(noisy) - len(push), 0), (0, 0)))


def _noise_states(model: NoiseModel) -> tuple[Square, Float[np.ndarray, " states"]]:
    """z[k+1] = A z + k e, noise = z_1 + e, in the observable canonical form (Ljung, sec. 4.3)."""
    order = max(model.order)
    above, below = (
        np.pad(part[1:], (0, order + 1 - part.size))
        for part in (np.asarray(model.numerator), np.asarray(model.denominator))
    )
    A = np.eye(order, k=1)
    A[:, :1] -= below[:, None]
    return A, above - below


def _shares_of_states(
    A: Square, system: _System, dt: float
) -> Float[np.ndarray, "states moving moving"]:
    """The covariance that unit noise on each state's derivative leaves after a sample.
    Source: Van Loan, Computing integrals involving the matrix exponential, 1978."""
    from scipy.linalg import expm

    count, shares = len(A), []
    step = system.A[:count, :count]
    # An output that is late sees the noise of its sample, too.
    onward = np.linalg.solve(step.T, system.A[np.ix_(system.noisy, np.arange(count))].T).T
    for unit in np.eye(count):
        block = np.block([[-A, np.diag(unit)], [np.zeros_like(A), A.T]]) * dt
        covariance = step @ np.asarray(expm(block))[:count, count:]
        shares.append(onward @ (0.5 * (covariance + covariance.T)) @ onward.T)
    return np.array(shares).reshape(count, len(system.noisy), len(system.noisy))


def _white(shares: Float[np.ndarray, "states moving moving"], noise: WhiteNoise) -> _Covariances:
    Q = np.einsum("s,sij->ij", np.asarray(noise.process) ** 2, shares)
    R = np.diag(np.asarray(noise.measurement) ** 2)
    return _Covariances(Q, np.zeros((len(Q), len(R))), R)


def _check_white(noise: WhiteNoise, states: int, outputs: int) -> None:
    process, measurement = np.asarray(noise.process), np.asarray(noise.measurement)
    right = process.shape == (states,) and measurement.shape == (outputs,)
    if not (right and np.all(process >= 0) and np.all(measurement > 0)):
        raise ValueError(
            f"process noise {process} and measurement noise {measurement}: give {states} numbers "
            f"of 0 or more (one for each state) and {outputs} above 0 (one for each output)"
        )


def _estimate_white(
    system: _System, shares: Float[np.ndarray, "states moving moving"]
) -> WhiteNoise:
    """Maximum likelihood of the innovations; the common factor of all noise is eliminated.
    Source: Ljung, sec. 7.4; Jategaonkar, ch. 5."""
    from scipy.optimize import minimize

    system = system._replace(pushed=system.pushed[:_LONGEST], y=system.y[:_LONGEST])
    count, (samples, outputs) = len(shares), system.y.shape
    size = np.std(system.y, axis=0)
    if not np.all(size > 0):
        raise ValueError(
            Message("an output is constant: leave it out« with jq.records.select»", "constant")
        )
    # A unit of process noise moves some output by its own size with the shock of one sample.
    shocks = np.sqrt(np.diagonal(shares, axis1=1, axis2=2))
    response = np.abs(_powers(system, _REACH)[:, :, system.noisy]) / size[None, :, None]
    moved = np.max(response @ shocks.T, axis=(0, 1))
    units = np.where(moved > 0, 1 / np.maximum(moved, 1e-300), 0.0)

    def noise_at(x: Float[np.ndarray, " free"]) -> WhiteNoise:
        return WhiteNoise(units * 10 ** x[:count], size * 10 ** np.append(0.0, x[count:]))

    def deviance(x: Float[np.ndarray, " free"]) -> tuple[float, float]:
        """Minus twice the logarithm of the likelihood, and the variance that is common to all."""
        try:
            covariances = _white(shares, noise_at(x))
            filtered = _filter(system, covariances)
        except np.linalg.LinAlgError:
            return np.inf, 1.0
        root = np.linalg.cholesky(_spread(system, filtered, covariances))
        common = float(np.mean(np.linalg.solve(root, filtered.innovations.T) ** 2))
        level = 2 * float(np.sum(np.log(np.diagonal(root)))) + outputs * np.log(common)
        return samples * level, common

    x = np.concatenate([np.full(count, -1.5), np.zeros(outputs - 1)])
    if x.size:
        options = {"ftol": _SETTLED, "xtol": 1e-3}
        x = minimize(
            lambda x: deviance(x)[0], x, method="Powell", bounds=[_RANGE] * x.size, options=options
        ).x
    noise, level = noise_at(x), np.sqrt(deviance(x)[1])
    return WhiteNoise(level * noise.process, level * noise.measurement)


def _spread(system: _System, filtered: _Filtered, covariances: _Covariances) -> Square:
    """Covariance of the innovations, by the noise."""
    C = system.C[:, system.noisy]
    return C @ filtered.error @ C.T + covariances.R


def _filter(system: _System, covariances: _Covariances) -> _Filtered:
    """The observer of least error in its steady state, and the start that suits the record.

    Source: Ljung, sec. 4.3, eq. 4.94 (innovations form, Kalman gain); 3.2 for predictors.
    """
    from scipy.linalg import solve_discrete_lyapunov

    noisy, (Q, S, R) = system.noisy, covariances
    A, C = system.A[np.ix_(noisy, noisy)], system.C[:, noisy]
    gain = _steady_gain(A, C, covariances, len(system.y))
    F = A - gain @ C
    error = np.asarray(solve_discrete_lyapunov(F, Q - S @ gain.T - gain @ S.T + gain @ R @ gain.T))
    every = np.zeros((len(system.A), len(C)))
    every[noisy] = gain
    back = system._replace(A=system.A - every @ system.C)
    driven = system.pushed + system.y @ every.T
    rest = system.y - _late(_windowed(back.A, driven, len(driven)), 1) @ system.C.T
    columns = _powers(back, len(rest))[:, :, system.start]
    filtered = _Filtered(every, error, np.zeros(0), rest, columns)
    root = np.linalg.cholesky(_spread(system, filtered, covariances))
    flat = np.linalg.solve(root, columns).reshape(rest.size, -1)
    scale = np.maximum(np.linalg.norm(flat, axis=0), 1e-300)
    aim = np.linalg.solve(root, rest.T).T.reshape(-1)
    start = np.linalg.lstsq(flat / scale, aim, rcond=1e-9)[0] / scale
    return filtered._replace(start=start, innovations=rest - columns @ start)


def _factors(
    system: _System, covariances: _Covariances, filtered: _Filtered
) -> tuple[Float[np.ndarray, " inputs"], Float[np.ndarray, " inputs"]]:
    """By what each input's effect has to be multiplied for the least one-step errors, and its
    standard error in noise with their spectrum. Consistent in a closed loop, where the noise is
    right: Ljung, sec. 13.4."""
    back = system.A - filtered.gain @ system.C
    effects = []
    for pushed, direct in system.by_input:
        # What passes directly corrects the states, too.
        states = _late(_windowed(back, pushed - direct @ filtered.gain.T, len(pushed)), 1)
        effects.append(states @ system.C.T + direct)
    inputs, root = len(effects), np.linalg.cholesky(_spread(system, filtered, covariances))
    columns = np.concatenate([np.stack(effects, axis=2), filtered.columns], axis=2)
    whitened, e = np.linalg.solve(root, columns), np.linalg.solve(root, filtered.innovations.T).T
    flat = whitened.reshape(e.size, -1)
    scale = np.linalg.norm(flat, axis=0)
    moves = scale > 0
    scale = np.where(moves, scale, 1.0)
    inverse = np.linalg.pinv(flat / scale, rcond=1e-9) / scale[:, None]
    left = e - (flat @ (inverse @ e.reshape(-1))).reshape(e.shape)
    ways = inverse[:inputs].T.reshape(*e.shape, inputs)
    covariance = projected_noise(ways, left, orthonormal(whitened), 0)
    error = np.where(moves[:inputs], np.sqrt(np.diagonal(covariance)), np.inf)
    return 1 + inverse[:inputs] @ e.reshape(-1), error


def _steady_gain(
    A: Square, C: Float[np.ndarray, "outputs states"], covariances: _Covariances, samples: int
) -> Float[np.ndarray, "states outputs"]:
    """Kalman's gain. Where a mode that noise does not drive keeps its size, no steady state has the
    least error: past samples then count less by a factor e within the record.
    Source: Anderson & Moore, Optimal Filtering, sec. 4.4; sec. 6.2 (exponential data weighting)."""
    from scipy.linalg import solve_discrete_are

    Q, S, R = covariances
    error = np.linalg.LinAlgError("no observer is stable: a mode is not seen by any output")
    for weight in (1.0, np.exp(1 / samples)):
        try:
            P = np.asarray(solve_discrete_are(weight * A.T, C.T, Q, R, s=S))
        except (np.linalg.LinAlgError, ValueError):
            continue
        gain = np.linalg.solve(C @ P @ C.T + R, (A @ P @ C.T + S / weight).T).T
        if np.max(np.abs(np.linalg.eigvals(A - gain @ C)), initial=0.0) < 1 - 1e-9:
            return gain
    raise error


def _windowed(
    A: Square, d: Float[np.ndarray, "samples states"], count: int
) -> Float[np.ndarray, "samples states"]:
    """The sums of A^i d[k - i] over i < count, by doubling."""
    total, length, over, power, part, width = np.zeros_like(d), 0, np.eye(len(A)), A, d, 1
    while count:
        if count & 1:
            total, length = total + _late(part, length) @ over.T, length + width
            over = over @ power
        if count := count >> 1:
            part = part + _late(part, width) @ power.T
            power, width = power @ power, 2 * width
    return total


def _powers(system: _System, samples: int) -> Float[np.ndarray, "samples outputs states"]:
    """C A^k, by doubling."""
    rows, power = system.C[None], system.A
    while len(rows) < samples:
        rows, power = np.concatenate([rows, rows @ power]), power @ power
    return rows[:samples]


def _late(x: Float[np.ndarray, "samples columns"], count: int) -> np.ndarray:
    count = min(count, len(x))
    return np.concatenate([np.zeros((count, x.shape[1])), x[: len(x) - count]])


def _ljung_box(e: Float[np.ndarray, " samples"]) -> float:
    """The chance of so much autocorrelation if `e` is white.
    Source: Ljung & Box, On a measure of lack of fit in time series models, 1978."""
    from scipy.special import gammaincc

    lags = np.arange(1, min(_LAGS, len(e) // 2) + 1)
    correlations = np.array([e[k:] @ e[:-k] for k in lags]) / max(float(e @ e), 1e-300)
    total = len(e) * (len(e) + 2) * np.sum(correlations**2 / (len(e) - lags))
    return float(gammaincc(len(lags) / 2, total / 2))
