"""Identify one log: from its path and settings to fits, text, figures and a folder."""

import dataclasses
import functools as ft
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import announce
from jaxquad.identify import (
    Bands,
    CoherenceWeighted,
    Combination,
    Explanation,
    factors,
    Fit,
    fit,
    fit_transfer_function,
    guess_lagged_integrator,
    MaximumLikelihood,
    MISFIT,
    UndeterminedError,
    usable,
    Verification,
    verify,
)
from jaxquad.models import LaggedIntegrator, parameter_units, TransferFunction
from jaxquad.plot import bode, compare, headless, Panels, record_figure
from jaxquad.records import (
    Mix,
    parse_mix,
    Proposal,
    propose,
    read_segments,
    Record,
    RecordError,
    Segment,
)
from jaxquad.report import compare_fits
from jaxquad.spectra import (
    Composite,
    Estimator,
    frequency_response,
    FrequencyResponse,
    JointInputOutput,
    LocalPolynomial,
    Welch,
)

from ._kinds import mix_text, SettingsError
from ._result_file import default_folder
from ._settings import IdentifySettings
from ._words import in_options


Model = LaggedIntegrator | TransferFunction
_COSTS = {"ml": MaximumLikelihood(), "coherence": CoherenceWeighted()}
_POINTS = 100  # frequencies, log-spaced over the band
_LONGEST = 0.02  # of the record: a longer delay is no delay of the vehicle
_MISFIT = 3.0  # ratio of misfit to random error from which parts of the band are fitted, too
_CHANGE = 0.1  # of the gain, between parts of the band: more than that is not noise
_DOMINATED = "feedback-dominated"


