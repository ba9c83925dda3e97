"""Stored results as they are read again. Without JAX: a missing result is answered at once."""

import json
import os
import shlex
from collections.abc import Mapping, Sequence
from itertools import chain, count
from pathlib import Path
from typing import Any, NamedTuple, TYPE_CHECKING

import numpy as np

from jaxquad.records.firmware import axis_of_rate

from ._settings import IdentifySettings, TuneSettings


if TYPE_CHECKING:
    from jaxquad.autopilot import StoredFilters
    from jaxquad.control import ScheduledLADRC
    from jaxquad.models import LaggedIntegrator, TransferFunction
    from jaxquad.spectra import FrequencyResponse


class StoredResult(NamedTuple):
    """What `jaxquad identify` has stored, as `jq.load_result` reads it.

    `content` is all of `result.json`.
    """

    folder: Path
    content: Mapping[str, object]
    settings: IdentifySettings
    logs: tuple[Path, ...]  # that were identified together
    hashes: tuple[str, ...]  # SHA-256 of the logs, and of the record of a check
    band: tuple[float, float]  # rad/s, of the response

    @property
    def _fit(self) -> Mapping[str, Any]:
        return _part(self.content, "fit")

    @property
    def summary(self) -> str:
        """What the result says of its identifiability, in one line."""
        return str(_part(self._fit, "verdict").get("summary", ""))

    @property
    def identifiable(self) -> bool:
        """Whether the record determines every parameter."""
        return self._fit.get("identifiable") is True

    @property
    def used_band(self) -> tuple[float, float]:
        """The lowest and the highest frequency that the fit used, in rad/s."""
        used = self.content.get("used_band_rad_per_s")
        if not isinstance(used, list):  # a result of an earlier version
            return self.band
        low, high = map(float, used)
        return low, high

    @property
    def values(self) -> dict[str, float]:
        """The parameters by name, also of those that the record does not determine."""
        return {name: _number(one["value"]) for name, one in self._parameters.items()}

    @property
    def standard_errors(self) -> dict[str, float]:
        """Of the parameters, by name; infinite where the record determines nothing."""
        errors = {name: one["standard_error"] for name, one in self._parameters.items()}
        return {name: np.inf if x is None else float(x) for name, x in errors.items()}

    @property
    def intervals(self) -> dict[str, tuple[float, float]]:
        """The 95 % intervals of the parameters, by name."""
        pairs = {name: one["interval_95"] for name, one in self._parameters.items()}
        return {name: (_number(low), _number(high)) for name, (low, high) in pairs.items()}

    @property
    def _parameters(self) -> dict[str, dict[str, Any]]:
        rows = self._fit.get("parameters")
        return {row["name"]: row for row in rows} if isinstance(rows, list) else {}

    @property
    def frf(self) -> "FrequencyResponse":
        """The response that was fitted; its errors count as independent between frequencies."""
        import jax.numpy as jnp

        from jaxquad.spectra import FrequencyResponse, independent_errors

        content = _part(self.content, "response")
        array = lambda name: np.array(content[name], float)  # null becomes nan
        omega, error = array("omega_rad_per_s"), array("random_error")
        size, coherence = 10 ** (array("magnitude_db") / 20), array("coherence")
        response = size * np.exp(1j * np.radians(array("phase_deg")))
        error = np.where(np.isfinite(error), error, np.inf)
        return FrequencyResponse(
            omega=jnp.asarray(omega), response=jnp.asarray(response),
            coherence=jnp.asarray(coherence), random_error=jnp.asarray(error),
            errors=independent_errors(omega, 2 * (error * size) ** 2),
            direct_coherence=jnp.asarray(coherence),
            multiple_coherence=jnp.asarray(np.max(coherence, axis=2)), method=content["method"],
            input_names=tuple(content["inputs"]), output_names=tuple(content["outputs"]),
            input_units=tuple(content.get("input_units", ())),
            output_units=tuple(content.get("output_units", ())),
        )  # fmt: skip

    def require_radians(self) -> None:
        """As the function of this name, for the output by the stored settings and response."""
        response = _part(self.content, "response")
        names, units = response.get("outputs", ()), response.get("output_units", ())
        for name, unit in zip(names, units, strict=False):  # an earlier version stored no units
            require_radians(name, self.settings.units.get(name, unit))

    @property
    def tuned(self) -> "StoredTuning | None":
        """What `jaxquad tune` has stored for this result, in its folder or in `tuned/` there."""
        folders = (self.folder / "tuned", self.folder)
        folder = next((x for x in folders if (x / "tuned.json").exists()), None)
        return None if folder is None else load_tuning(folder)

    def __str__(self) -> str:
        lines = [f"{self.logs[0].name}: {self.summary}"]
        lines += [
            f"  {name} = {value:.5g} +- {self.standard_errors[name]:.2g}"
            for name, value in self.values.items()
        ]
        return "\n".join([*lines, "  (+- one standard error)"] if lines[1:] else lines)

    @property
    def filters(self) -> "tuple[StoredFilters, ...]":
        """Those of the gyro up to whose input the model is, see `jq.identify.behind_filters`."""
        from jaxquad.autopilot import StoredFilters

        stored = self.content.get("gyro_filters")
        return () if stored is None else (StoredFilters.of(_part(self.content, "gyro_filters")),)

    @property
    def doubts(self) -> tuple[str, ...]:
        """The verdict and the remarks of a result that is not identifiable."""
        remarks = self._fit.get("remarks")
        if self.identifiable or not isinstance(remarks, list):
            return ()
        return self.summary, *map(str, remarks)

    @property
    def model(self) -> "LaggedIntegrator | TransferFunction":
        """The identified model. Raises UndeterminedError where nothing was fitted."""
        from jaxquad.identify import UndeterminedError
        from jaxquad.models import LaggedIntegrator, TransferFunction

        models = {model.__name__: model for model in (LaggedIntegrator, TransferFunction)}
        if "model" not in self.content:
            raise UndeterminedError(f"the result holds no model: {self.summary}")
        numbers = dict(_part(self.content, "model"))
        kind = numbers.pop("kind", None)
        if kind not in models:
            kinds = ", ".join(models)
            raise ValueError(f"the result holds a model of kind {kind!r}: known are {kinds}")
        try:
            return models[str(kind)](**numbers)  # pyright: ignore[reportArgumentType]
        except TypeError as error:
            raise ValueError(f"the result's model is incomplete: {error}") from error


