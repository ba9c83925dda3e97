"""An identified log: its parameters and responses as text, figures, a page and a result file."""

import dataclasses
import functools as ft
import shlex
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Array, Float

from jaxquad._core import announce, marked_text, Message, staged_files
from jaxquad.identify import (
    Bands,
    Combination,
    Explanation,
    factors,
    Fit,
    KnownFilter,
    UndeterminedError,
    Verification,
)
from jaxquad.models import LaggedIntegrator
from jaxquad.records import (
    clock_start,
    Proposal,
    read,
    Record,
    RecordError,
    RecordWarning,
    show_times,
)
from jaxquad.report import LawLoop, PageWarning, provenance, reason_of, write_results
from jaxquad.spectra import FrequencyResponse

from ._log import mix_of
from ._result_file import default_folder
from ._settings import IdentifySettings


if TYPE_CHECKING:
    from jaxquad.autopilot import FlownLaw
    from jaxquad.plot import Panels


_FIGURES = ("record.png", "bode.png", "verification.png")
HALVES, EXPLAINED = "Lower and upper half of the band", "What explains the misfit"


@dataclasses.dataclass(frozen=True)
class Identification:
    """One identified log, as `identify` returns it; `str()` is its report as text.

    **Attributes:**

    - `paths`: the log, or all that were taken together.
    - `settings`: those that were used, a proposal included.
    - `records`: one for each segment of each log.
    - `responses`: the frequency response by method, the one to trust first.
    - `fits`: the fit to each of them.
    - `parts`: where the misfit is large, the fit beside those to the upper and to the lower part of
      the band; None for one that diverged.
    - `flown`: the gyro's filters and the law of an autopilot's log, up to whose filters the model
      is, unless `settings.keep_gyro_filters`.
    - `check`: the second record simulated, where `settings.verify` names one.
    - `bands`: the same parameters from the lower and the upper half of the band.
    - `explanation`: which further term the response wants, where `settings.explain` asks for it.
    - `failures`: by title, why something beside the fit could not be computed.
    """

    paths: tuple[Path, ...]
    settings: IdentifySettings
    records: tuple[Record, ...]
    responses: Mapping[str, FrequencyResponse]
    fits: Mapping[str, Fit]
    parts: Mapping[str, Fit | None]
    proposal: Proposal | None = None
    flown: "FlownLaw | None" = None
    check: Verification | None = None
    bands: Bands | None = None
    explanation: Explanation | None = None
    failures: Mapping[str, Message] = dataclasses.field(default_factory=dict)

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
        """The structure of the model, such as `q / M = K e^(-delay s) / (s (lag s + 1))`."""
        settings, n = self.settings, self.settings.integrators
        [output], [source] = mix_of(settings.output), mix_of(settings.input)
        if settings.poles is not None:
            kind = f"{settings.zeros} zeros over {settings.poles} poles and {n} integrators"
            return f"{output} / {source}, {kind}{', delayed' if settings.delay else ''}"
        damped = "damping" in self.fit.names
        pure = n - damped
        below = [] if pure == 0 else ["s"] if pure == 1 else [f"s^{pure}"]
        below += ["(s + damping)"] if damped else []
        below += ["(lag s + 1)"] if settings.lag else []
        above, product = "K e^(-delay s)" if settings.delay else "K", " ".join(below)
        ratio = f" / ({product})" if len(below) > 1 else f" / {product}" if below else ""
        return f"{output} / {source} = {above}{ratio}"

    @property
    def sums(self) -> Mapping[str, Callable[[LaggedIntegrator], Float[Array, ""]]]:
        """What is shown beside the parameters, in s: a sum is better determined than its terms."""
        settings = self.settings
        both = settings.poles is None and settings.lag and settings.delay
        return {"lag + delay": _total_delay} if both else {}

    @ft.cached_property
    def combinations(self) -> tuple[Combination, ...]:
        """The sum of lag and delay, where the record determines it."""
        try:
            return tuple(map(self._sum, self.sums))
        except UndeterminedError:
            return ()

    def _sum(self, name: str) -> Combination:
        return self.fit.derived(self.sums[name], name)._replace(unit="s")

    @property
    def supplements(self) -> dict[str, str]:
        """What goes with the fit as text, by title: halves of the band, what explains a misfit."""
        texts = {HALVES: self.bands, EXPLAINED: self.explanation}
        return {title: str(text) for title, text in texts.items() if text is not None} | {
            title: Message(f"could not be computed: {why.marked}")
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
        drawings = [ft.partial(record_figure, record) for record in self.records]
        first, *more = self.paths
        title = f"{first.name} and {len(more)} more" if more else first.name
        drawings += [ft.partial(bode, self.frf, self._other_responses, models, title=title)]
        if self.check is not None:
            verified = Path(self.settings.verify or "").name
            drawings += [ft.partial(compare, self.check, title=verified)]
        silent = [headless()(draw) for draw in drawings]
        return dict(zip(self.figure_names, silent, strict=True))

    @property
    def _other_responses(self) -> dict[str, FrequencyResponse]:
        return {f"{name} estimate": self.responses[name] for name in list(self.responses)[1:]}

    def __str__(self) -> str:
        return str(self.message())

    def message(self) -> Message:
        """What it prints, as a message that the command line puts into its own words."""
        from jaxquad.report import compare_fits  # here: with it come the templates of pages

        def text_or_reason(compute: Callable[[], object]) -> str:
            try:
                return str(compute())
            except UndeterminedError as error:
                return marked_text(error)

        fit, (first, *others) = self.fit, map(str, self.records)
        record = "\n".join([first, *(f"and {text.splitlines()[1].strip()}" for text in others)])
        frf = dataclasses.replace(self.frf, remarks=())  # the fit repeats what concerns it
        parts = [f"{record}\n\n{frf}"]
        parts += [f"\n{self.filters_text}"] if self.filters_text else []
        parts += [f"\n{self.formula}, {self.method} estimate:\n{fit}"]
        if self.settings.poles is not None and fit.verdict.fitted:
            parts += [text_or_reason(lambda: factors(fit))]
        if self.settings.reference:
            parts += [f"\n{compare_fits(self.fits, self.sums)}"]
        elif fit.verdict.fitted:
            shown = [combination.name for combination in fit.combinations]
            sums = [name for name in self.sums if name not in shown]
            parts += [text_or_reason(ft.partial(self._sum, name)) for name in sums]
        parts += _on_negative_gain(fit, self.frf)
        if self.parts:
            parts += [f"\nFits to parts of the band:\n{compare_fits(self.parts, self.sums)}"]
        parts += [f"\n{title}:\n{marked_text(x)}" for title, x in self.supplements.items()]
        parts += [f"\n{self.check}"] if self.check else []
        return Message("\n".join(parts))

    def write(self, folder: str | Path | None = None) -> Path:
        """Write `result.json`, `report.html` and the figures, by default to results/NAME.

        **Returns:** the path of `result.json`.
        """
        announce("figures and report")
        settings, fit, several = self.settings, self.fit, len(self.paths) > 1
        folder = Path(folder or default_folder(self.paths[0]))
        sources = [*self.paths, *([settings.verify] if settings.verify else [])]
        command = shlex.join(["jaxquad", "identify", *map(str, self.paths), *settings.words()])
        origin = provenance(*sources, command=command)
        extra = self._content() | {"provenance": origin.content()}
        if self.flown and self.filters:
            extra["gyro_filters"] = self.flown.content()
        extra |= self._content_of_supplements()
        if fit.verdict.fitted:
            numbers = vars(fit.model).items()
            plain = {k: v if isinstance(v, int) else np.asarray(v).tolist() for k, v in numbers}
            extra["model"] = {"kind": type(fit.model).__name__} | plain
        from jaxquad.report import write_report  # here: with it comes matplotlib

        def title(record: Record) -> str:
            start = clock_start(record.time)
            span = f"t = {show_times(record.time[0], record.time[-1], start=start)}"
            return f"{Path(record.source).name}, {span}" if several else span

        drawn = []
        with staged_files(folder) as draft:
            path = write_results(draft, fit=fit, frf=self.frf, check=self.check, extra=extra)
            write_report(
                draft / "report.html", fit=fit, frf=self.frf, others=self._other_responses,
                record={title(record): record for record in self.records},
                spectrum=self._record_with_throttle(),
                checks={} if self.check is None else {Path(sources[-1]).name: self.check},
                derived=self.combinations, provenance=origin, filters=self.filters,
                law=self._law_if_any(), texts=self.supplements,
                formula="; ".join(filter(None, (self.formula, self.filters_text))),
            )  # fmt: skip
            for name, draw in self.drawings().items():
                try:
                    draw().figure.savefig(draft / name, dpi=130)
                    drawn.append(name)
                except OSError:
                    raise
                except Exception as error:  # costs no other figure, and leaves no earlier one
                    (draft / name).unlink(missing_ok=True)
                    text = f"{name} could not be drawn: {reason_of(error).marked}"
                    warnings.warn(text, PageWarning, stacklevel=2)
        for earlier in (*folder.glob("record_*.png"), *map(folder.joinpath, _FIGURES)):
            if earlier.name not in drawn:
                earlier.unlink(missing_ok=True)
        return folder / path.name

    def _content(self) -> dict[str, object]:
        spans = [[float(record.time[0]), float(record.time[-1])] for record in self.records]
        return {
            "record": {
                "file": str(self.paths[0]),
                "more_files": [str(path) for path in self.paths[1:]],
                "start_s": min(start for start, _ in spans),
                "stop_s": max(stop for _, stop in spans),
                "segments_s": spans,
                "sample_rate_hz": self.records[0].sample_rate,
                "largest_command": self.largest_command,
            },
            "settings": self.settings.content(),
            "band_rad_per_s": self.band,
            "band_hz": [omega / (2 * np.pi) for omega in self.band],
            "used_band_rad_per_s": self.fit.used_band,
            "derived": [combination.content() for combination in self.combinations],
        }

    def _content_of_supplements(self) -> dict[str, object]:
        content: dict[str, object] = {}
        if self.bands is not None:
            halves = {"lower": self.bands.lower, "upper": self.bands.upper}
            rows = lambda fit: [
                {"name": name, "value": value, "interval_95": fit.interval(name)}
                | {"determined": bool(determined)}
                for name, value, determined in zip(
                    fit.names, fit.values, fit.determined, strict=False
                )
                if fit.verdict.fitted
            ]
            content["half_bands"] = {"split_rad_per_s": self.bands.split} | {
                name: None if half is None else rows(half) for name, half in halves.items()
            }
        if self.explanation is not None:
            tried = [
                {"term": x.title, "factor": x.formula, "bic_lower_by": x.gain}
                for x in self.explanation.candidates
            ]
            content["explanation"] = {"summary": self.explanation.summary, "tried": tried}
        return content

    def _record_with_throttle(self) -> Record | None:
        """The first record with the throttle that the log's proposal names; None without one."""
        proposal, first = self.proposal, self.records[0]
        if proposal is None or not proposal.setup.throttle:
            return None
        options = proposal.options_with_throttle
        options |= {"start": float(first.time[0]), "stop": float(first.time[-1])}
        options |= {"sample_rate": first.sample_rate, "max_gap": self.settings.max_gap}
        try:
            with warnings.catch_warnings():  # the record has said what was repaired
                warnings.simplefilter("ignore", RecordWarning)
                return read(self.paths[0], **options)
        except RecordError as error:
            announce(f"no spectrum over the throttle: {error}")
            return None

    def _law_if_any(self) -> LawLoop | None:
        if self.flown is None:
            return None
        from jaxquad.autopilot import loop_of_law

        try:
            [unit] = self.records[0].output_units
            return loop_of_law(self.flown, self.fit, self.frf, self.filters, unit)
        except Exception as error:  # the record shows its loop without the law, too
            text = f"the loop by its law is missing: {reason_of(error).marked}"
            warnings.warn(text, PageWarning, stacklevel=2)
            return None


def _total_delay(model: LaggedIntegrator) -> Float[Array, ""]:
    return model.lag + model.delay


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
