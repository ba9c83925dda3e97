"""What a proposal needs of an identified log and of its settings, which `workflows` makes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from jaxquad.identify import Fit
from jaxquad.records import Record


Pair = tuple[float, float]


@runtime_checkable
class RecordSettings(Protocol):
    """Which part of a log is identified, in s, and in which band, in Hz; None: all of it."""

    @property
    def segments(self) -> Sequence[Pair]: ...
    @property
    def start(self) -> float | None: ...
    @property
    def stop(self) -> float | None: ...
    @property
    def band(self) -> Pair | None: ...
    def content(self) -> dict[str, Any]: ...


@runtime_checkable
class IdentifiedPlant(Protocol):
    """A log's plant up to what the gyro's filters are given, as `jq.workflows.identify` has it."""

    @property
    def path(self) -> Path: ...
    @property
    def settings(self) -> RecordSettings: ...
    @property
    def records(self) -> tuple[Record, ...]: ...
    @property
    def fit(self) -> Fit: ...
    @property
    def band(self) -> Pair: ...  # rad/s


@runtime_checkable
class DesignSettings(Protocol):
    """What is kept, and how many plants: `jq.workflows.AutopilotSettings`."""

    @property
    def sensitivity(self) -> float: ...
    @property
    def resonance(self) -> float: ...
    @property
    def noise(self) -> float: ...
    @property
    def change(self) -> float: ...
    @property
    def keep_filters(self) -> bool: ...
    @property
    def members(self) -> int: ...
    @property
    def fresh(self) -> int: ...
    @property
    def seed(self) -> int: ...
    def content(self) -> dict[str, Any]: ...
    def words(self) -> list[str]: ...
