"""The sections of a page that show a response and its record in figures."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from jaxquad.identify import Fit, KnownFilter
from jaxquad.models import Model
from jaxquad.records import Record
from jaxquad.spectra import FrequencyResponse

from ._attempt import attempt
from ._loop import LawLoop, loop_section
from ._record import record_section
from ._response import response_section
from ._spectrum import spectrum_section
from ._step import step_section


class Shown(NamedTuple):
    """What is drawn of a fit, by name; `spectrum` is the record whose spectrum is.

    `filters` are those of the outputs that are divided out of responses and models; `law` is the
    loop where the log tells the controller.
    """

    fit: Fit
    frfs: Mapping[str, FrequencyResponse]
    models: Mapping[str, Model]
    others: Mapping[str, FrequencyResponse]
    records: Mapping[str, Record]
    spectrum: Record | None
    filters: Sequence[KnownFilter] = ()
    law: LawLoop | None = None

    @property
    def first(self) -> FrequencyResponse:
        """The first of the responses that were fitted."""
        return next(iter(self.frfs.values()))

    @property
    def flown(self) -> Record | None:
        """The first record with the channels of that response."""
        channels = {*self.first.input_names, *self.first.output_names}
        return next((each for each in self.records.values() if channels <= {*each.names}), None)

    def draw(self) -> dict[str, object]:
        """Each section, by its name."""
        first, flown = self.first, self.flown
        sections: dict[str, object] = {
            "response": attempt(response_section, self.frfs, self.models, self.others)
        }
        step = None if self.law is None else self.law.step
        if flown is not None:
            sections["step"] = attempt(step_section, self.fit, first, flown, self.filters, step)
            sections["loop"] = attempt(loop_section, first, flown, self.law)
        if (record := flown if self.spectrum is None else self.spectrum) is not None:
            sections["spectrum"] = attempt(spectrum_section, first, record)
        if self.records:
            sections["record"] = attempt(record_section, self.records)
        return sections


def shown_of(
    fit: Fit,
    frf: FrequencyResponse | Mapping[str, FrequencyResponse],
    models: Mapping[str, Model] | None = None,
    others: Mapping[str, FrequencyResponse] | None = None,
    record: Record | Mapping[str, Record] | None = None,
    spectrum: Record | None = None,
    filters: Sequence[KnownFilter] = (),
    law: LawLoop | None = None,
) -> Shown:
    """What `write_report` was given, by name. Raises ValueError as that does."""
    frfs = {"response": frf} if isinstance(frf, FrequencyResponse) else dict(frf)
    if not frfs:
        raise ValueError("frf is empty: give the response that was fitted, or several by name")
    records = {"record": record} if isinstance(record, Record) else dict(record or {})
    drawn = _models(fit, frfs, models or {})
    return Shown(fit, frfs, drawn, others or {}, records, spectrum, tuple(filters), law)


def _models(
    fit: Fit, frfs: Mapping[str, FrequencyResponse], models: Mapping[str, Model]
) -> dict[str, Model]:
    unknown = [name for name in models if name not in frfs]
    if unknown:
        raise ValueError(f"models of no response: {unknown}; the responses are {list(frfs)}")
    if not fit.verdict.fitted:
        return dict(models)
    return {name: models.get(name, fit.model) for name in frfs}
