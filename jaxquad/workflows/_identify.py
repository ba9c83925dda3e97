"""Identify a log: its response, the fit to it, fits to parts of the band, and a second record."""

import dataclasses
import shlex
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np

import jaxquad.identify as fitting
import jaxquad.spectra as spectra
from jaxquad._core import announce, as_messages, Message
from jaxquad.identify import Fit, fit, KnownFilter
from jaxquad.models import LaggedIntegrator, parameter_units, TransferFunction
from jaxquad.records import Proposal, Record, select
from jaxquad.records.firmware import axis_of_rate
from jaxquad.report import reason_of
from jaxquad.spectra import FrequencyResponse

from ._identification import EXPLAINED, HALVES, Identification
from ._log import mix_of, open_again, open_logs, OpenedLogs, read_records
from ._result_file import load_result, StoredResult
from ._settings import IdentifySettings, in_options


T = TypeVar("T")
_COSTS = {"ml": fitting.MaximumLikelihood(), "coherence": fitting.CoherenceWeighted()}
_POINTS = 100  # frequencies, log-spaced over the band
_LONGEST = 0.02  # of the record: a longer delay is no delay of the vehicle
_NEAR = 1.5  # samples: a delay that is taken out as precisely as that need not be better
_MISFIT = 3.0  # ratio of misfit to random error from which parts of the band are fitted, too
_CHANGE = 0.1  # of the gain, between parts of the band: more than that is not noise
# Of commands of other axes: the chance that one acts where it does not; how little of its power
# moves without the input where both are alike; how large it is, at least, in inputs.
_CHANCE, _ALIKE, _LOUD = 2e-3, 5e-3, 0.1
_CLEAR = 3.5  # standard errors, of a change by them
_EXPLAINS = 0.7  # of a misfit that is left, where they explain it
_OTHER = "other input"  # kind of a remark
_EXCITE = "excite the axis more, over a wider band (jaxquad design sweep), or record longer"


def identify(
    path: str | Path | Sequence[str | Path], settings: IdentifySettings | None = None
) -> Identification:
    """Identify one log, or several together, as `jaxquad identify` does.

    The frequency response is estimated with the delay taken out that a fit to a quick one has
    found. With an external reference, the joint input-output estimate is fitted, and the direct
    one, with the same delay taken out, beside it.

    **Arguments:**

    - `path`: a log of an autopilot, CSV, NPZ, MAT, HDF5, ... Or several of one vehicle in one
        condition: their records make one response, as the segments of one log do. They have the
        same channels and units; their sample rates become the lowest of them.
    - `settings`: what to read from it and what to fit. By default the log proposes its input and
      output, and K e^(-delay s) / (s (lag s + 1)) is fitted.

    **Returns:** an `Identification`. Parameters that the record does not determine are marked by
    `.fit.verdict`; nothing is written before its `.write(folder)`.

    **Raises:** `RecordError` or `ReadError` (both ValueErrors) for a log that cannot be used, and
    ValueError for settings that do not go with it.

    !!! example

        ```python
        settings = jq.workflows.IdentifySettings(input="M", output="q", band=(0.7, 12))
        result = jq.workflows.identify("flight.npz", settings)
        print(result)
        result.write("results/flight")
        ```
    """
    return identify_opened(open_logs(path, settings))


def identify_again(
    result: str | Path | StoredResult, *, log: str | Path | None = None
) -> Identification:
    """Identify the log of a stored result with its settings.

    **Arguments:**

    - `result`: the folder of the result, its `result.json`, or what `load_result` returns.
    - `log`: where the log lies, if it was moved; of several logs, the folder in which all lie.

    **Raises:** ValueError where a log is gone, or is not the same file by its SHA-256.
    """
    return identify_opened(open_again(result, log=log))


