from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from jaxquad._core import require_float64

from ._error_covariance import ErrorCovariance


class Distortion(eqx.Module):
    """What scatters around the best linear approximation: noise, and nonlinear distortion.

    Amplitudes per line of the average over a record's periods, in output units as in
    `amplitude`, the output that the response explains. `total` is what scatters between
    realisations, `nonlinear` what of it the noise does not explain; both are nan where one
    realisation shows neither. Source: Pintelon and Schoukens, System Identification, 2nd ed.,
    section 4.3.1.
    """

    omega: Float[np.ndarray, " frequencies"]  # rad/s
    amplitude: Float[np.ndarray, "frequencies outputs"]
    noise: Float[np.ndarray, "frequencies outputs"]
    total: Float[np.ndarray, "frequencies outputs"]
    nonlinear: Float[np.ndarray, "frequencies outputs"]
    significant: Bool[np.ndarray, " outputs"]  # whether noise alone would seldom scatter so much
    output_names: tuple[str, ...] = eqx.field(static=True)
    realisations: int = eqx.field(static=True)

    def __str__(self) -> str:
        lines = [
            f"scatter of the period averages at {self.omega.size} lines, "
            f"{self.realisations} realisation(s), relative to the output"
        ]
        for o, name in enumerate(self.output_names):
            output = np.sqrt(np.mean(self.amplitude[:, o] ** 2))
            noise, nonlinear = (
                20 * np.log10(max(np.sqrt(np.mean(part[:, o] ** 2)) / output, 1e-15))
                for part in (self.noise, self.nonlinear)
            )
            if np.isnan(nonlinear):
                told = "nonlinear distortion unknown: record other phases of the same lines"
            elif self.significant[o]:
                told = f"nonlinear distortion {nonlinear:.1f} dB"
            else:
                told = "no nonlinear distortion beyond the noise"
            lines.append(f"  {name}: noise {noise:.1f} dB, {told}")
        return "\n".join(lines)


class FrequencyResponse(eqx.Module):
    """Measured frequency responses of every output to every input, with their random error.

    With several inputs, responses are conditioned on the other inputs and `coherence` is partial.
    Where inputs could not be told apart, the response is nan and its random error infinite.
    `errors` holds how the noise enters all of them at once: neighbouring frequencies of
    overlapping windows share their noise.
    """

    omega: Float[Array, " frequencies"]  # rad/s
    response: Complex[Array, "frequencies outputs inputs"]  # output unit per input unit
    coherence: Float[Array, "frequencies outputs inputs"]  # of the joint estimate: the lesser one
    random_error: Float[Array, "frequencies outputs inputs"]  # 1 sigma: relative, and in rad
    errors: ErrorCovariance
    direct_coherence: Float[Array, "frequencies outputs inputs"]  # input to output, no reference
    multiple_coherence: Float[Array, "frequencies outputs"]  # of the output with all inputs
    method: Literal["direct", "joint"] = eqx.field(static=True)
    input_names: tuple[str, ...] = eqx.field(static=True)
    output_names: tuple[str, ...] = eqx.field(static=True)
    remarks: tuple[str, ...] = eqx.field(static=True, default=())
    integrators: int = eqx.field(static=True, default=0)  # taken out before windowing
    resolution: float = eqx.field(static=True, default=0.0)  # one cycle to a window, rad/s
    distortion: Distortion | None = None  # of a periodic excitation

    def __check_init__(self):
        if not isinstance(self.omega, Array | np.ndarray):
            return
        require_float64("the frequency response", self.response)

    @property
    def magnitude_db(self) -> Float[np.ndarray, "frequencies outputs inputs"]:
        """20 log10 of the magnitude."""
        return 20 * np.log10(np.abs(np.asarray(self.response)))

    @property
    def phase_deg(self) -> Float[np.ndarray, "frequencies outputs inputs"]:
        """Phase in degrees, unwrapped along frequency."""
        return np.degrees(np.unwrap(np.angle(np.asarray(self.response)), axis=0))

    def relative_covariance(
        self, output: int = 0, input: int = 0
    ) -> Complex[np.ndarray, "frequencies frequencies"]:
        """Covariance of one response's relative error between all pairs of frequencies.

        Its diagonal is `2 random_error**2`.
        """
        response = np.asarray(self.response)[:, output, input]
        covariance = self.errors.between((output, input), (output, input))
        return covariance / np.outer(response, response.conj())

    def __str__(self) -> str:
        omega, coherence = np.asarray(self.omega), np.asarray(self.coherence)
        lines = [f"frequency response, {self.method} estimate, {omega.size} frequencies"]
        for o, output in enumerate(self.output_names):
            for i, source in enumerate(self.input_names):
                good = omega[coherence[:, o, i] >= 0.6]
                where = f"{good[0]:.3g}..{good[-1]:.3g} rad/s" if good.size else "nowhere"
                lines.append(f"  {source} -> {output}: coherence above 0.6 at {good.size}: {where}")
        return "\n".join(lines + [f"  ! {remark}" for remark in self.remarks])
