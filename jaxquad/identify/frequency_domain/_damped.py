"""Damping of the rate in a fit, where the response shows one."""

import dataclasses

import numpy as np

from jaxquad.models import LaggedIntegrator

from ..uncertainty._discrepancy import FOLLOWS
from ._cost import MaximumLikelihood
from ._half_bands import model_to_start_from, require_origin
from ._origin import free_again, Options, Origin
from ._parameters import Positive
from ._result import Fit


# One-sided tests of 5 %: a damping too many only widens the intervals of the others, while one
# that is left out at 2 standard errors puts the gain 1.5 of its own off.
_SHOWN = 1.645  # standard errors
_DROP = 2.71  # of the cost, of one parameter that may not be negative
_LOWEST = 0.1  # of the lowest frequency: a smaller start has no slope
_SLOW = 4.0  # times the lowest frequency: up to there damping turns the phase most
_REACH = 1.96  # standard errors from the middle of a 95 % interval to its end
_NAME = "damping"


def fit_damped(fit: Fit, *, unmodelled: float = 0.05) -> Fit:
    """Fit K e^(-delay s) / (s^(n-1) (s + damping) (lag s + 1)) where the response shows a damping.

    It does where the damping exceeds 1.645 of its standard errors, model error included, and lowers
    the cost of a maximum likelihood by 2.71 times the misfit (one-sided tests of 5 %). The start
    follows from the phase at the lowest frequencies; one or two further fits are made.

    **Arguments:**

    - `fit`: of a `jq.LaggedIntegrator` with one or more integrators.
    - `unmodelled`: what a model with damping still leaves out of the phase at the lowest frequency,
        in rad. The standard errors of the others count as much as they move when a damping of that
        effect is left out: it looks like other drag, coupling and thrust curves.

    **Returns:** the fit with a free `damping`; `fit` itself where the response shows none, where
    nothing was fitted, and where its damping is not 0 or free already.

    **Raises:**

    - `ValueError`: the fit is one of another model, or none of `jq.fit`; `unmodelled` is negative.

    !!! example

        ```python
        fit = jq.identify.fit_damped(jq.fit(jq.LaggedIntegrator(400.0, 0.03, 0.01), frf))
        ```
    """
    model = fit.model
    if not isinstance(model, LaggedIntegrator) or model.integrators < 1:
        raise ValueError(
            f"the fit is one of a {type(model).__name__}{_integrators(model)}: damping takes the "
            "place of an integrator of a jq.LaggedIntegrator"
        )
    if not unmodelled >= 0:
        raise ValueError(f"unmodelled is {unmodelled}: give an angle in rad, 0 for none")
    if not fit.verdict.fitted or _NAME in fit.names or np.any(model.damping):
        return fit
    origin = require_origin(fit)
    best = None
    for start in _starts(fit, origin):
        damped = _run(fit, origin, start)
        if damped is not None and (best is None or damped.cost < best.cost):
            best = damped
        if best is not None and best.cost <= fit.cost and best.verdict.kind != "no minimum":
            break
    if best is None or not _shows(best, fit, origin):
        return fit
    best = _with_unmodelled(best, fit, unmodelled * origin.band[0])
    units = dict(zip(fit.names, fit.parameter_units, strict=False)) | {_NAME: "1/s"}
    units = tuple(units[name] for name in best.names) if fit.parameter_units else ()
    return dataclasses.replace(best, parameter_units=units)


def _integrators(model: object) -> str:
    return " without integrators" if isinstance(model, LaggedIntegrator) else ""


def _starts(fit: Fit, origin: Origin) -> list[float]:
    """Dampings in 1/s: by the phase at the lowest frequencies, and within the band."""
    low, high = origin.band
    turned = weight = 0.0
    for points in origin.points:
        omega, used = np.asarray(points.frf.omega), np.asarray(points.used)[:, 0, 0]
        slow = used & (omega < _SLOW * low)
        some, response = omega[slow], np.asarray(points.frf.response)[slow, 0, 0]
        flat = response * (1j * some) ** fit.model.integrators / np.sign(float(fit.model.gain))
        late = float(fit.model.lag) + float(fit.model.delay)
        # s / (s + c) leads by c / w, which counts as the square of what its error lets it.
        lead = np.angle(flat * np.exp(1j * late * some))
        share = (1 / (some * np.asarray(points.frf.random_error)[slow, 0, 0])) ** 2
        turned, weight = turned + float(share @ (some * lead)), weight + float(np.sum(share))
    by_phase = turned / weight if weight else 0.0
    return [float(np.clip(by_phase, _LOWEST * low, high)), float(np.sqrt(low * high))]


def _run(fit: Fit, origin: Origin, start: float) -> Fit | None:
    model = dataclasses.replace(model_to_start_from(fit), damping=start)
    free = [*free_again(fit.parameters), Positive(_NAME)]
    options: Options = origin.options._replace(free=free, starts=1)
    try:
        damped = origin.run(model, origin.frfs, options)
    except ValueError:  # it diverged
        return None
    return damped if damped.verdict.fitted else None


def _shows(damped: Fit, plain: Fit, origin: Origin) -> bool:
    """Whether the damping is more than the noise, and the misfit, make of none."""
    k = damped.names.index(_NAME)
    if any(bound.name == _NAME for bound in damped.verdict.bounds) or not damped.values[k] > 0:
        return False
    error = damped.standard_errors[k] if damped.determined[k] else np.inf
    if not isinstance(origin.options.cost, MaximumLikelihood):
        return bool(damped.values[k] > _SHOWN * error)
    drop = (plain.cost - damped.cost) / max(1.0, damped.chi_squared)
    return bool(damped.values[k] > _SHOWN * error and drop > _DROP)


def _with_unmodelled(damped: Fit, plain: Fit, damping: float) -> Fit:
    """The fit whose errors count what an unmodelled `damping` in 1/s moves at most, as 95 %."""
    if damped.discrepancy is None:
        return damped
    share = min(1.0, damping / float(damped.values[damped.names.index(_NAME)]))
    bounded = {bound.name for bound in damped.verdict.bounds}
    moved = np.zeros(len(damped.names))
    for k, name in enumerate(damped.names):
        if name != _NAME and name not in bounded:
            moved[k] = share * (damped.values[k] - plain.values[plain.names.index(name)]) / _REACH
    errors = np.sqrt(damped.standard_errors**2 + moved**2)
    relative = moved / damped.units
    pairs = zip(damped.discrepancy.widths, errors > FOLLOWS * damped.standard_errors, strict=True)
    widths = tuple("prior" if wider else width for width, wider in pairs)
    return dataclasses.replace(
        damped,
        covariance=damped.covariance + np.outer(moved, moved),
        standard_errors=errors,
        relative_covariance=damped.relative_covariance + np.outer(relative, relative),
        discrepancy=dataclasses.replace(damped.discrepancy, widths=widths),
    )
