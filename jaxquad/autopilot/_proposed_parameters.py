"""The parameters of a proposal as files: in stages, all of it, and what flew."""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxquad._core import write_file
from jaxquad.records import AXES

from ._files import parameter_file, ParameterChange, propose_changes, write_parameter_files
from ._firmware import firmware_named
from ._parameters import find_parameter


_THIRD, _ALL = 1 / 3, 1.0
_STEM = "proposal"


@dataclasses.dataclass(frozen=True)
class ProposedParameters:
    """Old and new values by the firmware's names, of one axis or of all.

    **Attributes:**

    - `old`: what flew; `new`: what is proposed, empty where nothing is.
    - `reasons`: for each new one; `at_once`: those that have no third of the way.
    """

    firmware: str
    version: tuple[int, ...]
    old: dict[str, float]
    new: dict[str, float] = dataclasses.field(default_factory=dict)
    reasons: Mapping[str, str] = dataclasses.field(default_factory=dict)
    at_once: tuple[str, ...] = ()

    @classmethod
    def joined(cls, parts: Sequence["ProposedParameters"]) -> "ProposedParameters":
        """Of several axes; what they share is the first one's."""
        first, old, new, reasons = parts[0], {}, {}, {}
        for part in reversed(parts):
            old, new, reasons = old | part.old, new | part.new, reasons | dict(part.reasons)
        at_once = tuple(dict.fromkeys(name for part in parts for name in part.at_once))
        order = {name: None for part in parts for name in part.old}
        in_order = lambda values: {name: values[name] for name in order if name in values}
        return cls(first.firmware, first.version, in_order(old), in_order(new), reasons, at_once)

    @property
    def changes(self) -> tuple[ParameterChange, ...]:
        """From what flew to the proposal."""
        return propose_changes(
            self.firmware, self.old, self.new, reasons=self.reasons, beyond=list(self.new)
        )

    def write(self, folder: Path) -> list[Path]:
        """A third of the way, all of it, what reverts them and a table; or what flew alone."""
        if not self.new:
            same = [
                ParameterChange(find_parameter(self.firmware, name), value, value)
                for name, value in self.old.items()
            ]
            return [self.write_one(f"{_STEM}_revert", same, "what flew", folder, revert=True)]
        files = write_parameter_files(
            folder, self.firmware, self.old, self.new, stem=_STEM, shares=(_THIRD, _ALL),
            reasons=self.reasons, beyond=list(self.new), version=self.version or (2025, 12),
            at_once=self.at_once, profile=None,
        )  # fmt: skip
        return [*files.stages, files.revert, files.table]

    def write_one(
        self, stem: str, changes: Sequence[ParameterChange], title: str, folder: Path, *,
        revert: bool,
    ) -> Path:  # fmt: skip
        """One file with these changes, or with what they were."""
        raised = [axis for axis in AXES if f"d_max_{axis}" in self.old]
        text = parameter_file(
            self.firmware, changes, revert=revert, version=self.version or (2025, 12),
            raised=raised, title=title, profile=None,
        )  # fmt: skip
        return write_file(folder / f"{stem}.{firmware_named(self.firmware).suffix}", text)