def identify_opened(opened: OpenedLogs) -> Identification:
    """Identify logs that are open, as `identify` does those of a path."""
    settings, flown, check, failures = opened.settings, None, None, {}
    [outputs] = mix_of(settings.output).values() or [{}]
    axes = [axis for name in outputs if (axis := axis_of_rate(name)) is not None]
    if len(outputs) == 1 and axes:  # the rate that an autopilot has logged
        from jaxquad.autopilot import flown_law  # here: with it come the laws of all firmwares

        [rate], [axis], [command] = outputs, axes, mix_of(settings.input).values()
        flown = flown_law(opened.paths, rate, axis, command, opened.proposal, settings)
    filters = () if flown is None or settings.keep_gyro_filters else flown.filters
    result, delay = _estimate(opened, filters, vehicle=flown is not None)
    fit, responses, fits = result.fit, dict(result.responses), dict(result.fits)
    if settings.verify is not None and fit.verdict.fitted:
        other = dataclasses.replace(
            settings, start=settings.verify_start, stop=settings.verify_stop, segments=(),
            reference=None, other_inputs=(),
        )  # fmt: skip
        record = _longest(Path(settings.verify), other)
        check = fitting.verify(fit, fitting.behind_filters(record, filters))

    def attempt(title: str, compute: Callable[[], T]) -> T | None:
        try:
            return compute()
        except Exception as error:
            failures[title] = reason_of(error)

    def fit_direct() -> tuple[FrequencyResponse, Fit]:
        frf = _respond(opened, "direct", filters, delay)
        return frf, finish_fit(_fit_response(frf, settings), settings, opened.records[0])

    bands = explanation = None
    if fit.verdict.fitted and fit.verdict.kind != "no minimum":
        bands = attempt(HALVES, fit.bands)
        changes = any(remark.kind in ("drift", "clock", spectra.TWO_LAGS) for remark in fit.remarks)
        if settings.explain and (changes or fit.chi_squared > fitting.MISFIT**2):
            explanation = attempt(EXPLAINED, fit.explain)
    if settings.reference:
        announce("fit to the direct response")
        if (direct := attempt("The direct estimate", fit_direct)) is not None:
            responses["direct"], fits["direct"] = direct
    return dataclasses.replace(
        result, responses=responses, fits=fits, flown=flown, check=check, bands=bands,
        explanation=explanation, failures=failures,
    )  # fmt: skip


def identify_fit(opened: OpenedLogs) -> Identification:
    """The estimate to trust and its fit alone, as a design needs them: the loop is closed on the
    rate behind the gyro's filters, which stay in the model."""
    settings = dataclasses.replace(opened.settings, keep_gyro_filters=True)
    return _estimate(opened._replace(settings=settings))[0]


def identify_plant(
    path: Path, settings: IdentifySettings, proposal: Proposal, filters: Sequence[KnownFilter]
) -> Identification:
    """Likewise, up to what the `filters` of the output were given; its remedies are flights."""
    opened = open_logs(path, settings, proposal)
    return _estimate(opened, filters, vehicle=True, remedies=[_EXCITE])[0]


def _estimate(
    opened: OpenedLogs, filters: Sequence[KnownFilter] = (), *, vehicle: bool = False,
    remedies: Sequence[str] | None = None,
) -> tuple[Identification, float]:  # fmt: skip
    """The estimate to trust with its fit, and the delay in s that was taken out of it.

    That delay is what a fit to a quick response finds; where the fit to the response itself finds
    another, it is estimated again. Known `filters` are divided out. The rate of a `vehicle` may be
    damped by the air.
    """
    paths, settings, proposal, records, _ = opened
    method = "joint" if settings.reference else "direct"
    announce(f"quick {method} response, for the delay")
    quick = _respond(opened, method, filters, quick=True)
    # To find the remarks takes as long as the fit.
    first = _fit_response(dataclasses.replace(quick, remarks=()), settings)
    delay = _delay_of(first, records)
    taken = f", {delay:.4g} s of delay taken out" if delay else ""
    announce(f"{method} response{taken}")
    frf = _respond(opened, method, filters, delay)
    announce(f"fit to the {method} response")
    fit = _fit_response(frf, settings)
    other = _delay_of(fit, records)
    if other and abs(other - delay) > _NEAR * records[0].dt:
        delay = other
        announce(f"{method} response, {delay:.4g} s of delay taken out")
        frf = _respond(opened, method, filters, delay)
        fit = _fit_response(frf, settings)
    damped = vehicle and isinstance(fit.model, LaggedIntegrator) and settings.integrators
    fit = fitting.fit_damped(fit) if damped else fit

    def fit_beside(opened: OpenedLogs) -> Fit:
        other = _fit_response(_respond(opened, method, filters, delay), settings)
        return fitting.fit_damped(other) if damped and other.verdict.fitted else other

    further = _remarks_on_other_inputs(opened, fit, frf, fit_beside)
    announce("fits to parts of the band")
    span, parts, changes = _fit_parts(fit, frf, settings)
    fit = finish_fit(fit, settings, records[0], (*further, *changes), remedies)
    parts = {span: fit} | parts if parts else {}
    responses, fits = {method: frf}, {method: fit}
    return Identification(paths, settings, records, responses, fits, parts, proposal), delay


