"""The plants that a log leaves possible: drawn from one fit, or from the gain over the throttle."""

import dataclasses
from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxquad.identify import draw_models, filter_response, Fit, GainOverThrottle, KnownFilter

from ._firmware import OuterLoop
from ._law import RateLoop
from ._rate_gains import (
    cells_of,
    forward_path,
    gyro_chain_response,
    hold_plants,
    law_paths,
    RateLoops,
)


Frequencies = Float[np.ndarray, " frequencies"]
Drawn = Float[np.ndarray, "plants 1"]
_LOWEST = 0.05  # rad/s, below which only the integrals count
_FREQUENCIES = 300
_AT_ONCE = 256  # draws: each other number would be compiled anew


@dataclasses.dataclass(frozen=True)
class PlantSource:
    """What plants are drawn from.

    **Attributes:**

    - `fit`: up to what the gyro's filters are given, in `unit`.
    - `over`: the gain over the throttle, whose plants take the place of those of `fit`.
    - `span`: the lowest and the highest throttle of these.
    - `filters`: of the gyro, as measured; None takes those of the law.
    """

    fit: Fit
    unit: str
    over: GainOverThrottle | None = None
    span: tuple[float, float] = (0.0, 1.0)
    filters: Sequence[KnownFilter] | None = None

    @property
    def damping(self) -> float:
        """Of the rate in 1/s, as the fit has it."""
        return float(np.asarray(vars(self.fit.model).get("damping", 0.0)))

    def loops(
        self, law: RateLoop, axis: int, count: int, seed: int, *,
        omega: Frequencies | None = None, throttle: float | None = None,
        angle: OuterLoop | None = None,
    ) -> RateLoops:  # fmt: skip
        """The loops of a law with so many plants, and an angle loop around them.

        All are at one `throttle`, or each is at its own, evenly over the span.

        Raises ValueError where a drawn gain is not above 0.
        """
        if omega is None:
            omega = np.geomspace(_LOWEST, 0.999 * np.pi / law.dt, _FREQUENCIES)
        back, ahead = law_paths(law, axis, omega)
        chain = gyro_chain_response(law, omega)
        passed = chain if self.filters is None else filter_response(self.filters, omega)
        gain, lag, delay, damping = self._drawn(count, seed, throttle)
        if np.any(gain <= 0):
            raise ValueError(
                f"the gain from the command to the rate is not above 0 in {int(np.sum(gain <= 0))} "
                f"of {count} plants drawn from the fit: check the sign of the input, or fly more "
                "excitation"
            )
        per_radian = np.pi / 180 if self.unit == "deg/s" else 1.0
        plants = hold_plants(per_radian * gain, lag, delay, omega, law.dt, damping)
        white = cells_of(omega) * np.abs(passed) ** 2
        return RateLoops(
            omega, back, ahead, plants * passed, white, passed, law.d_ceiling(axis), chain,
            law.holds_integral(axis), forward_path(law, axis, omega),
            None if angle is None else angle.path(omega),
        )  # fmt: skip

    def _drawn(
        self, count: int, seed: int, throttle: float | None
    ) -> tuple[Drawn, Drawn, Drawn, Drawn]:
        """Gain, lag, delay and damping."""
        if self.over is None:
            names = len(self.fit.names)
            scores = np.zeros((names, -(-count // _AT_ONCE) * _AT_ONCE))
            scores[:, :count] = np.random.default_rng(seed).standard_normal((names, count))
            models = draw_models(self.fit, jnp.asarray(scores))
            wide = lambda x: np.broadcast_to(np.asarray(x, float), scores[0].shape)[:count, None]
            return wide(models.gain), wide(models.lag), wide(models.delay), wide(models.damping)
        if throttle is None:
            drawn = self.over.draw(np.linspace(*self.span, count), count, seed=seed)
            gain = np.diagonal(drawn.gain)
        else:
            drawn = self.over.draw(np.array([throttle]), count, seed=seed)
            gain = drawn.gain[0]
        lag, delay = drawn.lag[:, None], drawn.delay[:, None]
        return gain[:, None], lag, delay, np.full_like(lag, self.damping)
