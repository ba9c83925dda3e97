"""Responses and fits of an identification, over the whole band and over parts of it."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import announce, as_messages
from jaxquad.identify import (
    CoherenceWeighted,
    Fit,
    fit,
    fit_transfer_function,
    guess_lagged_integrator,
    KnownFilter,
    MaximumLikelihood,
    usable,
    WIDER_BAND,
    without_filters,
)
from jaxquad.models import LaggedIntegrator, parameter_units, TransferFunction
from jaxquad.records import Record
from jaxquad.spectra import (
    Composite,
    DOMINATED,
    EARLY,
    Estimator,
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
    Welch,
)

from ._command_line import in_options
from ._settings import IdentifySettings


Model = LaggedIntegrator | TransferFunction
_COSTS = {"ml": MaximumLikelihood(), "coherence": CoherenceWeighted()}
_POINTS = 100  # frequencies, log-spaced over the band
_LONGEST = 0.02  # of the record: a longer delay is no delay of the vehicle
_NEAR = 1.5  # samples: a delay that is taken out as precisely as that need not be better
_MISFIT = 3.0  # ratio of misfit to random error from which parts of the band are fitted, too
_CHANGE = 0.1  # of the gain, between parts of the band: more than that is not noise
_RECORD = "excite the axis (jaxquad design sweep), and record what excites it as the reference"
EXCITE = "excite the axis more, over a wider band (jaxquad design sweep), or record longer"


class Estimated(NamedTuple):
    """The response to trust and the fit to it; `delay`, in s, was taken out of the response."""

    frf: FrequencyResponse
    fit: Fit
    delay: float


def fit_best(
    records: tuple[Record, ...], methods: Sequence[str], settings: IdentifySettings,
    filters: Sequence[KnownFilter] = (),
) -> Estimated:  # fmt: skip
    """The first method's response and the fit to it; `respond` gives those of the other `methods`.

    Taken out of the response is the delay that a fit to a quick one finds; where the fit to the
    response itself finds another, it is estimated again. Known `filters` are divided out.
    """
    best, dt, plural = methods[0], records[0].dt, "s" * (len(methods) > 1)
    announce(f"quick {best} response, for the delay")
    quick = respond(records, best, settings, filters, quick=True)
    unasked = dataclasses.replace(quick, remarks=())  # to find them takes as long as the fit
    delay = _delay_of(fit_response(unasked, settings), records)
    out = f", {delay:.4g} s of delay taken out" if delay else ""
    announce(f"{' and '.join(methods)} response{plural}{out}")
    frf = respond(records, best, settings, filters, delay)
    announce(f"fit to the {best} response")
    found = fit_response(frf, settings)
    other = _delay_of(found, records)
    if other and abs(other - delay) > _NEAR * dt:
        delay = other
        announce(f"{' and '.join(methods)} response{plural}, {delay:.4g} s of delay taken out")
        frf = respond(records, best, settings, filters, delay)
        found = fit_response(frf, settings)
    return Estimated(frf, found, delay)


def respond(
    records: tuple[Record, ...], method: str, settings: IdentifySettings,
    filters: Sequence[KnownFilter], delay: float = 0.0, *, quick: bool = False,
) -> FrequencyResponse:  # fmt: skip
    """The response by a method, `delay` (s) and `filters` of the output taken out."""
    estimator = _estimator(settings, method, delay, quick=quick)
    frf = frequency_response(list(records), grid_of(settings), estimator=estimator)
    return without_filters(frf, filters)


def _delay_of(found: Fit, records: tuple[Record, ...]) -> float:
    """In s, whole samples; 0 where nothing is fitted, and for one that is none of a vehicle."""
    if not found.verdict.fitted:
        return 0.0
    dt, duration = records[0].dt, max(record.duration for record in records)
    total = dt * round(sum(map(float, _late(found.model))) / dt)
    return total if 0 < total < _LONGEST * duration else 0.0


def grid_of(settings: IdentifySettings) -> Float[np.ndarray, " frequencies"] | None:
    """Over the band of the settings, in rad/s; None is the default of `jq.frequency_response`."""
    band = settings.band_rad
    if settings.band is not None:
        band = 2 * np.pi * settings.band[0], 2 * np.pi * settings.band[1]
    return None if band is None else np.geomspace(*band, _POINTS)


def _estimator(settings: IdentifySettings, method: str, delay: float, *, quick: bool) -> Estimator:
    shape = {"integrators": settings.integrators, "delay": delay}
    if settings.window is not None or settings.estimator == "welch":
        estimator = Welch(settings.window, **shape)
    elif settings.estimator == "composite":
        estimator = Composite(**shape)
    elif quick:
        estimator = LocalPolynomial(**shape, global_order=0)
    else:
        estimator = LocalPolynomial(**shape)
    return JointInputOutput(estimator) if method == "joint" else estimator


def fit_response(frf: FrequencyResponse, settings: IdentifySettings) -> Fit:
    """The model of the settings, or K e^(-delay s) / (s^n (lag s + 1)), fitted to a response."""
    cost, n = _COSTS[settings.cost], settings.integrators
    if settings.poles is not None:
        return fit_transfer_function(
            frf,
            zeros=settings.zeros,
            poles=settings.poles + n,
            integrators=n,
            delay="free" if settings.delay else 0.0,
            cost=cost,
        )
    free = ["gain", *(["lag"] if settings.lag else []), *(["delay"] if settings.delay else [])]
    return fit(_start(frf, settings), frf, free=free, cost=cost)


def _start(frf: FrequencyResponse, settings: IdentifySettings) -> LaggedIntegrator:
    """What is fixed at zero is added to what is free."""
    if not np.any(np.isfinite(frf.response)):  # the fit says so
        return LaggedIntegrator(1.0, 0.1, 0.1, settings.integrators)
    guess = guess_lagged_integrator(frf, settings.integrators)
    total = np.asarray(guess.lag) + np.asarray(guess.delay)
    lag = 0.0 if not settings.lag else guess.lag if settings.delay else total
    delay = 0.0 if not settings.delay else guess.delay if settings.lag else total
    return LaggedIntegrator(guess.gain, lag, delay, settings.integrators)


def total_delay(model: Model) -> Float[Array, ""]:
    """The sum of lag and delay, which a record determines better than either of them."""
    first, *others = _late(model)
    return sum(others, first)


def _late(model: Model) -> Sequence[Float[Array, ""]]:
    return (model.delay,) if isinstance(model, TransferFunction) else (model.lag, model.delay)


def sums_of(settings: IdentifySettings) -> Mapping[str, Callable[[Model], Float[Array, ""]]]:
    """The quantities that are shown beside the parameters, all in s."""
    both = settings.poles is None and settings.lag and settings.delay
    return {"lag + delay": total_delay} if both else {}


def with_remedies(found: Fit, settings: IdentifySettings) -> Fit:
    """The same fit, whose remedies are options of `jaxquad identify`."""
    kind, lost = found.verdict.kind, found.verdict.undetermined
    remarked = {remark.kind for remark in found.remarks}
    if kind == "identifiable":
        return found
    wider = [remedy for remedy in found.verdict.remedies if remedy.kind == WIDER_BAND]
    excite = in_options(wider[0]) if wider else EXCITE
    remedies = [excite]
    if kind == "too few points":
        remedies += ["use longer windows (--estimator welch --window S)"]
    elif kind == "no model" and DOMINATED in remarked:
        named = [] if settings.reference else ["name the external reference (--reference)"]
        remedies = [*named, _RECORD]
    elif kind == "no model" and EARLY in remarked:
        remedies = ["exchange --input and --output if they are swapped, or correct time stamps"]
    elif kind == "no model":
        remedies = [
            "fit the part of the band where it holds (--band, --band-rad)",
            "fit a model of higher order (--poles), or ask which term is missing (--explain)",
        ]
    elif settings.poles is not None:
        remedies = ["fit fewer poles and zeros (--poles, --zeros)", excite]
    elif {"lag", "delay"} & set(lost) and settings.lag and settings.delay:
        remedies = ["fit without the lag (--no-lag) or without the delay (--no-delay)", excite]
    verdict = dataclasses.replace(found.verdict, remedies=as_messages(remedies))
    return dataclasses.replace(found, verdict=verdict)


def fit_parts(
    found: Fit, frf: FrequencyResponse, settings: IdentifySettings
) -> tuple[Fit, dict[str, Fit | None]]:
    """Fits to the upper and the lower two thirds of the frequencies, where the misfit is large.

    Returns the fit too, with a remark where the gain differs between them. There are no parts for
    a misfit below three times the noise, for other models than the lagged integrator, and for a
    response that feedback dominates or whose phase rises: no part of it would be better.
    """
    small = not found.chi_squared >= _MISFIT**2 or not isinstance(found.model, LaggedIntegrator)
    no_plant = any(remark.kind in (DOMINATED, EARLY) for remark in frf.remarks)
    if not found.verdict.fitted or small or no_plant:
        return found, {}
    used = np.asarray(frf.omega)[usable(frf, None, 0.6)[:, 0, 0]]
    low, first, second, high = np.geomspace(used[0], used[-1], 4).tolist()
    bands = {
        f"above {first:.3g} rad/s ({_hertz(first)})": (first, high),
        f"below {second:.3g} rad/s ({_hertz(second)})": (low, second),
    }
    parts = {name: _refitted(found, frf, settings, band) for name, band in bands.items()}
    remarks = [_gain_change(name, part, found) for name, part in parts.items()]
    found = dataclasses.replace(
        found, remarks=(*found.remarks, *as_messages(filter(None, remarks)))
    )
    whole = f"{low:.3g} .. {high:.3g} rad/s ({low / (2 * np.pi):.3g} .. {_hertz(high)})"
    return found, {whole: found} | parts


def _hertz(omega: float) -> str:
    return f"{omega / (2 * np.pi):.3g} Hz"


def _refitted(
    found: Fit, frf: FrequencyResponse, settings: IdentifySettings, band: tuple[float, float]
) -> Fit | None:
    """From where the fit stopped; None where the solver diverged."""
    try:
        return fit(found.model, frf, free=found.names, cost=_COSTS[settings.cost], band=band)
    except ValueError:
        return None


def _gain_change(where: str, part: Fit | None, found: Fit) -> str:
    known = found.determined[0] or found.verdict.kind == "no model"
    if part is None or not (part.determined[0] and known):
        return ""
    before, after = found.values[0], part.values[0]
    change = abs(after - before)
    if not change > max(_CHANGE * abs(before), 2 * part.standard_errors[0]):
        return ""
    ratio, ratio_before = part.chi_squared**0.5, found.chi_squared**0.5
    return (
        f"{where} the gain is {after:.4g} instead of {before:.4g}, with a misfit of {ratio:.1f} "
        f"instead of {ratio_before:.1f}: the model does not hold over the whole band. Fit the part "
        "where it does (--band, --band-rad), or a model of higher order (--poles)"
    )


def in_option_words(fit: Fit) -> Fit:
    return dataclasses.replace(fit, remarks=tuple(map(in_options, fit.remarks)))


def with_units(fit: Fit, record: Record) -> Fit:
    """The units of the parameters; a channel without a unit stands for itself."""
    if not fit.verdict.fitted:
        return fit
    [output], [source] = record.output_units, record.input_units
    units = parameter_units(
        fit.model, fit.names,
        output=output or record.output_names[0], input=source or record.input_names[0],
    )  # fmt: skip
    known = dict(zip(fit.names, units, strict=True))
    combinations = []
    for each in fit.combinations:
        of_terms = {known.get(name, "") for name in each.sum_of}
        alike = len(each.sum_of) > 1 and len(of_terms) == 1
        combinations.append(each._replace(unit=of_terms.pop() if alike else ""))
    verdict = dataclasses.replace(fit.verdict, combinations=tuple(combinations))
    return dataclasses.replace(fit, parameter_units=units, verdict=verdict)
