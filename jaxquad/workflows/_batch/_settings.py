"""Settings of a batch: which logs, how each of them is identified, and by how many processes."""

import dataclasses
from collections.abc import Mapping, Sequence
from fnmatch import fnmatchcase
from typing import NamedTuple

from .. import _kinds as kinds
from .._kinds import convert, SettingsError, Value
from .._settings import (
    check_keys,
    IdentifySettings,
    Option,
    option_field,
    REPLACED,
    S,
    Settings,
    updated,
    within_file,
)


class Override(NamedTuple):
    """Settings of the logs whose paths match one of the patterns."""

    logs: tuple[str, ...]
    changes: Mapping[str, object]


_ONE_LOG = ("verify", "verify_start", "verify_stop")
_EVERY_LOG = ("**/*",)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BatchSettings(Settings):
    """Which logs of a folder are identified, how each of them, and by how many processes.

    In TOML the keys of `identify` stand beside the others, and each override is a table
    `[[override]]` with `logs` and the keys that it changes.

    **Raises:** `SettingsError` (a ValueError) for values that cannot be.

    !!! example

        ```python
        settings = jq.workflows.BatchSettings(
            logs="**/*.ulg",
            identify={"band": (0.7, 12), "integrators": 1},
            overrides=[jq.workflows.Override(("flight_07*",), {"stop": 80})],
        )
        ```
    """

    logs: str | Sequence[str] = option_field(
        kinds.PATTERNS,
        _EVERY_LOG,
        "file patterns below the folder; by default every file but hidden ones",
    )
    timeout: float | None = option_field(
        kinds.DURATION,
        None,
        "limit for one log, which has failed if it takes longer; 1800 by default, "
        "none with a scheduler",
    )
    workers: int | None = option_field(
        kinds.SIZE, None, "processes of this machine; by default one for each core"
    )
    scheduler: str | None = option_field(
        kinds.ADDRESS,
        None,
        "of a Dask cluster that sees the same files, such as tcp://10.0.0.1:8786",
    )
    identify: IdentifySettings | Mapping[str, object] = dataclasses.field(default_factory=dict)
    overrides: Sequence[Override] = ()

    @classmethod
    def options(cls) -> dict[str, Option]:
        names = ("logs", "timeout", "workers", "scheduler")
        fields = {field.name: field for field in dataclasses.fields(cls)}
        found = {name: fields[name].metadata["option"] for name in names}
        return {name: each._replace(flag=f"--{name}") for name, each in found.items()}

    @classmethod
    def from_mapping(cls: type[S], content: Mapping[str, object], where: str = "") -> S:
        keys = [*cls.options(), *_LOG_KEYS]
        try:
            check_keys(content, [*keys, "override"])
            tables = content.get("override", [])
            if not isinstance(tables, list) or not all(isinstance(t, dict) for t in tables):
                raise SettingsError("`override` is no list of tables: write [[override]]")
            found: dict[str, Value] = {k: content[k] for k in content if k in cls.options()}
            found["identify"] = {key: content[key] for key in content if key in _LOG_KEYS}
            found["overrides"] = [_override(k, table) for k, table in enumerate(tables, start=1)]
            return cls(**found)
        except SettingsError as error:
            raise within_file(where, error) from error

    def __post_init__(self):
        super().__post_init__()
        object.__setattr__(self, "identify", _checked(self._common))
        object.__setattr__(self, "overrides", tuple(Override(*each) for each in self.overrides))
        if self.timeout is not None and self.scheduler is not None:
            raise SettingsError(
                "`timeout` is for processes of this machine: leave it out with `scheduler`"
            )

    @property
    def _common(self) -> Mapping[str, object]:
        common = self.identify
        return common.given() if isinstance(common, IdentifySettings) else common

    def changed(self: S, changes: Mapping[str, object]) -> S:
        return dataclasses.replace(self, **changes)  # pyright: ignore[reportArgumentType]

    def of(self, log: str) -> IdentifySettings:
        """The settings of one log, by its path below the folder.

        Later overrides change earlier ones. A key that says the same in another way takes the
        place of the other: `segments` that of `start` and `stop`, `band` that of `band_rad`.

        **Raises:** `SettingsError` for settings that exclude each other.
        """
        found = self._common
        for patterns, changes in self.overrides:
            if any(fnmatchcase(log, pattern) for pattern in patterns):
                found = updated(found, changes)
        return IdentifySettings.from_mapping(found, f"settings of {log}")


_LOG_KEYS = tuple(key for key in IdentifySettings.options() if key not in _ONE_LOG)


def _override(k: int, table: Mapping[str, object]) -> Override:
    try:
        check_keys(table, [*_LOG_KEYS, "logs"])
        if "logs" not in table:
            raise SettingsError('`logs` is missing: add logs = "flight_07*"')
        patterns = convert("logs", kinds.PATTERNS, table["logs"])
        return Override(patterns, _checked({k: v for k, v in table.items() if k != "logs"}))
    except SettingsError as error:
        raise SettingsError(f"override {k}: {error}") from error


def _checked(content: Mapping[str, object]) -> dict[str, object]:
    """The values converted; whether they go together is known once overrides are applied."""
    check_keys(content, _LOG_KEYS)
    options = IdentifySettings.options()
    found = {key: convert(key, options[key].kind, value) for key, value in content.items()}
    for key, others in REPLACED.items():
        if key in found and any(other in found for other in others):
            clash = next(other for other in others if other in found)
            raise SettingsError(f"`{key}` and `{clash}` are both given: keep one")
    return found
