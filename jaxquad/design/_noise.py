from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from jaxquad.spectra import SpectralDensity


Lines = Float[np.ndarray, " frequencies"]
Matrices = Complex[np.ndarray, "frequencies outputs outputs"]


class MeasuredNoise(eqx.Module):
    """The noise of `outputs` from a measured spectral density, interpolated over log frequency.

    **Arguments:**

    - `density`: of a record at rest, or of an excited one.
    - `outputs`: names of its channels.
    - `given`: channels whose share is taken out, such as the input of an excited record. Only for
        an open loop: with feedback, part of the noise would count as explained.
    """

    density: SpectralDensity
    outputs: tuple[str, ...] = eqx.field(static=True)
    given: tuple[str, ...] = eqx.field(static=True, default=())

    def __call__(self, omega: Lines) -> Matrices:
        """Covariances E[V V^H], one-sided, in output units squared per Hz."""
        known = np.asarray(self.density.omega)
        outside = (omega < known[0] * (1 - 1e-9)) | (omega > known[-1] * (1 + 1e-9))
        if outside.any():
            raise ValueError(
                f"the noise is known from {known[0]:.4g} to {known[-1]:.4g} rad/s, not at "
                f"{omega[outside][0]:.4g} rad/s: narrow the band, or give spectral_density omega="
            )
        place, values = np.log(known), self._unexplained()
        flat = values.reshape(known.size, -1).T
        columns = [np.interp(np.log(omega), place, column) for column in flat]
        return np.stack(columns, axis=1).reshape(omega.size, *values.shape[1:])

    def _unexplained(self) -> Matrices:
        own, given = (self._places(names) for names in (self.outputs, self.given))
        # A density averages conj(X_a) X_b; the covariance of a column of outputs is its transpose.
        covariance = np.swapaxes(np.asarray(self.density.density), 1, 2)
        noise = covariance[:, own[:, None], own]
        if given.size == 0:
            return noise
        cross = covariance[:, own[:, None], given]
        gain = cross @ np.linalg.inv(covariance[:, given[:, None], given])
        return noise - gain @ np.conj(np.swapaxes(cross, 1, 2))

    def _places(self, names: tuple[str, ...]) -> np.ndarray:
        for name in names:
            if name not in self.density.names:
                raise ValueError(f"no channel {name!r}; there are: {', '.join(self.density.names)}")
        return np.array([self.density.names.index(name) for name in names], int)


Noise = float | int | Sequence[float] | Callable[[Lines], np.ndarray] | MeasuredNoise


def noise_covariance(noise: Noise, omega: Lines, outputs: int) -> Matrices:
    """The outputs' noise at each line as covariance matrices, one-sided per Hz.

    **Arguments:**

    - `noise`: as in `predict_accuracy`.
    - `omega`: lines in rad/s.
    - `outputs`: how many.

    **Raises:**

    - `ValueError`: a density of another shape, not finite or not above 0.
    """
    found = np.asarray(noise(omega) if callable(noise) else noise)
    if found.ndim == 1 and callable(noise):
        found = found[:, None]
    if found.ndim < 3:
        try:
            powers = np.broadcast_to(found, (omega.size, outputs))
        except ValueError as error:
            raise ValueError(
                f"noise of shape {found.shape} for {omega.size} lines and {outputs} outputs: give "
                "one density in units^2/Hz, one for each output, or a function of omega in rad/s"
            ) from error
        found = powers[:, :, None] * np.eye(outputs)
    if found.shape != (omega.size, outputs, outputs):
        raise ValueError(f"the noise is of {found.shape[1]} outputs, but the model has {outputs}")
    _check(found, omega)
    return found.astype(complex)


def _check(covariance: np.ndarray, omega: Lines) -> None:
    if not np.all(np.isfinite(covariance)):
        raise ValueError("the noise density is not finite at every line: check it for NaN and inf")
    least = np.linalg.eigvalsh(covariance)[:, 0]
    if least.min() <= 0:
        worst = least.argmin()
        raise ValueError(
            f"the noise density at {omega[worst]:.4g} rad/s is {least[worst]:.4g} units^2/Hz, but "
            "it must be above 0. White noise of standard deviation s, sampled at f Hz, has 2 s^2/f"
        )
