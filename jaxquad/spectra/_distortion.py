import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float


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
