from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, PyTree

from jaxquad.excitation import Excitation
from jaxquad.identify._parameters import Free, Parameters, select_parameters
from jaxquad.spectra import require_x64

from ._information import check_distinct, information_per_energy, response_and_slopes
from ._noise import Noise, noise_covariance


class Prediction(eqx.Module):
    """The best standard errors that an experiment allows: the Cramer-Rao bound of its noise.

    Relative to the parameters' values, or to the scale of a `jq.Real`. `cramer_rao` is CIFER's, as
    `jq.fit` with `jq.MaximumLikelihood` prints it: sqrt(2) times the standard error, in per cent.
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

    def seconds_for(self, standard_errors: Any) -> Float[np.ndarray, " parameters"]:
        """Seconds of the same excitation, repeated, for each of these relative standard errors."""
        return self.seconds * (self.standard_errors / np.asarray(standard_errors)) ** 2

    def __str__(self) -> str:
        width = max(9, *(len(name) for name in self.names))
        head = f"{'parameter':<{width}} {'std.err. %':>11} {'CR %':>8}"
        rows = zip(self.names, 100 * self.standard_errors, self.cramer_rao, strict=True)
        return "\n".join([head, *(f"{n:<{width}} {e:11.3f} {c:8.3f}" for n, e, c in rows)])


def predict_accuracy(
    model: PyTree,
    excitation: Excitation,
    *,
    noise: Noise,
    free: Free = None,
    band: tuple[float, float] | None = None,
    input: int = 0,
) -> Prediction:
    """What a test signal at one `input` of `model` will tell of its `free` parameters.

    The signal's own transform weighs the information of each frequency in the `band` (rad/s), by
    default that of the excitation; a multisine counts at its lines, settled from the first period.
    `noise` is the outputs' one-sided spectral density in units^2/Hz: a number, one for each
    output, a function of omega in rad/s, or a `jq.MeasuredNoise`.
    Raises ValueError where the parameters cannot be told apart.
    """
    require_x64("a design")
    parameters = select_parameters(model, free)
    omega, energy = _energy(excitation)
    low, high = (excitation.omega_min, excitation.omega_max) if band is None else band
    inside = (omega >= low * (1 - 1e-9)) & (omega <= high * (1 + 1e-9)) & (omega > 0)
    if not inside.any():
        raise ValueError(f"the band {low:.4g} .. {high:.4g} rad/s holds no frequency of the signal")
    _, unit = unit_information(model, parameters, omega[inside], noise, input)
    total = np.einsum("f,fpq->pq", energy[inside], unit)
    check_distinct(total, parameters.names)
    return Prediction(parameters.names, total, excitation.duration)


def unit_information(
    model: PyTree,
    parameters: Parameters,
    omega: Float[np.ndarray, " frequencies"],
    noise: Noise,
    input: int,
) -> tuple[np.ndarray, np.ndarray]:
    """The response to one input, (frequencies, outputs), and the information per energy."""
    found = response_and_slopes(model, parameters, jnp.asarray(omega), input)
    response, slopes = (np.asarray(part) for part in found)
    for part in (response, slopes):
        finite = np.isfinite(part).reshape(omega.size, -1).all(axis=1)
        if not finite.all():
            raise ValueError(f"the model's response is not finite at {omega[~finite][0]:.4g} rad/s")
    return response, information_per_energy(
        slopes, noise_covariance(noise, omega, response.shape[1])
    )


def _energy(
    excitation: Excitation,
) -> tuple[Float[np.ndarray, " frequencies"], Float[np.ndarray, " frequencies"]]:
    """Frequencies in rad/s, and the energy of each: together the signal's square over time."""
    # Without padding, the harmonics of a periodic signal fall on single points.
    points = excitation.samples * (1 if excitation.kind == "multisine" else 2)
    dt = 1 / excitation.sample_rate
    spectrum = np.fft.rfft(excitation.signal, points)
    omega = 2 * np.pi * np.fft.rfftfreq(points, dt)
    return omega, 2 * dt * np.abs(spectrum) ** 2 / points
