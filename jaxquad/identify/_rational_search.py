"""The lowest minimum of a rational fit: many linear starts, few descents."""

import numpy as np
from jaxtyping import Float
from numpy.polynomial.polynomial import polyfromroots, polyroots

from ._descent import descend
from ._rational import Rational, Samples, sanathanan_koerner


_DELAY_STEP = 0.7  # rad at the highest frequency
_MOST_DELAYS = 60
_PLACES = 5  # frequencies at which an idle pair is tried
_TRIED = 8  # linear starts that are refined
_SHORT, _LONG = 12, 200  # steps of a descent: to compare starts, and to finish


def lowest(
    samples: Samples, zeros: int, poles: int, delay: float | None, extra: tuple[Rational, ...] = ()
) -> Rational:
    """The best minimum found; `delay` is free where it is None.

    Starts are linear fits at delays from 0 to beyond what the phase's slope allows, further ones in
    `extra`, and the best of them with one root (or pair) reflected to the other half plane, or with
    its outermost zero and pole, which may be idle beyond the band, placed within it.
    """
    free = delay is None
    delays = _delays(samples) if delay is None else np.array([delay])
    starts = [sanathanan_koerner(samples, zeros, poles, float(each)) for each in delays]
    starts = sorted(starts, key=lambda model: model.cost)[:_TRIED] + list(extra)
    short = [descend(samples, each, steps=_SHORT, free_delay=free) for each in starts]
    best = min(short, key=lambda model: model.cost)
    for _ in range(2):
        best = descend(samples, best, steps=_LONG, free_delay=free)
        if not np.isfinite(best.cost):
            return best
        others = _reflected(best) + _relocated(samples, best)
        again = [descend(samples, each, steps=_SHORT, free_delay=free) for each in others]
        better = min(again, key=lambda model: model.cost, default=best)
        if not better.cost < 0.999 * best.cost:
            return best
        best = better
    return descend(samples, best, steps=_LONG, free_delay=free)


def _delays(samples: Samples) -> Float[np.ndarray, " delays"]:
    """From 0 to 4 rad at the highest frequency, or beyond what the phase's slope allows."""
    omega, phase = samples.omega, np.unwrap(np.angle(samples.response))
    slope = -np.diff(phase)[omega.size // 2 :] / np.diff(omega)[omega.size // 2 :]
    limit = 4.0 / omega[-1] + 1.2 * max(float(np.median(slope)), 0.0)
    count = int(np.clip(limit * omega[-1] / _DELAY_STEP + 1, 2, _MOST_DELAYS))
    return np.linspace(0.0, limit, count)


def _reflected(model: Rational) -> list[Rational]:
    """One zero or pole, or a pair, mirrored in the imaginary axis."""
    found = []
    for side in ("above", "below"):
        lead, roots = getattr(model, side)[-1], polyroots(getattr(model, side))
        for root in roots[roots.imag >= 0]:
            mine = (roots == root) | (roots == root.conj())
            mirrored = np.where(mine, -roots.conj(), roots)
            sign = -1.0 if np.sum(mine) % 2 and side == "above" else 1.0
            coefficients = sign * lead * np.real(polyfromroots(mirrored))
            found.append(model._replace(**{side: coefficients}))
            if np.sum(mine) % 2:
                found.append(found[-1]._replace(above=-found[-1].above))
    return found


def _relocated(samples: Samples, model: Rational) -> list[Rational]:
    """The outermost real zero and pole as a near-cancelling pair within the band."""
    zeros, poles = polyroots(model.above), polyroots(model.below)
    if not (np.any(zeros.imag == 0) and np.any(poles.imag == 0)):
        return []
    zero, pole = (max(roots[roots.imag == 0], key=abs) for roots in (zeros, poles))
    found = []
    lead = model.above[-1] * np.real((1j - zero) / (1j - pole))
    for place in np.geomspace(samples.omega[0], samples.omega[-1], _PLACES):
        for apart in (0.8, 1.25):
            moved = np.where(zeros == zero, -place * apart, zeros)
            above = lead * np.real(polyfromroots(moved))
            below = np.real(polyfromroots(np.where(poles == pole, -place, poles)))
            found.append(model._replace(above=above, below=below))
    return found
