"""What an identification leaves on the disk, and how it is made again from that."""

import dataclasses
import shlex
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxquad._core import announce, marked_text
from jaxquad.identify import behind_filters, Fit, Verification, verify
from jaxquad.records import (
    clock_start,
    read,
    Record,
    RecordError,
    RecordWarning,
    show_times,
)
from jaxquad.report import LawLoop, PageWarning, provenance, reason_of, write_results

from ._identify import Identification, identify_opened
from ._log import open_again, read_records
from ._result_file import load_result, StoredResult
from ._settings import IdentifySettings


def write_identification(found: Identification, folder: Path) -> Path:
    """Write `result.json`, `report.html` and the figures; returns the path of `result.json`."""
    announce("figures and report")
    spans = [[float(record.time[0]), float(record.time[-1])] for record in found.records]
    command = identify_command(found.paths, found.settings)
    sources = [*found.paths, *([found.settings.verify] if found.settings.verify else [])]
    origin = provenance(*sources, command=command)
    extra = {
        "record": {
            "file": str(found.path),
            "more_files": [str(path) for path in found.more],
            "start_s": min(start for start, _ in spans),
            "stop_s": max(stop for _, stop in spans),
            "segments_s": spans,
            "sample_rate_hz": found.records[0].sample_rate,
            "largest_command": found.largest_command,
        },
        "settings": found.settings.content(),
        "band_rad_per_s": found.band,
        "band_hz": [omega / (2 * np.pi) for omega in found.band],
        "used_band_rad_per_s": found.fit.used_band,
        "derived": [each.content() for each in found.combinations],
        "provenance": origin.content(),
        **({"gyro_filters": found.flown.content()} if found.flown and found.filters else {}),
        **_content_beside(found),
        **_model_content(found),
    }
    path = write_results(folder, fit=found.fit, frf=found.frf, check=found.check, extra=extra)
    from jaxquad.report import write_report  # here: with it comes matplotlib

    others = {f"{name} estimate": found.responses[name] for name in list(found.responses)[1:]}
    write_report(
        folder / "report.html",
        fit=found.fit,
        frf=found.frf,
        others=others,
        record={_record_title(found, record): record for record in found.records},
        spectrum=_with_throttle(found),
        checks={} if found.check is None else {Path(sources[-1]).name: found.check},
        derived=found.combinations,
        provenance=origin,
        filters=found.filters,
        law=_law_if_any(found),
        formula="; ".join(filter(None, (found.formula, found.filters_text))),
        beside=found.beside,
    )
    _write_figures(found, folder)
    return path


def _law_if_any(found: Identification) -> LawLoop | None:
    from jaxquad.autopilot import loop_of_law

    try:
        [unit] = found.records[0].output_units
        return loop_of_law(found.flown, found.fit, found.frf, found.filters, unit)
    except Exception as error:  # the record shows its loop without the law, too
        warnings.warn(
            f"the loop by its law is missing: {marked_text(reason_of(error))}", PageWarning, 2
        )
        return None


def _with_throttle(found: Identification) -> Record | None:
    """The first record with the throttle that the log's proposal names; None without one."""
    proposal, first = found.proposal, found.records[0]
    if proposal is None or not proposal.setup.throttle:
        return None
    options = proposal.options_with_throttle
    options |= {"start": float(first.time[0]), "stop": float(first.time[-1])}
    options |= {"sample_rate": first.sample_rate, "max_gap": found.settings.max_gap}
    try:
        with warnings.catch_warnings():  # the record has said what was repaired
            warnings.simplefilter("ignore", RecordWarning)
            return read(found.path, **options)
    except RecordError as error:
        announce(f"no spectrum over the throttle: {error}")
        return None


def _record_title(found: Identification, record: Record) -> str:
    start = clock_start(record.time)
    span = f"t = {show_times(record.time[0], record.time[-1], start=start)}"
    return f"{Path(record.source).name}, {span}" if found.more else span


def _write_figures(found: Identification, folder: Path) -> None:
    """Those that can be drawn; a `PageWarning` for each other one, of which no file is left."""
    for earlier in (folder / "verification.png", *folder.glob("record_*.png")):
        if earlier.name not in found.figure_names:
            earlier.unlink(missing_ok=True)
    for name, draw in found.drawings().items():
        try:
            draw().figure.savefig(folder / name, dpi=130)
        except OSError:
            raise
        except Exception as error:
            (folder / name).unlink(missing_ok=True)
            warnings.warn(
                f"{name} could not be drawn: {marked_text(reason_of(error))}", PageWarning, 2
            )


def _content_beside(found: Identification) -> dict[str, object]:
    """The halves of the band, and what explains the misfit."""
    content: dict[str, object] = {}
    if found.bands is not None:
        halves = {"lower": found.bands.lower, "upper": found.bands.upper}
        content["half_bands"] = {"split_rad_per_s": found.bands.split} | {
            name: None if half is None else _intervals(half) for name, half in halves.items()
        }
    if found.explanation is not None:
        tried = [
            {"term": each.title, "factor": each.formula, "bic_lower_by": each.gain}
            for each in found.explanation.candidates
        ]
        content["explanation"] = {"summary": found.explanation.summary, "tried": tried}
    return content


def _intervals(fit: Fit) -> list[dict[str, object]]:
    if not fit.verdict.fitted:
        return []
    return [
        {
            "name": name,
            "value": fit.values[k],
            "interval_95": fit.interval(name),
            "determined": bool(fit.determined[k]),
        }
        for k, name in enumerate(fit.names)
    ]


def _model_content(found: Identification) -> dict[str, object]:
    """The model's kind and numbers; nothing where nothing was fitted."""
    if not found.fit.verdict.fitted:
        return {}
    numbers = vars(found.fit.model).items()
    plain = {k: v if isinstance(v, int) else np.asarray(v).tolist() for k, v in numbers}
    return {"model": {"kind": type(found.fit.model).__name__} | plain}


def identify_command(paths: Sequence[Path], settings: IdentifySettings) -> str:
    """The command line that makes the result again, quoted for a shell."""
    return shlex.join(["jaxquad", "identify", *map(str, paths), *settings.words()])


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


def verify_result(
    result: str | Path | StoredResult,
    path: str | Path,
    changes: Mapping[str, object] | None = None,
) -> Verification:
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
    whole = {"start": None, "stop": None, "segments": (), "reference": None}
    settings = dataclasses.replace(stored.settings, **whole, band=None, band_rad=stored.band)
    changed = settings.changed(changes or {})
    model, band = stored.model, stored.used_band
    if changed.band_rad != stored.band:
        band = changed.band_rad
    if changed.band is not None:
        band = 2 * np.pi * changed.band[0], 2 * np.pi * changed.band[1]
    longest = max(read_records(Path(path), changed), key=lambda record: record.samples)
    return verify(model, behind_filters(longest, stored.filters), band=band)
