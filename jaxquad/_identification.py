"""`jaxquad identify`: from the options of the command line to a printed report and a folder."""

from argparse import Namespace
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float

from ._identification_bands import by_bands
from ._identification_files import write_identification
from ._identification_proposal import with_proposal
from ._identification_record import described, records_of
from .identify import (
    CoherenceWeighted,
    Combination,
    factors,
    Fit,
    fit,
    fit_transfer_function,
    guess_lagged_integrator,
    MaximumLikelihood,
    NotIdentifiable,
    Verification,
    verify,
)
from .models import LaggedIntegrator, TransferFunction
from .records import Record
from .report import comparison
from .spectra import (
    Composite,
    Estimator,
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
    Welch,
)


Outcome = Fit | NotIdentifiable  # the exception stands for the fit where there is none
_COSTS = {"ml": MaximumLikelihood(), "coherence": CoherenceWeighted()}
_POINTS = 100  # frequencies, log-spaced over the band
_LATE = 0.02  # of the record: a delay above it is no delay of the vehicle


def report_identification(options: Namespace) -> tuple[Path, NotIdentifiable | None]:
    """Identify, print the report, write the files.

    Returns the path of `result.json` and, where the parameters are not determined, why.
    """
    options = with_proposal(options)
    records = records_of(options)
    methods = _methods(options)
    frfs, outcomes = {}, {}
    for method in methods:
        frfs[method], outcomes[method] = _fit_twice(records, method, options)
    ordered = options.poles is not None
    late = {} if ordered or options.no_lag or options.no_delay else {"lag + delay": _late}
    frf, outcome, table = frfs[methods[0]], outcomes[methods[0]], ""
    if isinstance(outcome, Fit):
        outcome, table = by_bands(outcome, frf, _COSTS[options.cost], late)
    shown = f"{described(records)}\n\n{frf}"
    print(f"{shown}\n\n{_formula(options)}, {methods[0]} estimate:\n{outcome}")
    if ordered and isinstance(outcome, Fit):
        print(factors(outcome))
    if options.reference:
        print(f"\n{comparison(outcomes, late)}")
    elif late and isinstance(outcome, Fit):
        print(_sum(outcome))
    if table:
        print(f"\n{table}")
    check = _verified(outcome, frf, options)
    print(f"\n{check}" if check else "")
    path, others = write_identification(
        options, records, frfs, outcome, check,
        formula=_formula(options), derived=_derived(outcome, bool(late)),
    )  # fmt: skip
    print(f"{path}, {', '.join(others)}")
    return path, _failure(outcome)


def identified(options: Namespace) -> tuple[Record, FrequencyResponse, Outcome]:
    """Without a report: the first record, the response that was fitted, and the fit."""
    records = records_of(options)
    return records[0], *_fit_twice(records, _methods(options)[0], options)


def _methods(options: Namespace) -> tuple[str, ...]:
    """The first is the one to believe."""
    return ("joint", "direct") if options.reference else ("direct",)


def _fit_twice(
    records: list[Record], method: str, options: Namespace
) -> tuple[FrequencyResponse, Outcome]:
    """The second response is estimated with the delay that the first fit found taken out."""
    band, delay = _band(options), 0.0
    dt, duration = records[0].dt, max(record.duration for record in records)
    omega = np.geomspace(*band, _POINTS) if band else None
    while True:
        frf = frequency_response(records, omega, estimator=_estimator(options, method, delay))
        try:
            found = _fitted(frf, options)
        except NotIdentifiable as error:
            return frf, error
        late = dt * round(float(_late(found.model)) / dt)
        if delay or not 0 < late < _LATE * duration:
            return frf, found
        delay = late


def _estimator(options: Namespace, method: str, delay: float) -> Estimator:
    late = {"integrators": options.integrators, "delay": delay}
    spectra = {
        "local": LocalPolynomial(**late),
        "composite": Composite(**late),
        "welch": Welch(options.window, **late),
    }["welch" if options.window else options.estimator]
    return JointInputOutput(spectra) if method == "joint" else spectra


