"""Results as files, where they come from, and why a part is missing, which costs no other part."""

import hashlib
import json
import platform
from collections.abc import Callable, Mapping
from datetime import datetime, UTC
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple, ParamSpec, TYPE_CHECKING, TypeVar

from jaxquad._core import is_ours, marked_text, Message, plain_content, write_file


if TYPE_CHECKING:
    from jaxquad.identify import Agreement, Fit, Verification
    from jaxquad.spectra import FrequencyResponse

Json = Mapping[str, object]


def write_json(path: str | Path, content: Json) -> Path:
    """Write a JSON file, whole or not at all.

    **Arguments:**

    - `path`: its folders are made as needed.
    - `content`: arrays included; numbers that are not finite become null.

    **Returns:** the path.

    **Raises:** TypeError for what JSON cannot hold.
    """
    return write_file(path, json.dumps(plain_content(content), indent=2, allow_nan=False) + "\n")


def write_results(
    folder: str | Path, *, fit: "Fit", frf: "FrequencyResponse | None" = None,
    check: "Verification | None" = None, extra: Json | None = None,
) -> Path:  # fmt: skip
    """Write `result.json` into a folder, whole or not at all.

    Numbers that are not finite are null: JSON has no nan. Parameters that the record does not
    determine keep their numbers, beside `"determined": false`; where nothing could be fitted there
    are none.

    **Arguments:**

    - `folder`: is made as needed.
    - `fit`, `frf`, `check`: the fit, the response that was fitted, the model simulated on a record.
    - `extra`: further keys.

    **Returns:** the path of the file.

    **Raises:** TypeError for an `extra` that JSON cannot hold.
    """
    content: dict[str, object] = {"jaxquad_version": _version("jaxquad"), "fit": fit.to_dict()}
    if frf is not None:
        content["response"] = {
            "method": frf.method,
            "inputs": frf.input_names,
            "outputs": frf.output_names,
            "input_units": frf.input_units,
            "output_units": frf.output_units,
            "omega_rad_per_s": frf.omega,
            "magnitude_db": frf.magnitude_db,
            "phase_deg": frf.phase_deg,
            "coherence": frf.coherence,
            "random_error": frf.random_error,
            "remarks": tuple(frf.remarks),
        }
    content |= {"verification": verification_content(check)} if check is not None else {}
    content |= dict(extra or {})
    return write_json(Path(folder) / "result.json", content)


def verification_content(check: "Verification") -> dict[str, object]:
    """The measures of a verification, for JSON."""

    def measures(agreement: "Verification | Agreement") -> dict[str, object]:
        names = ("rms", "tic", "fit_percent", "variance_percent")
        return {name: getattr(agreement, name) for name in names}

    return measures(check) | {
        "shift": check.shift,
        "bias": check.bias,
        "initial": check.initial,
        "band_rad_per_s": check.band,
        "output": check.output_name,
        "unit": check.output_unit,
        "agreement": check.verdict.kind,
        "method": check.method,
        "outputs": [{"name": x.name, "unit": x.unit} | measures(x) for x in check.outputs],
    }


_PACKAGES = ("jaxquad", "jax", "jaxlib", "numpy", "scipy", "equinox", "optimistix")


class Source(NamedTuple):
    """A file from which a result was made; a folder counts as all files in it."""

    name: str
    size: int  # bytes
    sha256: str


class Provenance(NamedTuple):
    """Where a result comes from: files, command, settings, versions and date."""

    files: tuple[Source, ...]
    command: str  # that makes the result again
    settings: dict[str, str]
    versions: dict[str, str]
    date: str  # ISO 8601, UTC

    def content(self) -> Mapping[str, object]:
        """For `result.json`, see `jaxquad.report.write_results`."""
        return self._asdict() | {"files": [file._asdict() for file in self.files]}


def provenance(
    *paths: str | Path, command: str = "", settings: Mapping[str, object] | None = None,
    date: datetime | None = None,
) -> Provenance:  # fmt: skip
    """Hash files, and note the installed versions and the time.

    **Arguments:**

    - `paths`: the files or folders that a result was made from.
    - `command`: the command line that makes the result again.
    - `settings`: further facts by name.
    - `date`: now by default.

    **Raises:** OSError for a file that cannot be read.
    """
    moment = (date or datetime.now(UTC)).astimezone(UTC)
    versions = {"python": platform.python_version()}
    versions |= {name: _version(name) or "not installed" for name in _PACKAGES}
    size_of = lambda path: sum(file.stat().st_size for file in _files(path))
    return Provenance(
        files=tuple(Source(x.name, size_of(x), sha256_of(x)) for x in map(Path, paths)),
        command=command,
        settings={name: str(value) for name, value in (settings or {}).items()},
        versions=versions,
        date=moment.isoformat(timespec="seconds"),
    )


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _files(path: Path) -> list[Path]:
    return sorted(x for x in path.rglob("*") if x.is_file()) if path.is_dir() else [path]


def sha256_of(path: str | Path) -> str:
    """The SHA-256 of a file, or of all files in a folder by the order of their names.

    **Raises:** OSError for a file that cannot be read.
    """
    digest = hashlib.sha256()
    for part in _files(Path(path)):
        with part.open("rb") as file:
            hashlib.file_digest(file, lambda: digest)
    return digest.hexdigest()


def provenance_section(origin: Provenance) -> dict[str, object]:
    """Files, command, versions and date, for a page."""
    versions = ", ".join(f"{name} {text}" for name, text in origin.versions.items())
    facts = origin.settings | {"versions": versions, "date": origin.date}
    return {"files": origin.files, "command": origin.command, "facts": facts}


Arguments = ParamSpec("Arguments")
Part = TypeVar("Part")
FAILED = "failed"  # key of the reason, in what templates show instead of a section


class PageWarning(UserWarning):
    """A part of a result could not be computed; the rest is written."""

    def __init__(self, reason: str):
        super().__init__(Message(reason))


def reason_of(error: Exception) -> Message:
    """Why something could not be computed: the text of our errors, with the kind of all others."""
    text = " ".join(marked_text(error).split())
    if text and is_ours(type(error)):
        return Message(text)
    return Message(f"{type(error).__name__}{f': {text}' if text else ''}")


def attempt(
    compute: Callable[Arguments, Part], *args: Arguments.args, **named: Arguments.kwargs
) -> Part | dict[str, str]:
    """What `compute` returns, or the reason why it raised, which the page shows in its place."""
    try:
        return compute(*args, **named)
    except Exception as error:
        return {FAILED: reason_of(error)}
