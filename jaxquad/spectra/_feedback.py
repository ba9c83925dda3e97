"""Feedback: signs that a controller made the coherence, the bias by it, the plant without it.

The bias is that of spectral densities, which are here, too.
"""

import dataclasses
import functools as ft
import itertools
from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Complex, Float, Int

from jaxquad._core import one_blas_thread
from jaxquad.models import Model
from jaxquad.records import Record

from ._average import frequencies_for, transform_records
from ._estimators import (
    adjoint,
    check_references,
    COHERENT,
    compatible,
    DOMINATED,
    EARLY,
    Grid,
    in_hertz,
    Method,
    Remark,
    Response,
    Welch,
)
from ._fourier_sums import coefficients
from ._frequency_response import Estimate, FrequencyResponse


_AMPLIFIED = 10.0  # factor on the relative error from which a remark is made
_SIGNIFICANT = 0.02  # share of noise in the input from which the joint estimate is recommended
_CHANCE = 1.35e-3  # of calling the phase of any pair rising: 3 standard errors of a single slope
_FALLS = 0.35  # rad over the top of the coherent band: less than an actuator's phase falls there
_LESS = 0.05  # power of 1/omega by which a lag's magnitude falls there
_NEARLY_ALL, _MORE = 0.9, 0.5  # median shares of the input's power, output first and input first
_FEWEST = 8  # frequencies for a slope
_TOP = 4.0  # ratio of frequencies, at the top of the coherent band, over which the phase must fall

Covariance = Callable[[], Complex[np.ndarray, "frequencies frequencies"]]

_RISES = (
    "feedback-dominated: the phase increases with frequency at the top of the coherent "
    "band, like that of -1/C and unlike that of any actuator; the coherence there "
    "comes from the controller. Add excitation, and name it as the reference. Without a "
    "controller, input and output are swapped, or the output's time stamps are at least "
    "{lead:.2g} ms early"
)
_EARLY = (
    "the phase increases with frequency at the top of the coherent band, unlike that of any "
    "actuator, as if the output came at least {lead:.2g} ms before the input: exchange input and "
    "output if they are swapped, or correct their time stamps"
)
_FED_BACK = (
    "feedback-dominated: {share:.0f} % of the input's power (median) {where} comes from the "
    "output's own disturbances and noise: most of the response there is -1/C, that of the "
    "controller, and not the plant's (one without any lag in this band would look alike). Name the "
    "external reference; without one, excite the axis, and record what excites it"
)


def remarks_on_feedback(
    records: Sequence[Record], method: Method, estimate: Estimate
) -> tuple[Remark, ...]:
    """Remarks on feedback; points of overlapping windows count as independent."""
    from scipy.special import ndtri

    outputs, inputs, omega = records[0].output_names, records[0].input_names, estimate.omega
    remarks, clear = [], float(ndtri(1 - _CHANCE / (len(outputs) * len(inputs))))
    for (o, output), (i, source) in itertools.product(enumerate(outputs), enumerate(inputs)):
        pair, place = (output, source), (slice(None), o, i)
        direct, finite = estimate.direct_coherence[place], np.isfinite(estimate.response[place])
        # Coherent, although the reference explains neither.
        dominated = (direct >= COHERENT) & (estimate.coherence[place] < COHERENT)
        if method == "joint" and 2 * np.sum(dominated) > np.sum(direct >= COHERENT):
            text = (
                "feedback-dominated: input and output are coherent at "
                f"{np.sum(direct >= COHERENT)} frequencies, but at {np.sum(dominated)} of them, "
                f"{in_hertz(omega[dominated])}, the reference explains neither. There the "
                "controller feeds back noise, and the record holds no information on the plant. "
                "Excite these frequencies by the reference"
            )
            remarks.append(Remark(text, pair=pair, kind=DOMINATED))
        values = np.where(finite, estimate.response[place], 1.0)
        doubt = np.where(finite, estimate.random_error[place], np.inf)
        coherent = np.where(finite, estimate.coherence[place], 0.0)
        slope = phase_slope(omega, values, doubt, coherent)
        if slope is None:
            continue
        # What the phase at the top of the coherent band says, where it falls as no actuator's does.
        errors = estimate.errors
        covariance = (
            None if errors.windows is not None else ft.partial(errors.between, (o, i), (o, i))
        )
        rises, lead = slope.rises(values, covariance, clear), 1e3 * slope.value
        used = omega[coherent >= COHERENT]
        if method == "joint":
            remarks += [Remark(_EARLY.format(lead=lead), used, pair, EARLY)] if rises else []
            continue
        signals = [np.stack([x.outputs[:, o], x.inputs[:, i]]) for x in records]
        share = share_from_output(signals, records[0].dt, used)
        # Whether the output makes nearly all of the input at most of the coherent frequencies. The
        # same holds of a plant whose answer is logged beside its cause, as far as nothing else
        # moves either. It lags: where the output makes the input, its phase and magnitude fall.
        # Where they do, the input's past must follow the output's, too.
        by_controller = np.median(share.output_first) > _NEARLY_ALL
        if by_controller and np.median(share.input_first) <= _MORE:
            level = np.zeros(omega.size)
            level[coherent >= COHERENT] = share.output_first > _NEARLY_ALL
            moved = phase_slope(omega, values, doubt, level)
            by_controller = moved is not None and (
                moved.value * moved.span >= -_FALLS and moved.order >= -_LESS
            )
        if rises:
            where = used if by_controller else omega[slope.top]
            remarks.append(Remark(_RISES.format(lead=lead), where, pair, DOMINATED))
        elif by_controller:
            power = 100 * np.median(share.output_first)
            text = _FED_BACK.format(share=power, where="{where}")
            remarks.append(Remark(text, used, pair, DOMINATED))
    return tuple(dict.fromkeys(remarks))


