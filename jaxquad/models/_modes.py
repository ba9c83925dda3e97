from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class HasPoles(Protocol):
    """A linear model."""

    @property
    def poles(self) -> np.ndarray: ...


class Mode(NamedTuple):
    """A real pole, or a pair of complex ones, of which the upper is named."""

    pole: complex  # rad/s
    frequency: float  # |pole|, rad/s
    damping: float  # - Re pole / |pole|; NaN for an integrator
    time_constant: float  # - 1 / Re pole, s; negative if unstable, infinite on the imaginary axis

    def __str__(self) -> str:
        if self.pole.imag:
            shape = f"zeta {self.damping:.3g}, omega {self.frequency:.4g} rad/s"
        else:
            shape = f"real, {self.pole.real:.4g} rad/s"
        return f"{shape}, time constant {self.time_constant:.4g} s"


def modes(model: HasPoles) -> tuple[Mode, ...]:
    """Frequency, damping and time constant of each mode of a linear model, slowest first.

    On the host, so not under jit.
    """
    poles = [complex(pole) for pole in np.asarray(model.poles)]
    upper = [pole for pole in poles if pole.imag >= 0]
    return tuple(_mode(pole) for pole in sorted(upper, key=lambda pole: (abs(pole), pole.real)))


def _mode(pole: complex) -> Mode:
    size = abs(pole)
    damping = -pole.real / size if size else float("nan")
    return Mode(pole, size, damping, -1 / pole.real if pole.real else float("inf"))
