"""By way of the references: one local fit to inputs and outputs, and what it says of the plant."""

import numpy as np
from jaxtyping import Complex, Float

from ._local_fit import LocalFit
from ._local_noise import smooth_noise


_DEPENDENT = 1e-6  # smallest singular value of the responses of the inputs, to the largest


def joint_fit(fit: LocalFit, inputs: int) -> LocalFit:
    """The fit of the plant, G = T_ry T_ru^-1, from that of the references to [inputs, outputs].

    Its error is (dT_ry - G dT_ru) T_ru^-1: the noise is v = y - G u, and the effect that of the
    references taken through T_ru^-1. Source: Pintelon and Schoukens, System Identification,
    2nd ed., section 2.6 (several inputs: 7.2.7).
    """
    known = np.isfinite(fit.response[:, 0, 0])
    through = np.where(known[:, None, None], fit.response[:, :inputs], np.eye(inputs))
    strength = np.linalg.svd(through, compute_uv=False)
    known &= strength[:, -1] > _DEPENDENT * strength[:, 0]
    back = np.linalg.inv(np.where(known[:, None, None], through, np.eye(inputs)))
    response = fit.response[:, inputs:] @ back
    outputs = response.shape[1]
    ones = np.broadcast_to(np.eye(outputs), (len(back), outputs, outputs))
    left = np.concatenate([-response, ones], axis=2)
    blank = np.where(known, 1.0, np.nan)[:, None, None]
    effect = np.swapaxes(back, 1, 2) @ fit.effect * blank
    scatter = left @ fit.scatter @ _adjoint(left) * blank
    boosted = left * fit.boost[:, None, :]
    boosted = _diagonal(boosted @ fit.scatter @ _adjoint(boosted))
    boost = np.sqrt(boosted / np.maximum(_diagonal(scatter), 1e-300))
    gain = boost[:, :, None] ** 2 * np.sum(np.abs(effect) ** 2, axis=2)[:, None, :]
    power = through @ fit.power @ _adjoint(through)
    freedom = np.where(known, fit.freedom, 0.0)
    return LocalFit(response * blank, effect, boost, gain, fit.first, scatter, freedom, power)


def coherence_of_references(
    omega: Float[np.ndarray, " frequencies"],
    half_width: Float[np.ndarray, " frequencies"],
    fit: LocalFit,
    inputs: int,
) -> Float[np.ndarray, "frequencies outputs inputs"]:
    """The lesser of what all references explain of each input's power and of each output's."""
    noise = smooth_noise(omega, half_width, fit.scatter, fit.freedom)
    explained = _diagonal(fit.response @ fit.power @ _adjoint(fit.response))
    coherence = explained / (explained + noise.power)
    return np.minimum(coherence[:, inputs:, None], coherence[:, None, :inputs])


def _diagonal(x: Complex[np.ndarray, "frequencies a a"]) -> Float[np.ndarray, "frequencies a"]:
    return np.real(np.diagonal(x, axis1=1, axis2=2))


def _adjoint(x: np.ndarray) -> np.ndarray:
    return np.conj(np.swapaxes(x, 1, 2))