class PhaseSlope(NamedTuple):
    """That of the phase over the top of the coherent band, in rad per rad/s."""

    top: Int[np.ndarray, " top"]  # places of the frequencies
    pull: Float[np.ndarray, " top"]  # from their phases to the slope
    value: float
    variance: float  # were their errors independent
    span: float  # rad/s
    order: float  # of the magnitude: -1 where it falls as 1/omega

    def rises(
        self, response: Response, covariance: Covariance | None = None, clear: float = 3.0
    ) -> bool:
        """Whether the phase rises by `clear` standard errors: as that of -1/C, no actuator's."""
        variance, top = self.variance, self.top
        if covariance is not None and self.value > clear * np.sqrt(variance):
            turned = self.pull / np.conj(response[top])
            shared = turned.conj() @ covariance()[np.ix_(top, top)] @ turned
            variance = max(variance, 0.5 * float(np.real(shared)))
        return bool(self.value > clear * np.sqrt(variance))


def phase_slope(omega: Grid, response: Response, error: Grid, coherence: Grid) -> PhaseSlope | None:
    """At the highest coherent frequency that has enough others below it; `None` without any."""
    good, top = np.flatnonzero(coherence >= COHERENT), np.zeros(0, int)
    for end in range(len(good), _FEWEST - 1, -1):
        top = good[:end][omega[good[:end]] >= omega[good[end - 1]] / _TOP]
        if len(top) >= _FEWEST:
            break
    if len(top) < _FEWEST:
        return None
    weight = 1 / np.maximum(error[top], 1e-3) ** 2
    weight = np.minimum(weight, 4 * np.median(weight))
    centred = omega[top] - np.average(omega[top], weights=weight)
    level = np.unwrap(np.angle(response[top]))
    level = level - np.average(level, weights=weight)
    spread = np.sum(weight * centred**2)
    pull = weight * centred / spread
    slope = float(pull @ level)
    scatter = np.sum(weight * (level - slope * centred) ** 2) / (len(top) - 2)
    variance = max(float(scatter), 1.0) / spread
    span = float(omega[top[-1]] - omega[top[0]])
    order = np.polyfit(np.log(omega[top]), np.log(np.abs(response[top])), 1, w=np.sqrt(weight))[0]
    return PhaseSlope(top, pull, slope, float(variance), span, float(order))


_ORDER = 12  # samples of both that the model remembers
_ENOUGH = 20 * _ORDER  # samples for a model
_LEVELS = (16.0, 4.0, 2.0, 1.0)  # half the sample rate over the highest frequency of interest
_ROUNDING = 1e-9  # of a signal's power, added as white noise: what rounding may make
_CONFIRMED = 0.5  # of the largest median share, at the highest rate
_EXACT = 1e-7  # of its power: new parts of the output below it say nothing