@dataclasses.dataclass(frozen=True)
class Identification:
    """One identified log, as `identify` returns it; `str()` is its report as text.

    **Attributes:**

    - `path`: of the log.
    - `settings`: those that were used, a proposal included.
    - `records`: one for each segment of each log.
    - `responses`: the frequency response by method, the one to trust first.
    - `fits`: the fit to each of them.
    - `parts`: where the misfit is large, the fit beside those to the upper and to the lower part of
      the band; None for one that diverged.
    - `bands`: the same parameters from the lower and the upper half of the band, where there is a
      fit.
    - `explanation`: which further term the response wants, where `settings.explain` asks for it and
      the misfit exceeds 1.5 random errors.
    - `check`: the second record simulated, where `settings.verify` names one.
    - `proposal`: where the log itself said what is input and output.
    - `more`: the logs that were taken together with the first.
    """

    path: Path
    settings: IdentifySettings
    records: tuple[Record, ...]
    responses: Mapping[str, FrequencyResponse]
    fits: Mapping[str, Fit]
    parts: Mapping[str, Fit | None]
    check: Verification | None
    proposal: Proposal | None
    bands: Bands | None = None
    explanation: Explanation | None = None
    more: tuple[Path, ...] = ()

    @property
    def paths(self) -> tuple[Path, ...]:
        """All logs that were identified together."""
        return self.path, *self.more

    @property
    def title(self) -> str:
        """The name of the log, and how many others were taken with it."""
        others = f" and {len(self.more)} more" if self.more else ""
        return f"{self.path.name}{others}"

    @property
    def method(self) -> str:
        """The estimate to trust: joint with an external reference, else direct."""
        return next(iter(self.responses))

    @property
    def frf(self) -> FrequencyResponse:
        """The frequency response that was fitted."""
        return self.responses[self.method]

    @property
    def fit(self) -> Fit:
        """The fit to it, with its verdict."""
        return self.fits[self.method]

    @property
    def band(self) -> tuple[float, float]:
        """The frequencies that were fitted, in rad/s."""
        omega = np.asarray(self.frf.omega)
        return float(omega[0]), float(omega[-1])

    @property
    def largest_command(self) -> float:
        """How far the input went from its mean to either side, in its unit."""
        inputs = [np.asarray(record.inputs)[:, 0] for record in self.records]
        return max(float(np.max(np.abs(x - np.mean(x)))) for x in inputs)

    @property
    def formula(self) -> str:
        """The structure of the model in words."""
        return model_formula(self.settings)

    @ft.cached_property
    def combinations(self) -> tuple[Combination, ...]:
        """The sum of lag and delay, where the record determines it."""
        try:
            return tuple(self.fit.derived(q, name) for name, q in _sums(self.settings).items())
        except UndeterminedError:
            return ()

    @property
    def beside(self) -> dict[str, str]:
        """What goes with the fit as text, by title: halves of the band, what explains a misfit."""
        found: dict[str, Bands | Explanation | None] = {
            "Lower and upper half of the band": self.bands,
            "What explains the misfit": self.explanation,
        }
        return {title: str(each) for title, each in found.items() if each is not None}

    def figures(self) -> dict[str, Panels]:
        """The figures by file name: Bode diagram, records, and the check on a second record."""
        models = {"identified": self.fit} if self.fit.verdict.fitted else {}
        others = {f"{name} estimate": self.responses[name] for name in list(self.responses)[1:]}
        with headless():
            figures = {
                f"record{'' if k == 1 else f'_{k}'}.png": record_figure(record)
                for k, record in enumerate(self.records, start=1)
            }
            figures["bode.png"] = bode(self.frf, others, models, title=self.title)
            if self.check is not None:
                title = Path(self.settings.verify or "").name
                figures["verification.png"] = compare(self.check, title=title)
        return figures

    def write(self, folder: str | Path | None = None) -> Path:
        """Write `result.json`, `report.html` and the figures, by default to results/NAME.

        **Returns:** the path of `result.json`.
        """
        from ._stored import write_identification

        return write_identification(self, Path(folder or default_folder(self.path)))

    def __str__(self) -> str:
        first, *others = map(str, self.records)
        record = "\n".join([first, *(f"and {text.splitlines()[1].strip()}" for text in others)])
        frf = dataclasses.replace(self.frf, remarks=())  # the fit repeats what concerns it
        parts = [f"{record}\n\n{frf}"]
        parts += [f"\n{self.formula}, {self.method} estimate:\n{self.fit}"]
        sums, known = _sums(self.settings), [each.name for each in self.fit.combinations]
        if self.settings.poles is not None and self.fit.verdict.fitted:
            parts += [_text_or_reason(lambda: factors(self.fit))]
        if self.settings.reference:
            parts += [f"\n{compare_fits(self.fits, sums)}"]
        elif self.fit.verdict.fitted:
            parts += [
                _text_or_reason(lambda n=name, q=quantity: self.fit.derived(q, n))
                for name, quantity in sums.items()
                if name not in known
            ]
        if self.parts:
            parts += [f"\nFits to parts of the band:\n{compare_fits(self.parts, sums)}"]
        parts += [f"\n{title}:\n{text}" for title, text in self.beside.items()]
        return "\n".join([*parts, *([f"\n{self.check}"] if self.check else [])])


def _text_or_reason(made: Callable[[], object]) -> str:
    try:
        return str(made())
    except UndeterminedError as error:
        return str(error)


