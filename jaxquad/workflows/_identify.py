"""Identify one log: from its path and settings to fits, text, figures and a folder."""

import dataclasses
import functools as ft
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from jaxquad._core import announce, as_messages, marked_text, Message
from jaxquad.autopilot import flown_law, FlownLaw
from jaxquad.identify import (
    Bands,
    behind_filters,
    Combination,
    Explanation,
    factors,
    Fit,
    fit_damped,
    KnownFilter,
    MISFIT,
    UndeterminedError,
    Verification,
    verify,
)
from jaxquad.models import LaggedIntegrator
from jaxquad.records import (
    Proposal,
    Record,
)
from jaxquad.report import reason_of
from jaxquad.spectra import (
    FrequencyResponse,
)

from ._fits import (
    EXCITE,
    fit_best,
    fit_parts,
    fit_response,
    in_option_words,
    respond,
    sums_of,
    with_remedies,
    with_units,
)
from ._log import mix_of, open_logs, OpenedLogs, read_records
from ._result_file import default_folder
from ._settings import IdentifySettings


if TYPE_CHECKING:
    from jaxquad.plot import Panels


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
    - `failures`: by title, why something beside the fit could not be computed.
    - `flown`: the gyro's filters and the law of an autopilot's log, up to whose filters the model
      is, unless `settings.keep_gyro_filters`.
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
    failures: Mapping[str, str] = dataclasses.field(default_factory=dict)
    flown: FlownLaw | None = None

    @property
    def filters(self) -> tuple[KnownFilter, ...]:
        """Those of the gyro that are divided out of the responses."""
        if self.flown is None or self.settings.keep_gyro_filters:
            return ()
        return self.flown.filters

    @property
    def filters_text(self) -> str:
        """What is divided out, or why nothing is; empty where the log is no autopilot's."""
        if self.flown is None:
            return ""
        if self.flown.filters and not self.filters:
            return "the gyro's filters are in the model, as `keep_gyro_filters` asks"
        return self.flown.text

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
        """The band of the response that was fitted, in rad/s."""
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
        return model_formula(self.settings, damped="damping" in self.fit.names)

    @ft.cached_property
    def combinations(self) -> tuple[Combination, ...]:
        """The sum of lag and delay, where the record determines it."""
        try:
            return tuple(map(self._sum, sums_of(self.settings)))
        except UndeterminedError:
            return ()

    def _sum(self, name: str) -> Combination:
        return self.fit.derived(sums_of(self.settings)[name], name)._replace(unit="s")

    @property
    def beside(self) -> dict[str, str]:
        """What goes with the fit as text, by title: halves of the band, what explains a misfit."""
        found: dict[str, Bands | Explanation | None] = {
            _HALVES: self.bands,
            _EXPLAINED: self.explanation,
        }
        texts = {title: str(each) for title, each in found.items() if each is not None}
        return texts | {
            title: Message(f"could not be computed: {marked_text(why)}")
            for title, why in self.failures.items()
        }

    @property
    def figure_names(self) -> tuple[str, ...]:
        """The names of the files of `figures()`, without drawing any."""
        numbers = ("", *(f"_{k}" for k in range(2, len(self.records) + 1)))
        records = [f"record{number}.png" for number in numbers]
        return *records, "bode.png", *(() if self.check is None else ("verification.png",))

    def figures(self) -> "dict[str, Panels]":
        """The figures by file name: records, Bode diagram, and the check on a second record."""
        return {name: draw() for name, draw in self.drawings().items()}

    def drawings(self) -> "dict[str, Callable[[], Panels]]":
        """What draws each of the `figures()`, by file name."""
        from jaxquad.plot import bode, compare, headless, record_figure  # here: matplotlib is slow

        stopped = self.fit.verdict.kind in ("no model", "no minimum")
        name = f"{self.fit.verdict.kind}: where the fit stopped" if stopped else "identified"
        models = {name: self.fit} if self.fit.verdict.fitted else {}
        others = {f"{name} estimate": self.responses[name] for name in list(self.responses)[1:]}
        drawings = [ft.partial(record_figure, record) for record in self.records]
        drawings += [ft.partial(bode, self.frf, others, models, title=self.title)]
        if self.check is not None:
            verified = Path(self.settings.verify or "").name
            drawings += [ft.partial(compare, self.check, title=verified)]
        silent = [headless()(draw) for draw in drawings]
        return dict(zip(self.figure_names, silent, strict=True))

    def write(self, folder: str | Path | None = None) -> Path:
        """Write `result.json`, `report.html` and the figures, by default to results/NAME.

        **Returns:** the path of `result.json`.
        """
        from ._stored import write_identification

        return write_identification(self, Path(folder or default_folder(self.path)))

    def __str__(self) -> str:
        return str(self.message())

    def message(self) -> Message:
        """What it prints, as a message that the command line puts into its own words."""
        from jaxquad.report import compare_fits  # here: with it come the templates of pages

        first, *others = map(str, self.records)
        record = "\n".join([first, *(f"and {text.splitlines()[1].strip()}" for text in others)])
        frf = dataclasses.replace(self.frf, remarks=())  # the fit repeats what concerns it
        parts = [f"{record}\n\n{frf}"]
        parts += [f"\n{self.filters_text}"] if self.filters_text else []
        parts += [f"\n{self.formula}, {self.method} estimate:\n{self.fit}"]
        sums, known = sums_of(self.settings), [each.name for each in self.fit.combinations]
        if self.settings.poles is not None and self.fit.verdict.fitted:
            parts += [_text_or_reason(lambda: factors(self.fit))]
        if self.settings.reference:
            parts += [f"\n{compare_fits(self.fits, sums)}"]
        elif self.fit.verdict.fitted:
            parts += [
                _text_or_reason(ft.partial(self._sum, name)) for name in sums if name not in known
            ]
        parts += _on_negative_gain(self.fit, self.frf)
        if self.parts:
            parts += [f"\nFits to parts of the band:\n{compare_fits(self.parts, sums)}"]
        parts += [f"\n{title}:\n{marked_text(text)}" for title, text in self.beside.items()]
        parts += [f"\n{self.check}"] if self.check else []
        return Message("\n".join(map(marked_text, parts)))


