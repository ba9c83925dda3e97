import dataclasses
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Complex, Float

from jaxquad.models import Model
from jaxquad.records import Record

from ._checks import check_compatible, check_references, in_hertz
from ._estimators import Welch
from ._frequency_response import FrequencyResponse
from ._remarks import Remark
from ._welch import spectral_density


_AMPLIFIED = 10.0  # factor on the relative error from which a remark is made


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

    **Raises:**

    - `ValueError`: for another entry, or responses with more than one input or output.
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
    errors = closed.errors.scaled(jnp.asarray(slope[:, 0, 0]))
    return dataclasses.replace(
        closed,
        response=jnp.asarray(plant),
        random_error=closed.random_error * jnp.asarray(amplified),
        errors=errors,
        remarks=(*closed.remarks, *_remark_on_errors(np.asarray(closed.omega), amplified[:, 0, 0])),
    )


def _remark_on_errors(omega: np.ndarray, amplified: np.ndarray) -> tuple[Remark, ...]:
    lost = omega[amplified > _AMPLIFIED]
    if not lost.size:
        return ()
    text = (
        f"the closed loop hardly depends on the plant {{where}}: its errors are amplified more "
        f"than {_AMPLIFIED:g} times there. Leave these frequencies out, or inject the signal at "
        "the plant input"
    )
    return (Remark(text, lost),)


_SIGNIFICANT = 0.02  # share of noise in the input from which the joint estimate is recommended


class FeedbackBias(eqx.Module):
    """The bias of the direct estimate by noise that a controller C feeds back.

    With g^2 the coherence of reference and input, the direct estimate is
    H1 = g^2 G + (1 - g^2) (-1/C). `noise_share` is 1 - g^2, `joint` is G, and `inverse` is -1/C,
    estimated from the parts of input and output that the reference does not explain.
    """

    omega: Float[np.ndarray, " frequencies"]  # rad/s
    direct: Complex[np.ndarray, " frequencies"]
    joint: Complex[np.ndarray, " frequencies"]
    inverse: Complex[np.ndarray, " frequencies"]
    noise_share: Float[np.ndarray, " frequencies"]  # of the input's power, 0 to 1

    @property
    def bias(self) -> Complex[np.ndarray, " frequencies"]:
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

    **Raises:**

    - `ValueError`: for other channels, and for frequencies that the window does not resolve.
    """
    records = [record] if isinstance(record, Record) else list(record)
    check_compatible(records)
    check_references(records)
    first = records[0]
    if len(first.input_names) != 1 or len(first.output_names) != 1:
        raise ValueError(
            f"feedback_bias needs one input and one output, but the record has "
            f"{first.input_names} and {first.output_names}: select them with jq.records.select"
        )
    found = spectral_density(records, omega, welch=welch)
    u, y, r = first.names
    power, spread = np.asarray(found.power(u)), np.asarray(found.power(r))
    cross, from_u, from_y = (np.asarray(found.cross(*pair)) for pair in ((u, y), (r, u), (r, y)))
    explained = np.abs(from_u) ** 2 / spread
    joint = from_y / from_u
    rest = np.maximum(power - explained, 1e-300)
    return FeedbackBias(
        np.asarray(found.omega),
        cross / power,
        joint,
        (cross - np.conj(from_u) * from_y / spread) / rest,
        np.clip(1 - explained / power, 0.0, 1.0),
    )