def identify(
    path: str | Path | Sequence[str | Path], settings: IdentifySettings | None = None
) -> Identification:
    """Identify one log, or several together, as `jaxquad identify` does.

    The frequency response is estimated twice: the second time with the delay taken out that the
    first fit has found. With an external reference, the joint input-output estimate is fitted, and
    the direct one, with the same delay taken out, beside it.

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
    path, *more = [Path(path)] if isinstance(path, str | Path) else map(Path, path)
    settings, proposal = propose_settings(path, settings or IdentifySettings(), several=bool(more))
    records = _read_logs((path, *more), settings)
    methods = ("joint", "direct") if settings.reference else ("direct",)
    responses, fits, delay = {}, {}, 0.0
    for method in methods:
        responses[method], found, delay = _fit_twice(records, method, settings, delay)
        fits[method] = _with_units(_with_remedies(found, settings), records[0])
    announce("fits to parts of the band")
    best = methods[0]
    fits[best], parts = _fit_parts(fits[best], responses[best], settings)
    fits = {name: _in_option_words(each) for name, each in fits.items()}
    found = Identification(
        path, settings, records, responses, fits, parts, None, proposal, more=tuple(more)
    )
    return dataclasses.replace(found, check=_checked(found), **_fitted_again(found))


def _in_option_words(fit: Fit) -> Fit:
    return dataclasses.replace(fit, remarks=tuple(map(in_options, fit.remarks)))


def _with_units(fit: Fit, record: Record) -> Fit:
    """The units of the parameters; a channel without a unit stands for itself."""
    if not fit.verdict.fitted:
        return fit
    [output], [source] = record.output_units, record.input_units
    units = parameter_units(
        fit.model, fit.names,
        output=output or record.output_names[0], input=source or record.input_names[0],
    )  # fmt: skip
    return dataclasses.replace(fit, parameter_units=units)


def _fitted_again(found: Identification) -> dict[str, Bands | Explanation | None]:
    """The halves of the band, and the explanation of a misfit that was asked for."""
    fit = found.fit
    if not fit.verdict.fitted or fit.verdict.kind == "no minimum":
        return {}
    wanted = found.settings.explain and fit.chi_squared > MISFIT**2
    return {"bands": fit.bands(), "explanation": fit.explain() if wanted else None}


def propose_settings(
    path: Path, settings: IdentifySettings, *, several: bool = False
) -> tuple[IdentifySettings, Proposal | None]:
    """Settings with input and output, from the log's proposal where they are not given.

    What the settings say stays. Raises what `jaxquad.propose` raises, and SettingsError where
    `several` logs are to have one input and output.
    """
    if settings.input is not None:
        return settings, None
    if several:
        raise SettingsError(
            f"several logs need `input` and `output`: run jaxquad identify {path} alone, and give "
            "what it proposes"
        )
    proposal = propose(path, axis=settings.axis)
    offered = proposal.options
    found = {"input": mix_text(offered["inputs"]), "output": offered["outputs"], "axis": None}
    if settings.reference is None:
        found["reference"] = offered["references"]
    if settings.rate is None:
        found["rate"] = offered["sample_rate"]
    if settings.hold is None:
        found["hold"] = offered["hold"]
    if proposal.setup.band and settings.band is settings.band_rad is None:
        found["band"] = proposal.setup.band
    return dataclasses.replace(settings, **found | _proposed_span(settings, proposal)), proposal


def _proposed_span(settings: IdentifySettings, proposal: Proposal) -> dict[str, object]:
    """All injections that were found, or those within `start` and `stop`."""
    if settings.segments:
        return {}
    low = -np.inf if settings.start is None else settings.start
    high = np.inf if settings.stop is None else settings.stop
    inside = [(max(start, low), min(stop, high)) for start, stop in proposal.segments]
    spans = [(start, stop) for start, stop in inside if start < stop]
    if len(spans) > 1:
        return {"segments": spans, "start": None, "stop": None}
    return dict(zip(("start", "stop"), spans[0], strict=True)) if spans else {}


def _read_logs(paths: Sequence[Path], settings: IdentifySettings) -> tuple[Record, ...]:
    """The records of all logs, with one sample rate. Raises RecordError where units differ."""
    logs = {path: read_records(path, settings) for path in paths}
    rates = [records[0].sample_rate for records in logs.values()]
    if max(rates) > (1 + 1e-6) * min(rates):
        common = dataclasses.replace(settings, rate=float(f"{min(rates):.3g}"))
        logs = {path: read_records(path, common) for path in paths}
    _check_units(logs)
    return tuple(record for records in logs.values() for record in records)


def _check_units(logs: Mapping[Path, tuple[Record, ...]]) -> None:
    (first, [known, *_]), *others = logs.items()
    for path, [record, *_] in others:
        for name in (*known.input_names, *known.output_names):
            if record.unit(name) != known.unit(name):
                raise RecordError(
                    f"the unit of {name} is {known.unit(name) or 'not known'} in {first}, but "
                    f"{record.unit(name) or 'not known'} in {path}: logs that are identified "
                    f"together need one unit. Leave one of them out."
                )


def read_records(path: Path, settings: IdentifySettings) -> tuple[Record, ...]:
    """One record for each segment. Raises RecordError, ReadError."""
    announce(f"reading {path.name}")
    inputs, outputs, references = map(_mix, (settings.input, settings.output, settings.reference))
    asked = {*inputs, *outputs, *references}
    segments: list[Segment] = list(settings.segments) or [(settings.start, settings.stop)]
    records = read_segments(
        path,
        segments,
        inputs=inputs,
        outputs=outputs,
        references=references,
        sample_rate=settings.rate,
        time=settings.time,
        time_unit=settings.time_unit,
        dt=settings.dt,
        units={name: unit for name, unit in settings.units.items() if name in asked},
        max_gap=settings.max_gap,
        valid=settings.valid,
        hold=settings.hold,
    )
    return tuple(records)


def _mix(text: str | None) -> Mix:
    return {} if text is None else parse_mix(text)


def _fit_twice(
    records: tuple[Record, ...], method: str, settings: IdentifySettings, delay: float
) -> tuple[FrequencyResponse, Fit, float]:
    """The second response is estimated with the delay (s) that the first fit found taken out.

    Once is enough where a delay is known. Returns the delay, too.
    """
    band = _band(settings)
    dt, duration = records[0].dt, max(record.duration for record in records)
    omega = np.geomspace(*band, _POINTS) if band else None
    while True:
        announce(f"{method} response{f', {delay:.4g} s of delay taken out' if delay else ''}")
        estimator = _estimator(settings, method, delay)
        frf = frequency_response(list(records), omega, estimator=estimator)
        announce(f"fit to the {method} response")
        found = _fitted(frf, settings)
        if not found.verdict.fitted:
            return frf, found, delay
        total = dt * round(float(total_delay(found.model)) / dt)
        if delay or not 0 < total < _LONGEST * duration:
            return frf, found, delay
        delay = total


def _band(settings: IdentifySettings) -> tuple[float, float] | None:
    """In rad/s."""
    if settings.band is not None:
        return 2 * np.pi * settings.band[0], 2 * np.pi * settings.band[1]
    return settings.band_rad


def _estimator(settings: IdentifySettings, method: str, delay: float) -> Estimator:
    shape = {"integrators": settings.integrators, "delay": delay}
    if settings.window is not None or settings.estimator == "welch":
        estimator = Welch(settings.window, **shape)
    elif settings.estimator == "composite":
        estimator = Composite(**shape)
    else:
        estimator = LocalPolynomial(**shape)
    return JointInputOutput(estimator) if method == "joint" else estimator


def _fitted(frf: FrequencyResponse, settings: IdentifySettings) -> Fit:
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
    guess = guess_lagged_integrator(frf, settings.integrators)
    total = np.asarray(guess.lag) + np.asarray(guess.delay)
    lag = 0.0 if not settings.lag else guess.lag if settings.delay else total
    delay = 0.0 if not settings.delay else guess.delay if settings.lag else total
    return LaggedIntegrator(guess.gain, lag, delay, settings.integrators)


def total_delay(model: Model) -> Float[Array, ""]:
    """The sum of lag and delay, which a record determines better than either of them."""
    return model.delay if isinstance(model, TransferFunction) else model.lag + model.delay


def _sums(settings: IdentifySettings) -> Mapping[str, Callable[[Model], Float[Array, ""]]]:
    """The quantities that are shown beside the parameters."""
    both = settings.poles is None and settings.lag and settings.delay
    return {"lag + delay": total_delay} if both else {}


def _with_remedies(found: Fit, settings: IdentifySettings) -> Fit:
    """The same fit, whose remedies are options of `jaxquad identify`."""
    kind, lost = found.verdict.kind, found.verdict.undetermined
    if kind == "identifiable":
        return found
    excite = "excite the axis more, over a wider band (jaxquad design sweep), or record longer"
    remedies = [excite]
    if kind == "too few points":
        remedies += ["use longer windows (--estimator welch --window S)"]
    elif kind == "no model":
        remedies = [
            "fit the part of the band where it holds (--band, --band-rad)",
            "fit a model of higher order (--poles), or ask which term is missing (--explain)",
        ]
    elif settings.poles is not None:
        remedies = ["fit fewer poles and zeros (--poles, --zeros)", excite]
    elif {"lag", "delay"} & set(lost) and settings.lag and settings.delay:
        remedies = ["fit without the lag (--no-lag) or without the delay (--no-delay)", excite]
    verdict = dataclasses.replace(found.verdict, remedies=tuple(remedies))
    return dataclasses.replace(found, verdict=verdict)


def _fit_parts(
    found: Fit, frf: FrequencyResponse, settings: IdentifySettings
) -> tuple[Fit, dict[str, Fit | None]]:
    """Fits to the upper and the lower two thirds of the frequencies, where the misfit is large.

    Returns the fit too, with a remark where the gain differs between them. There are no parts for
    a misfit below three times the noise, for other models than the lagged integrator, and for a
    response that feedback dominates: no part of it would be better.
    """
    small = not found.chi_squared >= _MISFIT**2 or not isinstance(found.model, LaggedIntegrator)
    dominated = any(_DOMINATED in remark for remark in frf.remarks)
    if not found.verdict.fitted or small or dominated:
        return found, {}
    used = np.asarray(frf.omega)[usable(frf, None, 0.6)[:, 0, 0]]
    low, first, second, high = np.geomspace(used[0], used[-1], 4).tolist()
    bands = {
        f"above {first:.3g} rad/s ({_hertz(first)})": (first, high),
        f"below {second:.3g} rad/s ({_hertz(second)})": (low, second),
    }
    parts = {name: _refitted(found, frf, settings, band) for name, band in bands.items()}
    remarks = [_gain_change(name, part, found) for name, part in parts.items()]
    found = dataclasses.replace(found, remarks=(*found.remarks, *filter(None, remarks)))
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


def model_formula(settings: IdentifySettings) -> str:
    """The structure of the model, such as `q / M = K e^(-delay s) / (s (lag s + 1))`."""
    n = settings.integrators
    [output], [source] = _mix(settings.output), _mix(settings.input)
    if settings.poles is not None:
        kind = f"{settings.zeros} zeros over {settings.poles} poles and {n} integrators"
        return f"{output} / {source}, {kind}{', delayed' if settings.delay else ''}"
    powers = [] if n == 0 else ["s"] if n == 1 else [f"s^{n}"]
    below = powers + (["(lag s + 1)"] if settings.lag else [])
    above = "K e^(-delay s)" if settings.delay else "K"
    product = " ".join(below)
    ratio = f" / ({product})" if len(below) > 1 else f" / {product}" if below else ""
    return f"{output} / {source} = {above}{ratio}"


def _checked(found: Identification) -> Verification | None:
    """The second record simulated, within the band that was fitted."""
    settings = found.settings
    if settings.verify is None or not found.fit.verdict.fitted:
        return None
    other = dataclasses.replace(
        settings,
        start=settings.verify_start,
        stop=settings.verify_stop,
        segments=(),
        reference=None,
    )
    [record] = read_records(Path(settings.verify), other)
    return verify(found.fit.model, record, band=found.band)