def _respond(
    opened: OpenedLogs, method: str, filters: Sequence[KnownFilter], delay: float = 0.0, *,
    quick: bool = False,
) -> FrequencyResponse:  # fmt: skip
    """The response by a method, `delay` (s) and `filters` of the output taken out."""
    settings = opened.settings
    shape = {"integrators": settings.integrators, "delay": delay}
    if settings.window is not None or settings.estimator == "welch":
        estimator = spectra.Welch(settings.window, **shape)
    elif settings.estimator == "composite":
        estimator = spectra.Composite(**shape)
    else:
        estimator = spectra.LocalPolynomial(**shape, global_order=0 if quick else 12)
    records = _moved_records(opened, method)
    if method == "joint":
        estimator = spectra.JointInputOutput(estimator, len(records[0].reference_names) - 1)
    band = settings.band_rad
    if settings.band is not None:
        band = 2 * np.pi * settings.band[0], 2 * np.pi * settings.band[1]
    omega = None if band is None else np.geomspace(*band, _POINTS)
    frf = spectra.frequency_response(records, omega, estimator=estimator)
    frf = frf.pair() if len(frf.input_names) > 1 else frf
    return fitting.without_filters(frf, filters)


def _moved_records(opened: OpenedLogs, method: str) -> list[Record]:
    """With further inputs as further references, whose part a joint estimate takes out."""
    records = list(opened.records)
    first, *others = records[0].input_names
    if method == "direct" or not others:
        return records
    roles = {"inputs": first, "references": (*records[0].reference_names, *others)}
    return [select(record, outputs=record.output_names, **roles) for record in records]


def _delay_of(fit: Fit, records: tuple[Record, ...]) -> float:
    """In s, whole samples; 0 where nothing is fitted, and for one that is none of a vehicle."""
    if not fit.verdict.fitted:
        return 0.0
    model, dt = fit.model, records[0].dt
    late = (model.delay,) if isinstance(model, TransferFunction) else (model.lag, model.delay)
    total = dt * round(sum(map(float, late)) / dt)
    return total if 0 < total < _LONGEST * max(record.duration for record in records) else 0.0


def _fit_response(frf: FrequencyResponse, settings: IdentifySettings) -> Fit:
    """The model of the settings, or K e^(-delay s) / (s^n (lag s + 1)), fitted to a response."""
    cost, n = _COSTS[settings.cost], settings.integrators
    if settings.poles is not None:
        return fitting.fit_transfer_function(
            frf, zeros=settings.zeros, poles=settings.poles + n, integrators=n,
            delay="free" if settings.delay else 0.0, cost=cost,
        )  # fmt: skip
    free = ["gain", *(["lag"] if settings.lag else []), *(["delay"] if settings.delay else [])]
    if not np.any(np.isfinite(frf.response)):  # the fit says so
        return fit(LaggedIntegrator(1.0, 0.1, 0.1, n), frf, free=free, cost=cost)
    guess = fitting.guess_lagged_integrator(frf, n)
    total = np.asarray(guess.lag) + np.asarray(guess.delay)  # what is fixed at 0 adds to the other
    lag = 0.0 if not settings.lag else guess.lag if settings.delay else total
    delay = 0.0 if not settings.delay else guess.delay if settings.lag else total
    return fit(LaggedIntegrator(guess.gain, lag, delay, n), frf, free=free, cost=cost)