_HALVES, _EXPLAINED = "Lower and upper half of the band", "What explains the misfit"


def _on_negative_gain(fit: Fit, frf: FrequencyResponse) -> list[str]:
    """What to check where the output moves against the input; that is no fault of the fit."""
    above = [name == "gain" or name.startswith("numerator[") for name in fit.names]
    if not np.all(fit.determined[above] & (fit.values[above] < 0)):
        return []
    source, output = frf.input_names[0], frf.output_names[0]
    return [
        f"the gain is negative: when {source} rises, {output} falls. If it should rise, check the "
        f"signs of both channels and of the axis; jaxquad tune needs a positive gain "
        "(--input NAME=-CHANNEL)"
    ]


def _text_or_reason(made: Callable[[], object]) -> str:
    try:
        return str(made())
    except UndeterminedError as error:
        return marked_text(error)


def identify(
    path: str | Path | Sequence[str | Path],
    settings: IdentifySettings | None = None,
    *,
    proposal: Proposal | None = None,
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
    - `proposal`: what `propose_settings` returned beside these settings, if they are its.

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
    return identify_opened(open_logs(path, settings, proposal))


def identify_opened(opened: OpenedLogs) -> Identification:
    """Identify logs that are open, as `identify` does those of a path.

    **Arguments:**

    - `opened`: what `open_logs`, or `open_again` of a stored result, returned.
    """
    settings = opened.settings
    flown = flown_law(
        opened.paths, mix_of(settings.output), mix_of(settings.input), opened.proposal, settings
    )
    filters = () if flown is None or opened.settings.keep_gyro_filters else flown.filters
    found, delay = _identify(opened, compare=True, filters=filters, vehicle=flown is not None)
    found = dataclasses.replace(found, flown=flown)
    found = _with_fits_again(dataclasses.replace(found, check=_checked(found)))
    return _with_direct(found, delay) if found.settings.reference else found


def identify_fit(opened: OpenedLogs) -> Identification:
    """The estimate to trust and its fit alone, which are what a design needs.

    The gyro's filters are kept in the model: a loop is closed on the rate behind them.

    **Arguments:**

    - `opened`: what `open_logs`, or `open_again` of a stored result, returned.
    """
    settings = dataclasses.replace(opened.settings, keep_gyro_filters=True)
    return _identify(opened._replace(settings=settings))[0]


def identify_plant(
    path: Path, settings: IdentifySettings, proposal: Proposal, filters: Sequence[KnownFilter]
) -> Identification:
    """Likewise, up to what the `filters` of the output were given; its remedies are flights."""
    found, _ = _identify(open_logs(path, settings, proposal), filters=filters, vehicle=True)
    fits = {method: _with_remedy(each, EXCITE) for method, each in found.fits.items()}
    return dataclasses.replace(found, fits=fits)


def _with_remedy(found: Fit, remedy: str) -> Fit:
    """With this alone where something is not determined."""
    verdict = found.verdict
    if verdict.kind == "identifiable":
        return found
    verdict = dataclasses.replace(verdict, remedies=as_messages([remedy]))
    return dataclasses.replace(found, verdict=verdict)


def _identify(
    opened: OpenedLogs, *, compare: bool = False, filters: Sequence[KnownFilter] = (),
    vehicle: bool = False,
) -> tuple[Identification, float]:  # fmt: skip
    """The estimate to trust and its fit; the delay in s that is taken out, also to `compare`.

    The rate of a `vehicle` may be damped by the air.
    """
    (path, *more), settings, proposal, records = opened
    best, *others = ("joint", "direct") if settings.reference else ("direct",)
    methods = (best, *(others if compare else ()))
    estimated = fit_best(records, methods, settings, filters)
    fit = estimated.fit
    if vehicle and isinstance(fit.model, LaggedIntegrator) and settings.integrators:
        fit = fit_damped(fit)
    fit = with_units(with_remedies(fit, settings), records[0])
    announce("fits to parts of the band")
    fit, parts = fit_parts(fit, estimated.frf, settings)
    responses, fits = {best: estimated.frf}, {best: in_option_words(fit)}
    found = Identification(
        path, settings, records, responses, fits, parts, None, proposal, more=tuple(more)
    )
    return found, estimated.delay


def _with_direct(found: Identification, delay: float) -> Identification:
    """The direct estimate, with `delay` (s) taken out, beside the joint one, and the fit to it."""
    announce("fit to the direct response")
    try:
        response = respond(found.records, "direct", found.settings, found.filters, delay)
        fit = with_remedies(fit_response(response, found.settings), found.settings)
    except Exception as error:
        failures = {**found.failures, "The direct estimate": reason_of(error)}
        return dataclasses.replace(found, failures=failures)
    fit = in_option_words(with_units(fit, found.records[0]))
    responses, fits = {**found.responses, "direct": response}, {**found.fits, "direct": fit}
    return dataclasses.replace(found, responses=responses, fits=fits)


def _with_fits_again(found: Identification) -> Identification:
    """With the halves of the band, and the explanation of a misfit that was asked for."""
    fit, failures = found.fit, dict(found.failures)
    if not fit.verdict.fitted or fit.verdict.kind == "no minimum":
        return found
    wanted: dict[str, tuple[str, Callable[[], object]]] = {"bands": (_HALVES, fit.bands)}
    if found.settings.explain and fit.chi_squared > MISFIT**2:
        wanted["explanation"] = (_EXPLAINED, fit.explain)
    computed = {}
    for field, (title, compute) in wanted.items():
        try:
            computed[field] = compute()
        except Exception as error:
            failures[title] = reason_of(error)
    return dataclasses.replace(found, failures=failures, **computed)


def model_formula(settings: IdentifySettings, *, damped: bool = False) -> str:
    """The structure of the model, such as `q / M = K e^(-delay s) / (s (lag s + 1))`."""
    n = settings.integrators
    [output], [source] = mix_of(settings.output), mix_of(settings.input)
    if settings.poles is not None:
        kind = f"{settings.zeros} zeros over {settings.poles} poles and {n} integrators"
        return f"{output} / {source}, {kind}{', delayed' if settings.delay else ''}"
    pure = n - damped
    powers = [] if pure == 0 else ["s"] if pure == 1 else [f"s^{pure}"]
    powers += ["(s + damping)"] if damped else []
    below = powers + (["(lag s + 1)"] if settings.lag else [])
    above = "K e^(-delay s)" if settings.delay else "K"
    product = " ".join(below)
    ratio = f" / ({product})" if len(below) > 1 else f" / {product}" if below else ""
    return f"{output} / {source} = {above}{ratio}"


def _checked(found: Identification) -> Verification | None:
    """The second record simulated, within the band of the points that the fit used.

    Where gaps cut it into several, it is the longest of them.
    """
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
    records = read_records(Path(settings.verify), other)
    longest = max(records, key=lambda record: record.samples)
    return verify(found.fit, behind_filters(longest, found.filters))
