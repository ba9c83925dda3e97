import numpy as np

from jaxquad.models import LaggedIntegrator
from jaxquad.spectra import FrequencyResponse


def guess_lagged_integrator(frf: FrequencyResponse, integrators: int) -> LaggedIntegrator:
    """Starting values for K e^(-delay s) / (s^integrators (lag s + 1)) from a response's shape.

    K from the magnitude and the phase in the lower half of the coherent band,
    lag and delay from the slope of the phase, half each. Good enough for a fit to start from.
    """
    omega, response = np.asarray(frf.omega), np.asarray(frf.response)[:, 0, 0]
    coherence = np.asarray(frf.coherence)[:, 0, 0]
    good = coherence >= min(0.6, 0.9 * float(coherence.max()))
    flat = (response * (1j * omega) ** integrators)[good]
    slow = flat[: max(flat.size // 2, 1)]
    sign = 1.0 if np.real(np.sum(slow / np.abs(slow))) >= 0 else -1.0
    turns = np.angle(flat[1:] / flat[:-1])
    steps = np.diff(omega[good])
    slope = -float(np.sum(turns * steps) / np.sum(steps**2)) if steps.size else 0.0
    late = max(slope, 0.05 / float(omega[good][-1]))
    return LaggedIntegrator(sign * float(np.median(np.abs(slow))), late / 2, late / 2, integrators)
