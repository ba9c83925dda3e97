import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Complex, Float

from jaxquad.records import Record

from ._checks import check_alike, check_references
from ._density import spectral_density
from ._estimators import Welch
from ._frequency_response import FrequencyResponse


_AMPLIFIED = 10.0  # factor on the relative error from which the loop hides the plant


def deembed(
    closed: FrequencyResponse,
    controller: Any,
    *,
    entry: Literal["set-point", "plant input"] = "set-point",
) -> FrequencyResponse:
    """The plant out of a measured closed loop whose controller is known.

    `closed` is the response of the output to what was injected: at the `entry` "set-point" it is
    T = G C / (1 + G C), so G = T / (C (1 - T)); at the "plant input" P = G / (1 + G C), so
    G = P / (1 - P C). `controller` has `frequency_response(omega)` (from minus the output to the
    plant input) and is taken as exact. Errors are carried over, to first order.
    Raises `ValueError` for another entry or shape.
    """
    measured = np.asarray(closed.response)
    feedback = np.asarray(controller.frequency_response(jnp.asarray(closed.omega)))
    if measured.shape[1:] != (1, 1) or feedback.shape != measured.shape:
        raise ValueError(
            f"deembed takes one response and one controller, not {measured.shape} and "
            f"{feedback.shape} (frequencies, outputs, inputs): pick channels with jq.records.select"
        )
    if entry == "set-point":
        rest = 1 - measured
        plant, slope = measured / (feedback * rest), 1 / (feedback * rest**2)
    elif entry == "plant input":
        rest = 1 - measured * feedback
        plant, slope = measured / rest, 1 / rest**2
    else:
        raise ValueError(f"entry {entry!r}: the signal enters at 'set-point' or 'plant input'")
    amplified = np.abs(slope * measured / plant)
    errors = dataclasses.replace(
        closed.errors, effect=closed.errors.effect * jnp.asarray(slope[:, 0])[:, :, None]
    )
    return dataclasses.replace(
        closed,
        response=jnp.asarray(plant),
        random_error=closed.random_error * jnp.asarray(amplified),
        errors=errors,
        remarks=closed.remarks + _hidden(np.asarray(closed.omega), amplified[:, 0, 0]),
    )


def _hidden(omega: np.ndarray, amplified: np.ndarray) -> tuple[str, ...]:
    lost = omega[amplified > _AMPLIFIED]
    if not lost.size:
        return ()
    return (
        f"the loop hides the plant at {lost.size} of {omega.size} frequencies "
        f"({lost[0]:.3g}..{lost[-1]:.3g} rad/s): errors of the closed loop are amplified more than "
        f"{_AMPLIFIED:g} times there",
    )


_PULLED = 0.02  # share of the way to -1/C from which it is worth a word


class Feedback(eqx.Module):
    """How far noise that a controller feeds back pulls the direct estimate from the plant.

    With the part of the input that the reference explains, of coherence g^2, the direct estimate is
    H1 = g^2 G + (1 - g^2) (-1/C): `pull` is 1 - g^2, `joint` is G, and `inverse` is -1/C as the
    rest of input and output show it, whatever the controller is.
    """

    omega: Float[np.ndarray, " frequencies"]  # rad/s
    direct: Complex[np.ndarray, " frequencies"]
    joint: Complex[np.ndarray, " frequencies"]
    inverse: Complex[np.ndarray, " frequencies"]
    pull: Float[np.ndarray, " frequencies"]  # 0 to 1

    @property
    def bias(self) -> Complex[np.ndarray, " frequencies"]:
        """Relative error of the direct estimate, H1 / G - 1."""
        return self.direct / self.joint - 1

    def __str__(self) -> str:
        worst = int(np.argmax(self.pull))
        size = np.abs(self.bias)
        lines = [
            f"feedback: {100 * np.median(self.pull):.2g} % of the input is fed back noise "
            f"(median), at most {100 * self.pull[worst]:.2g} % at {self.omega[worst]:.3g} rad/s",
            f"  the direct estimate is off by {100 * np.median(size):.2g} % (median), at most "
            f"{100 * size.max():.2g} % at {self.omega[int(np.argmax(size))]:.3g} rad/s",
        ]
        if np.max(self.pull) > _PULLED:
            lines.append("  use the joint estimate: it is the default where a reference is given")
        return "\n".join(lines)


def feedback_pull(
    record: Record | Sequence[Record],
    omega: Float[ArrayLike, " frequencies"] | None = None,
    *,
    welch: Welch | None = None,
) -> Feedback:
    """Split input and output by the reference, and compare direct estimate, plant and -1/C.

    One input, one output, one outside reference. Raises `ValueError` for other channels, an
    unusable band or record. Source: Wellstead (1981), Non-parametric methods of system
    identification; Forssell & Ljung (1999), Closed-loop identification revisited.
    """
    records = [record] if isinstance(record, Record) else list(record)
    check_alike(records)
    check_references(records)
    first = records[0]
    if len(first.input_names) != 1 or len(first.output_names) != 1:
        raise ValueError(
            f"feedback_pull compares one input with one output, the record has "
            f"{first.input_names} and {first.output_names}: pick them with jq.records.select"
        )
    found = spectral_density(records, omega, welch=welch)
    u, y, r = first.names
    power, spread = np.asarray(found.power(u)), np.asarray(found.power(r))
    cross, from_u, from_y = (np.asarray(found.cross(*pair)) for pair in ((u, y), (r, u), (r, y)))
    explained = np.abs(from_u) ** 2 / spread
    joint = from_y / from_u
    rest = np.maximum(power - explained, 1e-300)
    return Feedback(
        np.asarray(found.omega),
        cross / power,
        joint,
        (cross - np.conj(from_u) * from_y / spread) / rest,
        np.clip(1 - explained / power, 0.0, 1.0),
    )