def _remarks_on_other_inputs(
    opened: OpenedLogs, full: Fit, frf: FrequencyResponse,
    fit_beside: Callable[[OpenedLogs], Fit],
) -> list[Message]:  # fmt: skip
    """On commands of other axes that move an estimate by more than its standard error, once they
    are inputs, too, and on those that nothing tells from the input."""
    controlled = any(remark.kind == spectra.DOMINATED for remark in frf.remarks)
    if not opened.others or not np.any(full.determined) or controlled:
        return []
    records, acting, alike = _moved_records(opened, frf.method), {}, {}
    size = max(float(np.std(record.inputs[:, 0])) for record in records)
    for text, signals in opened.others.items():
        power = spectra.compare_with_input(records, frf, signals)
        if power is None:
            continue
        if power.alone > _ALIKE and power.chance < _CHANCE / len(opened.others):
            acting[text] = signals
        elif power.alone <= _ALIKE and max(map(np.std, signals)) > _LOUD * size:
            alike[text] = 100 * (1 - power.alone)
    source, output = frf.input_names[0], frf.output_names[0]
    remarks = [
        Message(
            f"{text} moves as the input {source} does ({share:.1f} % of its power): what it does "
            f"to {output} counts as the input's, and no estimate of this log tells the two apart. "
            "Move one axis at a time",
            _OTHER,
        )
        for text, share in alike.items()
    ]
    if not acting:
        return remarks
    names = " and ".join(text.partition("=")[0] for text in acting)
    them, effects = "it" if len(acting) == 1 else "them", []
    announce(f"fit beside {', '.join(acting)}")
    try:
        other = fit_beside(opened.with_inputs(acting))
    except ValueError as error:
        text = (
            f"{output} answers to {names}, too, and {source} moves with {them}. By how much that "
            f"moves the estimates is not known, as a fit beside {them} failed: {error}"
        )
        return [*remarks, Message(text, _OTHER)]
    changes = []
    for name in {*full.names} & {*other.names}:  # a damping may be in one alone
        k, j = full.names.index(name), other.names.index(name)
        if not (full.determined[k] and other.determined[j]):
            continue
        before, after, error = full.values[k], other.values[j], full.standard_errors[k]
        # What only adds noise moves an estimate, too: by the difference of both variances.
        added = full.noise_standard_errors[k] ** 2 - other.noise_standard_errors[j] ** 2
        if abs(after - before) > max(error, _CLEAR * np.sqrt(abs(added))):
            changes.append((abs(after - before) / error, name, before, after))
    misfits = full.chi_squared**0.5, other.chi_squared**0.5
    explains = misfits[0] > fitting.MISFIT and misfits[1] < _EXPLAINS * misfits[0]
    if not changes and not explains:
        return remarks
    options = " ".join(f"--other-input {shlex.quote(text)}" for text in acting)
    if changes:
        errors, name, before, after = max(changes)
        percent = f"{100 * (after / before - 1):+.2g} %, " if before else ""
        effects.append(
            f"the {name} is {after:.4g} instead of {before:.4g} ({percent}{errors:.1f} standard "
            "errors), which the error bars do not include"
        )
    if explains:
        effects.append(f"the misfit is {misfits[1]:.1f} instead of {misfits[0]:.1f} random errors")
    text = (
        f"{output} answers to {names}, too, and {source} moves with {them}: "
        f"without this part {', and '.join(effects)}. Take it out ({options})"
    )
    return [*remarks, Message(text, _OTHER)]


def _fit_parts(
    full: Fit, frf: FrequencyResponse, settings: IdentifySettings
) -> tuple[str, dict[str, Fit | None], list[str]]:
    """The band in words, fits to its upper and lower two thirds, and where the gain is another.

    Nothing for a misfit below three times the noise, for other models than the lagged integrator,
    and for a response that feedback dominates or whose phase rises: no part of it would be better.
    """
    small = not full.chi_squared >= _MISFIT**2 or not isinstance(full.model, LaggedIntegrator)
    no_plant = any(remark.kind in (spectra.DOMINATED, spectra.EARLY) for remark in frf.remarks)
    if not full.verdict.fitted or small or no_plant:
        return "", {}, []
    hertz = lambda omega: f"{omega / (2 * np.pi):.3g} Hz"
    used = np.asarray(frf.omega)[fitting.usable(frf, None, 0.6)[:, 0, 0]]
    low, first, second, high = np.geomspace(used[0], used[-1], 4).tolist()
    span = f"{low:.3g} .. {high:.3g} rad/s ({low / (2 * np.pi):.3g} .. {hertz(high)})"
    bands = {
        f"above {first:.3g} rad/s ({hertz(first)})": (first, high),
        f"below {second:.3g} rad/s ({hertz(second)})": (low, second),
    }
    parts, changes, cost = dict[str, Fit | None](), [], _COSTS[settings.cost]
    sure = full.determined[0] or full.verdict.kind == "no model"
    for where, band in bands.items():
        try:  # from where the fit stopped
            part = fit(full.model, frf, free=full.names, cost=cost, band=band)
        except ValueError:  # the solver diverged
            parts[where] = None
            continue
        parts[where], before, after = part, full.values[0], part.values[0]
        least = max(_CHANGE * abs(before), 2 * part.standard_errors[0])
        if part.determined[0] and sure and abs(after - before) > least:
            changes.append(
                f"{where} the gain is {after:.4g} instead of {before:.4g}, with a misfit of "
                f"{part.chi_squared**0.5:.1f} instead of {full.chi_squared**0.5:.1f}: the model "
                "does not hold over the whole band. Fit the part where it does (--band, "
                "--band-rad), or a model of higher order (--poles)"
            )
    return span, parts, changes