class StoredTuning(NamedTuple):
    """What `jaxquad tune` has stored, as `jq.workflows.load_tuning` reads it.

    `content` is all of `tuned.json`.
    """

    folder: Path
    content: Mapping[str, object]
    settings: TuneSettings

    @property
    def holds(self) -> bool:
        """Whether all three verdicts hold: only then the gains may be flown."""
        return self.content["holds"] is True

    @property
    def values(self) -> dict[str, float]:
        """The tuned numbers by name."""
        return {name: _number(value) for name, value in _part(self.content, "values").items()}

    @property
    def controller(self) -> "ScheduledLADRC":
        """The tuned controller, as it was certified."""
        import jax
        import jax.numpy as jnp

        from jaxquad.control import certainty_equivalence, LADRC, ScheduledLADRC

        content = _part(self.content, "controller")
        numbers, dt = content["numbers"], float(content["dt"])
        start = LADRC(1.0, 3.0, 1.0, limit=1.0, dt=dt)
        template = ScheduledLADRC(start, certainty_equivalence(1.0, 1.0))
        stored = lambda path, x: jnp.asarray(numbers[jax.tree_util.keystr(path)[1:]], x.dtype)
        return jax.tree_util.tree_map_with_path(stored, template)

    def __str__(self) -> str:
        verdicts = self.content["verdicts"]
        assert isinstance(verdicts, list)
        words = {True: "OK  ", False: "FAIL", None: "--  "}
        lines = [f"{words[x['holds']]} {x['name']}: {x['text']}" for x in verdicts]
        gains = ", ".join(f"{name} {value:.4g}" for name, value in self.values.items())
        return "\n".join([*lines, f"tuned: {gains}"])


def require_radians(name: str, unit: str) -> None:
    """Raise ValueError for an output that gains for an angle are not for, before a fit is made."""
    if unit in ("rad", "rad/s"):
        return
    options = f"(--unit {name}=rad/s)"
    if unit in ("deg", "deg/s"):
        radians = unit.replace("deg", "rad")
        options = f"(--output angle=0.017453293*{name} --unit angle={radians})"
    by_identification = f"identify with the output in rad/s or rad {options}"
    if axis_of_rate(name) is not None:
        advice = (
            "for the gains of this firmware run jaxquad autopilot on the log; for a controller "
        )
        advice += f"of your own, {by_identification}"
    else:
        advice = f"{by_identification}; an autopilot's own gains come from jaxquad autopilot"
    raise ValueError(
        f"the unit of {name} is {unit or 'not known'}, but gains are for an angle in rad: {advice}"
    )


