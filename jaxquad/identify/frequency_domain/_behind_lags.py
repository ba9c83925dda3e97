"""The fit to what an actuator of two lags moves, and these lags.

What its response is relative to that of one lag T depends on T, of which the remark on the
response has a table: it is read where the model's own lag is.
"""

import dataclasses

import numpy as np
from jaxtyping import PyTree

from jaxquad.spectra import FrequencyResponse, TwoLags

from ._refits import Candidate, free_again, model_to_start_from, Origin


_ROUNDS, _SETTLED = 6, 1e-3  # fits behind two lags; relative change of their mean
_LEAST = 0.2  # of 1 less what a lag moves itself


def _two_lags(frf: FrequencyResponse) -> TwoLags | None:
    """What the response to a single input says of its actuator."""
    remark = next((one for one in frf.remarks if isinstance(one, TwoLags)), None)
    fits = remark is not None and remark.changes.shape[1] == np.size(frf.omega)
    return remark if fits and len(frf.input_names) == 1 else None


def fit_behind_lags(fit: PyTree, origin: Origin) -> tuple[Candidate, str] | None:
    """The fit to the responses behind an actuator of two lags, whose mean is the model's lag if it
    has one; and a sentence about them. None where no actuator has two, or the solver diverged."""
    remarks = [_two_lags(frf) for frf in origin.frfs]
    if not any(remarks):
        return None
    options = origin.options._replace(free=free_again(fit.parameters), starts=1)

    def lag_of(model: PyTree) -> float | None:
        lag = getattr(model, "lag", None)
        return float(np.asarray(lag)) if lag is not None and np.ndim(lag) == 0 else None

    def fit_behind(model: PyTree, lag: float | None, *, further: bool = False) -> PyTree:
        frfs = []
        for frf, remark in zip(origin.frfs, remarks, strict=True):
            if remark is not None:
                here = remark.at(lag)
                change = here.further if further else here.change
                frf = dataclasses.replace(
                    frf, response=frf.response / change[:, None, None],
                    errors=frf.errors.scaled(1 / change),
                    remarks=tuple(one for one in frf.remarks if one is not remark),
                )  # fmt: skip
            frfs.append(frf)
        try:
            return origin.run(model, frfs, options)
        except ValueError:
            return None

    behind, lag = fit, lag_of(fit.model)
    for _ in range(_ROUNDS):  # the tables are read at the lag that is fitted
        behind = fit_behind(model_to_start_from(behind), lag)
        if behind is None or not behind.verdict.fitted:
            return None
        lag, before = lag_of(behind.model), lag
        if lag is None or before is None or abs(lag - before) <= _SETTLED * abs(lag):
            break
    # The doubt about b moves all parameters, and a lag that is off moves b.
    clearest = max((one for one in remarks if one is not None), key=lambda one: one.clear)
    middle = float(clearest.lags[clearest.lags.size // 2]) if lag is None else lag
    here, count = clearest.at(middle), len(fit.names)
    other = fit_behind(model_to_start_from(behind), lag, further=True)
    moved = np.zeros(count) if other is None else np.asarray(other.values - behind.values)
    of_lag, slope = np.zeros(count), 0.0
    if "lag" in fit.names:
        of_lag[fit.names.index("lag")] = 1.0
        ends = [clearest.at(middle * factor).difference for factor in (1.1, 1 / 1.1)]
        slope = (ends[0] - ends[1]) / (2 * np.log(1.1)) / middle
    itself = slope * float(of_lag @ moved) / here.error
    amplified = np.eye(count) + np.outer(moved, of_lag) * slope / here.error / max(
        1 - itself, _LEAST
    )
    settled = bool(np.all(np.isfinite(fit.covariance)) and np.all(np.isfinite(behind.covariance)))
    if settled:
        behind = _with_doubt(behind, moved, amplified)
    lags, relative = [], []
    for side in (1, -1):  # of T / (1 + b) and of T / (1 - b)
        lags.append(middle / (1 + side * here.difference))
        direct = -side / (1 + side * here.difference)
        by_lag = amplified.T @ of_lag * (1 / middle + direct * slope)
        doubt = direct * here.error + float(by_lag @ moved)
        by_noise = by_lag @ fit.covariance @ by_lag if settled else np.inf
        relative.append(np.sqrt(by_noise + doubt**2))
    up, down = (f"{x:.3g} +- {x * e:.2g} s" for x, e in zip(lags, relative, strict=True))
    price = 2 * np.log(2 * origin.independent_points)
    title = "an actuator of two lags"
    candidate = Candidate(title, "m' = (u - m) / T", behind, clearest.clear**2 - float(price))
    rest = "" if "lag" in fit.names else ", where their difference is clearest"
    return candidate, (
        f"The actuator has two lags: {up} while its command rises, {down} while it falls{rest}. "
        "The values below are those of the plant behind it, with the lag 2 / (1 / up + 1 / down)"
    )


def _with_doubt(fit: PyTree, moved: np.ndarray, amplified: np.ndarray) -> PyTree:
    """With a further error that moves all values together, and all errors `amplified`."""
    units = np.outer(fit.units[: moved.size], fit.units[: moved.size])

    def doubted(covariance: np.ndarray) -> np.ndarray:
        return amplified @ (covariance + np.outer(moved, moved)) @ amplified.T

    covariance, by_noise = doubted(fit.covariance), doubted(fit.noise_covariance)
    return dataclasses.replace(
        fit,
        covariance=covariance,
        noise_covariance=by_noise,
        standard_errors=np.sqrt(np.diagonal(covariance)),
        relative_covariance=covariance / units,
        relative_noise_covariance=by_noise / units,
    )