class Share(NamedTuple):
    """Of the input's power at each frequency, that which the output's innovations make.

    What both have in common at one sample is the output's in `output_first`, because a plant takes
    time to answer, and the input's in `input_first`, because a logger may write an answer beside
    its cause.
    """

    output_first: Grid
    input_first: Grid


def share_from_output(
    records: Sequence[Float[np.ndarray, "2 _samples"]], dt: float, omega: Grid
) -> Share:
    """The directed share of Geweke (1982) by an autoregressive model; zero for records too short.

    `records` are of output and input. Of several sample rates, the one with the largest median
    counts. At one so slow that a plant answers within a sample, it can be mistaken for its
    controller: the highest rate has to show half of it, too.
    """
    flat = []
    for x in records:  # without offset and trend, in units of the standard deviation
        time = np.linspace(-1.0, 1.0, x.shape[1])
        slope = x @ time / (time @ time)
        flat.append(x - np.mean(x, axis=1, keepdims=True) - slope[:, None] * time)
    squares = sum(np.einsum("cs,cs->c", x, x) for x in flat)
    size = np.sqrt(squares / sum(x.shape[1] for x in flat))
    signals = [x / np.maximum(size, 1e-300)[:, None] for x in flat]
    shares = [Share(np.zeros(omega.size), np.zeros(omega.size))]
    for every in dict.fromkeys(max(int(np.pi / (dt * n * omega[-1])), 1) for n in _LEVELS):
        slow = []
        for x in signals:  # every so many samples, of what lies below half the new rate
            if x.shape[1] < 2 * _ORDER * every:
                continue
            count = x.shape[1] // every
            spectrum = np.fft.rfft(x[:, : count * every])[:, : count // 2 + 1]
            slow.append(x if every == 1 else np.fft.irfft(spectrum, count))
        samples = sum(x.shape[1] - _ORDER for x in slow)
        if samples >= _ENOUGH:
            products = sum(lagged_products(x) for x in slow) / samples
            products += _ROUNDING * np.diag(np.tile(np.diag(products)[:2], _ORDER + 1))
            # By the model's response, from the innovations of output and input to the input.
            past = np.linalg.solve(products[2:, 2:], products[2:, :2])
            new = products[:2, :2] - products[:2, 2:] @ past
            if not new[0, 0] > _EXACT * products[0, 0]:
                shares.append(shares[0])
                continue
            late = np.exp(-1j * (omega * dt * every)[:, None] * np.arange(1, _ORDER + 1))
            taken = np.einsum("fk,kij->fji", late, past.reshape(_ORDER, 2, 2))
            from_output, from_input = paths = np.linalg.inv(np.eye(2) - taken)[:, 1].T
            power = np.maximum(np.einsum("if,ij,jf->f", paths.conj(), new, paths).real, 1e-300)
            both = new[0, 0] * np.abs(from_output + new[1, 0] / new[0, 0] * from_input) ** 2
            alone = max(new[0, 0] - new[0, 1] ** 2 / max(new[1, 1], 1e-300), 0.0)
            shares.append(Share(both / power, alone * np.abs(from_output) ** 2 / power))
    medians = [float(np.median(share.output_first)) for share in shares]
    best, quickest = int(np.argmax(medians)), min(1, len(shares) - 1)
    return shares[best if medians[quickest] > _CONFIRMED * medians[best] else quickest]


def lagged_products(x: Float[np.ndarray, "2 samples"]) -> Float[np.ndarray, "lags lags"]:
    """Sums of x[t - i] and x[t - j] over t: by their distance, but for the record's ends."""
    n, p = x.shape[1], _ORDER
    sums = np.zeros((p + 1, 2, p + 1, 2))
    for k in range(p + 1):
        i, s = np.arange(p + 1 - k), np.arange(p - k)
        first, last = p - 1 - s, n - 1 - s
        entering = np.einsum("as,bs->sab", x[:, first], x[:, first - k])
        leaving = np.einsum("as,bs->sab", x[:, last], x[:, last - k])
        blocks = np.zeros((p + 1 - k, 2, 2)) + x[:, p:] @ x[:, p - k : n - k].T
        blocks[1:] += np.cumsum(entering - leaving, axis=0)
        sums[i, :, i + k], sums[i + k, :, i] = blocks, blocks.transpose(0, 2, 1)
    return sums.reshape(2 * p + 2, 2 * p + 2)


def deembed(
    closed: FrequencyResponse,
    controller: Model,
    *,
    entry: Literal["set-point", "plant input"] = "set-point",
) -> FrequencyResponse:
    """Calculate the plant from a measured closed loop whose controller is known.

    With T = G C / (1 + G C) measured from the set-point, G = T / (C (1 - T)); with
    P = G / (1 + G C) measured from the plant input, G = P / (1 - P C). Random errors are propagated
    to first order.

    **Arguments:**

    - `closed`: the `FrequencyResponse` of one output to the injected signal.
    - `controller`: has `frequency_response(omega)`, from minus the output to the plant input, shape
        `(frequencies, 1, 1)`; it is taken as exact.
    - `entry`: where the signal was injected, `"set-point"` or `"plant input"`.

    **Returns:** the `FrequencyResponse` of the plant, with a remark where the loop amplifies the
    errors of the closed loop more than ten times.

    **Raises:** ValueError for another entry, or responses with more than one input or output.
    """
    measured = np.asarray(closed.response)
    feedback = np.asarray(controller.frequency_response(jnp.asarray(closed.omega)))
    if measured.shape[1:] != (1, 1) or feedback.shape != measured.shape:
        raise ValueError(
            f"deembed needs one input and one output, but the response has shape {measured.shape} "
            f"and the controller's {feedback.shape} (frequencies, outputs, inputs): select "
            "channels with jq.records.select"
        )
    if entry == "set-point":
        rest = 1 - measured
        plant, slope = measured / (feedback * rest), 1 / (feedback * rest**2)
    elif entry == "plant input":
        rest = 1 - measured * feedback
        plant, slope = measured / rest, 1 / rest**2
    else:
        raise ValueError(f"entry is {entry!r}: use 'set-point' or 'plant input'")
    amplified = np.abs(slope * measured / plant)
    lost, remarks = np.asarray(closed.omega)[amplified[:, 0, 0] > _AMPLIFIED], list(closed.remarks)
    if lost.size:
        text = (
            f"the closed loop hardly depends on the plant {{where}}: its errors are amplified more "
            f"than {_AMPLIFIED:g} times there. Leave these frequencies out, or inject the signal "
            "at the plant input"
        )
        remarks.append(Remark(text, lost, kind="amplified errors"))
    errors = closed.errors.scaled(jnp.asarray(slope[:, 0, 0]))
    return dataclasses.replace(
        closed,
        response=jnp.asarray(plant),
        random_error=closed.random_error * jnp.asarray(amplified),
        errors=errors,
        remarks=tuple(remarks),
    )


class SpectralDensity(eqx.Module):
    """One-sided power and cross spectral densities of all channels of a record.

    `density[:, a, b]` is the average of conj(X_a) X_b, scaled so that its integral over the
    positive frequencies in Hz is a power; its unit is that of a times that of b, per Hz.
    """

    omega: Float[Array, " frequencies"]  # rad/s
    density: Complex[Array, "frequencies channels channels"]  # Hermitian
    names: tuple[str, ...] = eqx.field(static=True)

    def power(self, name: str) -> Float[Array, " frequencies"]:
        """Power spectral density of one channel."""
        return jnp.real(self.cross(name, name))

    def cross(self, a: str, b: str) -> Complex[Array, " frequencies"]:
        """Cross-spectral density of `a` and `b`: its phase is that of b minus that of a."""
        return self.density[:, self._position(a), self._position(b)]

    def coherence(self, a: str, b: str) -> Float[Array, " frequencies"]:
        """Magnitude-squared coherence, from 0 to 1."""
        return jnp.abs(self.cross(a, b)) ** 2 / (self.power(a) * self.power(b))

    def _position(self, name: str) -> int:
        if name not in self.names:
            raise ValueError(
                f"there is no channel {name!r}: the channels are {', '.join(self.names)}"
            )
        return self.names.index(name)


@one_blas_thread()
def spectral_density(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | float | int | None = None,
    *,
    welch: Welch | None = None,
) -> SpectralDensity:
    """Estimate the power and cross spectral densities of all channels.

    **Arguments:**

    - `record`: one `Record`, or several with the same channels and sample rate, which are taken
        together.
    - `omega`: frequencies in rad/s, increasing; by default 100 log-spaced ones from three cycles in
        a window to a tenth of the sample rate.
    - `welch`: window and overlap, by default `jq.spectra.Welch()`. Its integrators and delay apply
        to the outputs only.

    **Returns:** a `SpectralDensity`.

    **Raises:**

    - `ValueError`: for frequencies that the window does not resolve, and records that differ.
    - `PrecisionError`, a `ValueError`: JAX runs in 32 bits; call `jq.enable_x64()` first.
    """
    records = compatible(record)
    welch = Welch() if welch is None else welch
    omega = frequencies_for(omega, records, welch)
    segments = transform_records(records, omega, [welch])
    [transforms], [(length, _)] = segments.transforms, segments.groups
    level, cosine = coefficients(welch.shape)
    energy = length * (level**2 + cosine**2 / 2)
    scale = 2 * records[0].dt / (energy * transforms.shape[1])
    put = jax.device_put
    return SpectralDensity(
        put(omega), put(adjoint(transforms) @ transforms * scale), records[0].names
    )


class FeedbackBias(eqx.Module):
    """The bias of the direct estimate by noise that a controller C feeds back.

    With g^2 the coherence of reference and input, the direct estimate is
    H1 = g^2 G + (1 - g^2) (-1/C). `noise_share` is 1 - g^2, `joint` is G, and `inverse` is -1/C,
    estimated from the parts of input and output that the reference does not explain.
    """

    omega: Grid  # rad/s
    direct: Response
    joint: Response
    inverse: Response
    noise_share: Grid  # of the input's power, 0 to 1

    @property
    def bias(self) -> Response:
        """Relative error of the direct estimate, H1 / G - 1."""
        return self.direct / self.joint - 1

    def __str__(self) -> str:
        worst, largest = int(np.argmax(self.noise_share)), int(np.argmax(np.abs(self.bias)))
        share, size = 100 * self.noise_share, 100 * np.abs(self.bias)
        lines = [
            f"feedback: {np.median(share):.2g} % of the input's power is fed-back noise (median), "
            f"at most {share[worst]:.2g} % at {in_hertz(self.omega[[worst]])}",
            f"  bias of the direct estimate: {np.median(size):.2g} % (median), at most "
            f"{size[largest]:.2g} % at {in_hertz(self.omega[[largest]])}",
        ]
        if np.max(self.noise_share) > _SIGNIFICANT:
            lines.append("  use the joint estimate, the default for a record with a reference")
        return "\n".join(lines)


def feedback_bias(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | None = None,
    *,
    welch: Welch | None = None,
) -> FeedbackBias:
    """Estimate how far feedback biases the direct estimate of a plant.

    Input and output are split into the part that the reference explains and the rest (Wellstead,
    1981, "Non-parametric methods of system identification"; Forssell and Ljung, 1999, "Closed-loop
    identification revisited").

    **Arguments:**

    - `record`: one `Record` or several, with one input, one output and one external reference.
    - `omega`: frequencies in rad/s; by default those of `welch`.
    - `welch`: window and overlap, by default `jq.spectra.Welch()`.

    **Returns:** a `FeedbackBias`, which prints as a summary.

    **Raises:** ValueError for other channels, and for frequencies that the window does not resolve.
    """
    records = compatible(record)
    check_references(records)
    first = records[0]
    if len(first.input_names) != 1 or len(first.output_names) != 1:
        raise ValueError(
            f"feedback_bias needs one input and one output, but the record has "
            f"{first.input_names} and {first.output_names}: select them with jq.records.select"
        )
    density = spectral_density(records, omega, welch=welch)
    u, y, r = first.names
    power, spread = np.asarray(density.power(u)), np.asarray(density.power(r))
    cross, from_u, from_y = (np.asarray(density.cross(*pair)) for pair in ((u, y), (r, u), (r, y)))
    explained = np.abs(from_u) ** 2 / spread
    joint = from_y / from_u
    rest = np.maximum(power - explained, 1e-300)
    return FeedbackBias(
        np.asarray(density.omega),
        cross / power,
        joint,
        (cross - np.conj(from_u) * from_y / spread) / rest,
        np.clip(1 - explained / power, 0.0, 1.0),
    )