def _number(value: object) -> float:
    """JSON has no nan: it is null there."""
    return float(value) if isinstance(value, int | float) else np.nan


def load_tuning(path: str | Path) -> StoredTuning:
    """Read gains that `jaxquad tune` has stored, from their folder or `tuned.json` itself.

    `jq.load_result(folder).tuned` has those of a result.

    **Raises:** ValueError for a file that `jaxquad tune` did not write.
    """
    path = Path(path)
    path = path / "tuned.json" if path.is_dir() else path
    try:
        content = dict(read_json(path))
        settings = TuneSettings.from_mapping(content["settings"], f"{path}, settings")
        if not {"holds", "verdicts", "values", "controller"} <= content.keys():
            raise KeyError("gains or verdicts")
        return StoredTuning(path.parent, content, settings)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such result: run jaxquad tune first") from error
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        text = f"{path}: no result of this version of jaxquad tune: tune again"
        raise ValueError(text) from error


def read_json(path: Path) -> Any:
    """What a file holds. Raises OSError, and ValueError where that is no JSON."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _part(content: Mapping[str, object], key: str) -> Mapping[str, Any]:
    part = content.get(key)
    return part if isinstance(part, dict) else {}


def default_folder(log: Path) -> Path:
    """Where the result of a log goes if nothing else is said."""
    return Path("results") / log.stem


def free_folder(
    wanted: Path, name: str, same: Mapping[str, object], *, sources: Sequence[str | Path]
) -> Path:
    """The folder `wanted`, or `wanted-2`, `wanted-3`, ..., without a result of another origin.

    The JSON file of that `name` (`result.json`) holds what is the `same`, by key, if the result is
    the same, made again, of the same `sources`.
    """
    from jaxquad._core import plain_content
    from jaxquad.report import sha256_of

    def is_free(path: Path) -> bool:
        if not path.exists():
            return True
        try:
            content = read_json(path)
            hashes = [file["sha256"] for file in content["provenance"]["files"]]
        except (OSError, ValueError, KeyError, TypeError):
            return False
        plain = {key: json.loads(json.dumps(plain_content(x))) for key, x in same.items()}
        alike = all(content.get(key) == value for key, value in plain.items())
        return alike and hashes == [sha256_of(source) for source in sources]

    numbered = (wanted.with_name(f"{wanted.name}-{number}") for number in count(2))
    return next(folder for folder in chain([wanted], numbered) if is_free(folder / name))


def load_result(path: str | Path) -> StoredResult:
    """Read what `jaxquad identify`, and `jaxquad tune` after it, have stored, back as objects.

    !!! example

        ```python
        result = jq.load_result("results/flight")
        print(result, result.settings.band, result.tuned)
        jq.plot.bode(result.frf, {"identified": result.model})
        ```

    **Arguments:**

    - `path`: the folder of a result, or its `result.json`; also the folder of its gains, `tuned/`.

    **Returns:** a `jq.workflows.StoredResult`: `model`, `values`, `standard_errors`, `intervals`,
    `frf`, `settings`, and `tuned`, whose `controller` has the gains.

    **Raises:** ValueError for a file that `jaxquad identify` did not write.
    """
    path = Path(path)
    if path.is_dir():
        result = path / "result.json"
        of_gains = path.name == "tuned" and not result.exists()
        path = path.parent / "result.json" if of_gains else result
    try:
        content = read_json(path)
    except FileNotFoundError as error:
        raise ValueError(f"{path}: no such result: run jaxquad identify first") from error
    except ValueError as error:
        raise ValueError(
            f"{path}: this is no result of jaxquad identify: give its folder. A log is identified "
            f"first: jaxquad identify {shlex.quote(str(path))}"
        ) from error
    try:
        content = dict(content)
        settings = IdentifySettings.from_mapping(content["settings"], f"{path}, settings")
        files, record = content["provenance"]["files"], content["record"]
        names = [record["file"], *record.get("more_files", ())]
        names = [name.encode("utf-8", "replace") for name in names]  # for any system's letters
        return StoredResult(
            folder=path.parent,
            content=content,
            settings=settings,
            logs=tuple(Path(os.fsdecode(name)) for name in names),
            hashes=tuple(file["sha256"] for file in files),
            band=(float(content["band_rad_per_s"][0]), float(content["band_rad_per_s"][1])),
        )
    except (KeyError, IndexError, TypeError, ValueError, RecursionError) as error:
        raise ValueError(
            f"{path}: this is no result of this version of jaxquad: run jaxquad identify again"
        ) from error