def finish_fit(
    fit: Fit, settings: IdentifySettings, record: Record, further: Sequence[str] = (),
    remedies: Sequence[str] | None = None,
) -> Fit:  # fmt: skip
    """The fit in the words of the command line, with the `further` remarks and with units, in which
    a channel without one stands for itself. `remedies` are by default options."""
    verdict, units = fit.verdict, fit.parameter_units
    if not verdict.identifiable:
        remedies = _options_for(fit, settings) if remedies is None else remedies
        verdict = dataclasses.replace(verdict, remedies=as_messages(remedies))
    if verdict.fitted:
        output, source = record.output_units[0], record.input_units[0]
        units = parameter_units(
            fit.model, fit.names,
            output=output or record.output_names[0], input=source or record.input_names[0],
        )  # fmt: skip
        of_parameters = dict(zip(fit.names, units, strict=True))
        combinations = []
        for combination in verdict.combinations:
            of_terms = {of_parameters.get(name, "") for name in combination.sum_of}
            alike = len(combination.sum_of) > 1 and len(of_terms) == 1
            combinations.append(combination._replace(unit=of_terms.pop() if alike else ""))
        verdict = dataclasses.replace(verdict, combinations=tuple(combinations))
    remarks = tuple(map(in_options, (*fit.remarks, *further)))
    return dataclasses.replace(fit, verdict=verdict, remarks=remarks, parameter_units=units)


def _options_for(fit: Fit, settings: IdentifySettings) -> list[str]:
    """What may determine the parameters of a fit that are open, as options."""
    kind, remarked = fit.verdict.kind, {remark.kind for remark in fit.remarks}
    wider = [remedy for remedy in fit.verdict.remedies if remedy.kind == fitting.WIDER_BAND]
    excite = in_options(wider[0]) if wider else _EXCITE
    if kind == "too few points":
        return [excite, "use longer windows (--estimator welch --window S)"]
    if kind == "no model" and spectra.DOMINATED in remarked:
        name = [] if settings.reference else ["name the external reference (--reference)"]
        record = "excite the axis (jaxquad design sweep), and record what excites it as the "
        return [*name, f"{record}reference"]
    if kind == "no model" and spectra.EARLY in remarked:
        return ["exchange --input and --output if they are swapped, or correct time stamps"]
    if kind == "no model":
        return [
            "fit the part of the band where it holds (--band, --band-rad)",
            "fit a model of higher order (--poles), or ask which term is missing (--explain)",
        ]
    if settings.poles is not None:
        return ["fit fewer poles and zeros (--poles, --zeros)", excite]
    if {"lag", "delay"} & {*fit.verdict.undetermined} and settings.lag and settings.delay:
        return ["fit without the lag (--no-lag) or without the delay (--no-delay)", excite]
    return [excite]


def _longest(path: Path, settings: IdentifySettings) -> Record:
    """Of the records into which gaps cut it."""
    return max(read_records(path, settings), key=lambda record: record.samples)


def verify_result(
    result: str | Path | StoredResult,
    path: str | Path,
    changes: Mapping[str, object] | None = None,
) -> fitting.Verification:
    """Simulate an identified model on another record, and compare.

    **Arguments:**

    - `result`: the folder of the result, its `result.json`, or what `load_result` returns.
    - `path`: the other log.
    - `changes`: settings that differ for this log (keys of `IdentifySettings`): another channel's
      name, another part, another band. Otherwise its whole time is used, with the channels and the
      rate of the result, in the band of the points that its fit used.

    **Raises:** `UndeterminedError` (a ValueError) for a result without a model, `RecordError` for a
    log that cannot be used.
    """
    stored = result if isinstance(result, StoredResult) else load_result(result)
    every = {"start": None, "stop": None, "segments": (), "reference": None, "other_inputs": ()}
    settings = dataclasses.replace(stored.settings, **every, band=None, band_rad=stored.band)
    settings = settings.changed(changes or {})
    model, band = stored.model, stored.used_band
    if settings.band_rad != stored.band:
        band = settings.band_rad
    if settings.band is not None:
        band = 2 * np.pi * settings.band[0], 2 * np.pi * settings.band[1]
    record = _longest(Path(path), settings)
    return fitting.verify(model, fitting.behind_filters(record, stored.filters), band=band)
