"""`result.json` as it is read again. Without JAX: a missing result is answered at once."""

import json
from collections.abc import Mapping, Sequence
from itertools import chain, count
from pathlib import Path
from typing import NamedTuple, TYPE_CHECKING

from ._settings import IdentifySettings


if TYPE_CHECKING:
    from jaxquad.models import LaggedIntegrator, TransferFunction


class StoredResult(NamedTuple):
    """A `result.json` as `read_result` reads it."""

    folder: Path
    content: Mapping[str, object]
    settings: IdentifySettings
    log: Path
    hashes: tuple[str, ...]  # SHA-256 of the log, and of the record of a check
    band: tuple[float, float]  # rad/s, that was fitted
    more: tuple[Path, ...] = ()  # logs that were taken together with the first

    @property
    def logs(self) -> list[Path]:
        """All logs that were identified together."""
        return [self.log, *self.more]

    @property
    def summary(self) -> str:
        """What the result says of its identifiability, in one line."""
        return str(_part(_part(self.content, "fit"), "verdict").get("summary", ""))

    @property
    def identifiable(self) -> bool:
        """Whether the record determines every parameter."""
        return _part(self.content, "fit").get("identifiable") is True

    @property
    def doubts(self) -> tuple[str, ...]:
        """The verdict and the remarks of a result that is not identifiable."""
        remarks = _part(self.content, "fit").get("remarks")
        if self.identifiable or not isinstance(remarks, list):
            return ()
        return self.summary, *map(str, remarks)

    @property
    def model(self) -> "LaggedIntegrator | TransferFunction":
        """The identified model. Raises UndeterminedError where nothing was fitted."""
        from jaxquad.identify import UndeterminedError
        from jaxquad.models import LaggedIntegrator, TransferFunction

        known = {each.__name__: each for each in (LaggedIntegrator, TransferFunction)}
        if "model" not in self.content:
            raise UndeterminedError(f"the result holds no model: {self.summary}")
        numbers = dict(_part(self.content, "model"))
        kind = numbers.pop("kind", None)
        if kind not in known:
            kinds = ", ".join(known)
            raise ValueError(f"the result holds a model of kind {kind!r}: known are {kinds}")
        try:
            return known[str(kind)](**numbers)  # pyright: ignore[reportArgumentType]
        except TypeError as error:
            raise ValueError(f"the result's model is incomplete: {error}") from error


def _part(content: Mapping[str, object], key: str) -> Mapping[str, object]:
    part = content.get(key)
    return part if isinstance(part, dict) else {}


def default_folder(log: Path) -> Path:
    """Where the result of a log goes if nothing else is said."""
    return Path("results") / log.stem


def free_folder(
    wanted: Path, name: str, same: Mapping[str, object], *, sources: Sequence[str | Path]
) -> Path:
    """The folder `wanted`, or `wanted-2`, `wanted-3`, ..., without a result of another origin.

    **Arguments:**

    - `wanted`: need not exist.
    - `name`: of the JSON file that holds a result, such as `result.json`.
    - `same`: what that file holds if the result is the same, made again, by key.
    - `sources`: the files that it is made from, in the order of its provenance.
    """
    numbered = (wanted.with_name(f"{wanted.name}-{number}") for number in count(2))
    return next(
        folder for folder in chain([wanted], numbered) if _is_free(folder / name, same, sources)
    )


def _is_free(path: Path, same: Mapping[str, object], sources: Sequence[str | Path]) -> bool:
    from jaxquad._core import plain_content
    from jaxquad.report import sha256_of

    if not path.exists():
        return True
    try:
        content = json.loads(path.read_text())
        hashes = [file["sha256"] for file in content["provenance"]["files"]]
    except (OSError, ValueError, KeyError, TypeError):
        return False
    wanted = {key: json.loads(json.dumps(plain_content(value))) for key, value in same.items()}
    return all(content.get(key) == value for key, value in wanted.items()) and hashes == [
        sha256_of(each) for each in sources
    ]


def read_result(path: str | Path) -> StoredResult:
    """Read the result in a folder, or a `result.json` itself.

    **Raises:** ValueError for a file that `jaxquad identify` did not write.
    """
    path = Path(path)
    path = path / "result.json" if path.is_dir() else path
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such result: run jaxquad identify first") from error
    except ValueError as error:
        raise ValueError(
            f"{path}: this is no result of jaxquad identify ({error}): run it first"
        ) from error
    try:
        content = dict(content)
        settings = IdentifySettings.from_mapping(content["settings"], f"{path}, settings")
        files = content["provenance"]["files"]
        return StoredResult(
            folder=path.parent,
            content=content,
            settings=settings,
            log=Path(content["record"]["file"]),
            hashes=tuple(file["sha256"] for file in files),
            band=(float(content["band_rad_per_s"][0]), float(content["band_rad_per_s"][1])),
            more=tuple(map(Path, content["record"].get("more_files", ()))),
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: this is no result of this version of jaxquad: run jaxquad identify again"
        ) from error
