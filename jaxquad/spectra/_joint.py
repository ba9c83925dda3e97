"""The plant from the responses of its inputs and outputs to references."""

import numpy as np
from jaxtyping import Bool, Complex, Float, Int

from jaxquad.records import Record

from ._local_fit import LocalFit
from ._local_noise import partial_coherence, power_alone
from ._noise import Noise, smooth_noise


_DEPENDENT = 1e-6  # smallest singular value of the responses of the inputs, to the largest
DIVISIBLE = 0.15  # largest random error of an input's response to the references


def check_count_of_references(record: Record, inputs: int) -> None:
    count = record.references.shape[1]
    if count != inputs:
        raise ValueError(
            f"the joint estimate of {inputs} inputs {list(record.input_names)} needs as many "
            f"external references; the record has {count}: {list(record.reference_names)}"
        )


def joint_factors(fit: LocalFit, inputs: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where T_ru has an inverse, [-G, 1], and that inverse: dG = [-G, 1] dT T_ru^-1."""
    invertible = fit.determined
    through = np.where(invertible[:, None, None], fit.response[:, :inputs], np.eye(inputs))
    strength = np.linalg.svd(through, compute_uv=False)
    invertible &= strength[:, -1] > _DEPENDENT * strength[:, 0]
    back = np.linalg.inv(np.where(invertible[:, None, None], through, np.eye(inputs)))
    response = fit.response[:, inputs:] @ back
    outputs = response.shape[1]
    ones = np.broadcast_to(np.eye(outputs), (len(back), outputs, outputs))
    return invertible, np.concatenate([-response, ones], axis=2), back


def joint_fit(fit: LocalFit, inputs: int) -> LocalFit:
    """The fit of the plant, G = T_ry T_ru^-1, from that of the references to [inputs, outputs].

    Its error is (dT_ry - G dT_ru) T_ru^-1: the noise is v = y - G u, and the effect that of the
    references taken through T_ru^-1. Source: Pintelon and Schoukens, System Identification,
    2nd ed., section 2.6 (several inputs: 7.2.7).
    """
    invertible, left, back = joint_factors(fit, inputs)
    through, response = fit.response[:, :inputs], -left[:, :, :inputs]
    blank = np.where(invertible, 1.0, np.nan)[:, None, None]
    effect = np.swapaxes(back, 1, 2) @ fit.effect * blank
    scatter = left @ fit.scatter @ _adjoint(left) * blank
    boosted = left * fit.boost[:, None, :]
    boosted = _diagonal(boosted @ fit.scatter @ _adjoint(boosted))
    boost = np.sqrt(boosted / np.maximum(_diagonal(scatter), 1e-300))
    gain = boost[:, :, None] ** 2 * np.vecdot(effect, effect).real[:, None, :]
    power = through @ fit.power @ _adjoint(through)
    freedom = np.where(invertible, fit.freedom, 0.0)
    return LocalFit(response * blank, effect, boost, gain, fit.first, scatter, freedom, power)


def coherence_of_references(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    fit: LocalFit,
    inputs: int,
) -> Float[np.ndarray, "frequencies outputs inputs"]:
    """Partial coherence of the joint estimate: the smaller of the shares of input and output.

    Of the input, what the references move of it and of no other input; of the output, what
    responds to that, beside the noise. Source: Bendat and Piersol, Random Data, ch. 7.
    """
    noise = smooth_noise(omega, half_width, fit.scatter, fit.freedom)
    moved = noise.power[:, None, :inputs]
    plant = joint_fit(fit, inputs)
    alone = power_alone(plant)[:, None, :]
    through = partial_coherence(plant, noise.power[:, inputs:])
    return np.minimum(through, alone / (alone + moved))


def share_of_inputs(
    left: Complex[np.ndarray, "frequencies outputs moved"],
    noise: Noise,
    at: Int[np.ndarray, " frequencies"],
    inputs: int,
) -> Float[np.ndarray, "frequencies outputs inputs"]:
    """Share of a joint estimate's squared error that the noise of T_ru makes, and not of T_ry.

    `left` is [-G, 1]; half of what both make together counts.
    """
    root = noise.root()[at]
    total = left @ root
    of_inputs = left[:, :, :inputs] @ root[:, :inputs]
    power = np.vecdot(total, total).real
    mine = np.sum(np.real(of_inputs * np.conj(total)), axis=2)
    share = np.clip(mine / np.maximum(power, 1e-300), 0.0, 1.0)
    return np.repeat(share[:, :, None], inputs, axis=2)


def find_unmoved(
    moved: LocalFit, noise: Noise, at: Int[np.ndarray, " frequencies"], inputs: int
) -> Bool[np.ndarray, " frequencies"]:
    """Where the references move an input too little to divide by.

    There the joint ratio is that of two noises: -1 over the controller, with hardly any residual.
    """
    invertible, _, back = joint_factors(moved, inputs)
    effect = np.sum(np.abs(np.swapaxes(back, 1, 2) @ moved.effect) ** 2, axis=2)
    relative = np.sqrt(noise.power[at][:, :inputs] * effect / 2)
    return invertible & np.any(relative > DIVISIBLE, axis=1)


def _diagonal(x: Complex[np.ndarray, "frequencies a a"]) -> Float[np.ndarray, "frequencies a"]:
    return np.real(np.diagonal(x, axis1=1, axis2=2))


def _adjoint(x: np.ndarray) -> np.ndarray:
    return np.conj(np.swapaxes(x, 1, 2))