def _fitted(frf: FrequencyResponse, options: Namespace) -> Fit:
    cost, fixed = _COSTS[options.cost], {"lag": options.no_lag, "delay": options.no_delay}
    if options.poles is not None:
        n = options.integrators
        delay = 0.0 if options.no_delay else "free"
        orders = {"zeros": options.zeros, "poles": options.poles + n, "integrators": n}
        return fit_transfer_function(frf, delay=delay, cost=cost, **orders)
    free = ["gain", *(name for name, is_fixed in fixed.items() if not is_fixed)]
    return fit(_start(frf, options), frf, free=free, cost=cost)


def _band(options: Namespace) -> tuple[float, float] | None:
    """In rad/s."""
    given, scale = (options.band, 2 * np.pi) if options.band else (options.band_rad, 1.0)
    if given is None:
        return None
    if not 0 < given[0] < given[1] < np.inf:
        raise ValueError(f"the band {given[0]:g} .. {given[1]:g} has to rise from above 0")
    return scale * given[0], scale * given[1]


def _start(frf: FrequencyResponse, options: Namespace) -> LaggedIntegrator:
    guess = guess_lagged_integrator(frf, options.integrators)
    late = _late(guess)
    lag = 0.0 if options.no_lag else late if options.no_delay else guess.lag
    delay = 0.0 if options.no_delay else late if options.no_lag else guess.delay
    return LaggedIntegrator(guess.gain, lag, delay, options.integrators)


def _late(model: LaggedIntegrator | TransferFunction) -> Float[Array, ""]:
    """The sum of lag and delay, which a record determines better than either."""
    return model.delay if isinstance(model, TransferFunction) else model.lag + model.delay


def _derived(outcome: Outcome, summed: bool) -> list[Combination]:
    """The sum of lag and delay, if the record determines it."""
    if not summed or not isinstance(outcome, Fit):
        return []
    try:
        return [outcome.derived(_late, "lag + delay")]
    except NotIdentifiable:
        return []


def _sum(found: Fit) -> str:
    try:
        return str(found.derived(_late, "lag + delay"))
    except NotIdentifiable as error:
        return str(error)


def _formula(options: Namespace) -> str:
    n = options.integrators
    factors = [] if n == 0 else ["s"] if n == 1 else [f"s^{n}"]
    factors += [] if options.no_lag else ["(lag s + 1)"]
    below = " ".join(factors)
    above = "K" if options.no_delay else "K e^(-delay s)"
    [output], [source] = options.output, options.input
    if options.poles is not None:
        kind = f"{options.zeros} zeros over {options.poles} poles and {n} integrators"
        return f"{output} / {source}, {kind}{'' if options.no_delay else ', delayed'}"
    ratio = f" / ({below})" if len(factors) > 1 else f" / {below}" if factors else ""
    return f"{output} / {source} = {above}{ratio}"


def _verified(outcome: Outcome, frf: FrequencyResponse, options: Namespace) -> Verification | None:
    """The other record simulated, within the band that was fitted."""
    if options.verify is None or not isinstance(outcome, Fit):
        return None
    swapped = {
        "file": options.verify,
        "start": options.verify_start,
        "stop": options.verify_stop,
        "segment": [],
        "reference": None,
    }
    [other] = records_of(Namespace(**(vars(options) | swapped)))
    return verify(outcome.model, other, band=(float(frf.omega[0]), float(frf.omega[-1])))


def _failure(outcome: Outcome) -> NotIdentifiable | None:
    if isinstance(outcome, NotIdentifiable):
        return outcome
    lost = " and ".join(outcome.identifiability.undetermined)
    known = ", ".join(str(combination) for combination in outcome.combinations)
    rest = f"only {known}" if known else "nothing of them is determined"
    text = f"not identifiable from this record, each by itself: {lost}; {rest}"
    return NotIdentifiable(text) if lost else None
