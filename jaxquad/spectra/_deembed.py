import dataclasses
from typing import Any, Literal

import jax.numpy as jnp
import numpy as np

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
            f"{feedback.shape} (frequencies, outputs, inputs): pick channels with jq.select"
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
