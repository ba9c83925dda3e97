"""`jaxquad identify`: from the options of the command line to a printed report and a folder."""

import dataclasses
from argparse import Namespace
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Array, Float

from jaxquad.identify import (
    CoherenceWeighted,
    Combination,
    Cost,
    factors,
    Fit,
    fit,
    fit_transfer_function,
    guess_lagged_integrator,
    MaximumLikelihood,
    NotIdentifiable,
    usable,
    Verification,
    verify,
)
from jaxquad.models import LaggedIntegrator, TransferFunction
from jaxquad.records import Proposal, propose, read_segments, Record, Segment
from jaxquad.report import comparison
from jaxquad.spectra import (
    Composite,
    Estimator,
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
    Welch,
)

from ._stored import write_identification


_DOUBT = 3.0  # ratio of misfit to random error from which the band is looked into
_DOMINATED = "feedback-dominated"
_MOVED = 0.1  # of the gain: more than that is no matter of noise


def by_bands(
    found: Fit, frf: FrequencyResponse, cost: Cost, derived: Mapping[str, Callable[[Any], Any]]
) -> tuple[Fit, str]:
    """The fit beside those in the upper and the lower two thirds of its frequencies.

    Returns it with a remark where the gain moves, and the table. Nothing is added where the
    misfit is below three times the noise, for other models than the lagged integrator, and for a
    response that feedback dominates: no part of it would be better.
    """
    small = found.chi_squared < _DOUBT**2 or not isinstance(found.model, LaggedIntegrator)
    if small or any(_DOMINATED in remark for remark in frf.remarks):
        return found, ""
    used = np.asarray(frf.omega)[usable(frf, None, 0.6)[:, 0, 0]]
    low, first, second, high = np.geomspace(used[0], used[-1], 4).tolist()
    parts = {"above": (first, high), "below": (low, second)}
    fits: dict[str, Fit | NotIdentifiable] = {f"{low:.3g} .. {high:.3g} rad/s": found}
    for word, band in parts.items():
        limit = first if word == "above" else second
        fits[f"{word} {limit:.3g} rad/s"] = _refitted(found, frf, cost, band)
    table = comparison(fits, derived)
    moved = [_moved(name, other, found) for name, other in list(fits.items())[1:]]
    remarks = tuple(filter(None, moved))
    return dataclasses.replace(found, remarks=(*found.remarks, *remarks)), table


def _refitted(
    found: Fit, frf: FrequencyResponse, cost: Cost, band: tuple[float, float]
) -> Fit | NotIdentifiable:
    """From where the fit stopped; its undetermined numbers too are finite in the model."""
    try:
        return fit(found.model, frf, free=found.names, cost=cost, band=band)
    except NotIdentifiable as error:
        return error
    except ValueError as error:  # The solver diverged.
        return NotIdentifiable(str(error))


def _moved(where: str, other: Fit | NotIdentifiable, found: Fit) -> str:
    if isinstance(other, NotIdentifiable):
        return ""
    before, after = found.values[0], other.values[0]
    apart = abs(after - before)
    if not apart > max(_MOVED * abs(before), 2 * other.standard_errors[0]):
        return ""
    ratio, was = other.chi_squared**0.5, found.chi_squared**0.5
    return (
        f"{where} the gain is {after:.4g} instead of {before:.4g}, with a misfit of {ratio:.1f} "
        f"instead of {was:.1f}: the model does not hold over the whole band. Fit within the part "
        f"where it does (--band, --band-rad), or fit one that has more to it"
    )


def with_proposal(options: Namespace) -> Namespace:
    """Options with input and output, and the proposal printed where they come from it.

    What the user gave stays. Raises ValueError where only one of the two is given, or an axis
    beside them, and what `propose` raises.
    """
    if options.input and options.output:
        if options.axis:
            raise ValueError("--axis is for a proposal: leave it out, or --input and --output")
        return options
    if options.input or options.output:
        raise ValueError("--input and --output belong together: give both, or none to be proposed")
    proposal = propose(options.file, axis=options.axis)
    print(f"{proposal}\n")
    offered = proposal.options
    one = lambda name: {name: {name: 1.0}} if name else None
    found = {"input": offered["inputs"], "output": one(offered["outputs"]), "axis": None}
    if options.reference is None:
        found["reference"] = one(offered["references"])
    if options.rate is None:
        found["rate"] = offered["sample_rate"]
    if proposal.setup.band and not (options.band or options.band_rad):
        found["band"] = list(proposal.setup.band)
    return Namespace(**(vars(options) | found | _span(options, proposal)))


def _span(options: Namespace, proposal: Proposal) -> dict[str, Any]:
    """All injections that were found, or what of them lies where the user says to look."""
    if options.segment:
        return {}
    low = -np.inf if options.start is None else options.start
    high = np.inf if options.stop is None else options.stop
    inside = [(max(start, low), min(stop, high)) for start, stop in proposal.segments]
    spans = [(start, stop) for start, stop in inside if start < stop]
    if len(spans) > 1:
        return {"segment": spans, "start": None, "stop": None}
    return dict(zip(("start", "stop"), spans[0], strict=True)) if spans else {}


def records_of(options: Namespace) -> list[Record]:
    """One for each segment. Raises RecordError, ReadError."""
    asked = {*options.input, *options.output, *(options.reference or {})}
    return read_segments(
        options.file,
        _segments(options),
        inputs=options.input,
        outputs=options.output,
        references=options.reference,
        sample_rate=options.rate,
        time=options.time,
        time_unit=options.time_unit,
        units={name: unit for name, unit in options.unit if name in asked},
    )


def _segments(options: Namespace) -> Sequence[Segment]:
    if not options.segment:
        return [(options.start, options.stop)]
    if options.start is not None or options.stop is not None:
        raise ValueError("--segment says where to start and stop: leave --start and --stop out")
    return [(float(start), float(stop)) for start, stop in options.segment]


def described(records: Sequence[Record]) -> str:
    """All of them as they are printed; the channels once."""
    first, *others = map(str, records)
    return "\n".join([first, *(f"and {text.splitlines()[1].strip()}" for text in others)])


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
