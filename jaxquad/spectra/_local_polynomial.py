import equinox as eqx
import numpy as np


class LocalPolynomial(eqx.Module):
    """Local polynomial estimates from the transforms of whole records, at any frequencies.

    Around each frequency the response and the transients of the records' two ends are polynomials
    of `order` in frequency: what leaks is estimated and not windowed away. `width`, in rad/s, is
    the half-width of the band that the polynomials span; by default it is chosen frequency by
    frequency, as wide as shows no bias above the noise, and where a resonance is sharper than the
    least band, a rational function takes the polynomial's place. A width that is set is kept to:
    where it holds too few bins, the response is nan.

    `integrators` is the number of pure integrations between input and output: outputs are
    differenced so many times, and the response divided by the differencing filter. `delay`, in s,
    is about how much the output lags: taken out before the fit and put back after.
    Source: Pintelon and Schoukens, System Identification, 2nd ed., section 7.2; McKelvey and
    Guerin (2012) for the rational function.
    """

    order: int = eqx.field(static=True, default=2)
    width: float | None = eqx.field(static=True, default=None)
    integrators: int = eqx.field(static=True, default=0)
    delay: float = eqx.field(static=True, default=0.0)

    def __check_init__(self):
        if self.order not in range(7):
            raise ValueError(f"order {self.order}: give 0 to 6; 2 is usual")
        if self.width is not None and not 0 < self.width < np.inf:
            raise ValueError(f"width {self.width} rad/s must be positive; None chooses one")
        if self.integrators not in (0, 1, 2, 3):
            raise ValueError(f"integrators {self.integrators}: give 0 to 3 integrations")
        if not 0 <= self.delay < 10:
            raise ValueError(f"delay {self.delay} s: give 0 to 10 s")
