"""All axes of a log in one proposal: one page, one file with all of their parameters."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from jaxquad._core import announce
from jaxquad.report import write_json

from ._identified import DesignSettings
from ._page import write_pilot_page
from ._pilot_page import pilot_page
from ._proposal import AutopilotProposal
from ._proposed_parameters import ProposedParameters
from ._rate_design import Kind


_ORDER: tuple[Kind, ...] = ("proposed", "kept", "not to be flown", "cannot tell")


@dataclasses.dataclass(frozen=True)
class AxesProposal:
    """What `autopilot` found for each axis of a log; `str()` is its report as text.

    **Attributes:**

    - `axes`: an `AutopilotProposal` by the axis' name.
    - `unread`: why an axis is not among them.
    """

    settings: DesignSettings
    axes: Mapping[str, AutopilotProposal]
    unread: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def kind(self) -> Kind:
        """The best of the axes: "proposed" where one of them has gains."""
        kinds = {one.kind for one in self.axes.values()}
        return next(kind for kind in _ORDER if kind in kinds)

    @property
    def verdict(self) -> str:
        """In words, an axis each line."""
        lines = [f"{axis}: {one.verdict}" for axis, one in self.axes.items()]
        return "\n".join([*lines, *(f"{axis}: {why}" for axis, why in self.unread.items())])

    @property
    def new(self) -> dict[str, float]:
        """The proposed parameters of all axes by name."""
        return self._parameters.new

    @property
    def old(self) -> dict[str, float]:
        """What flew of them; without a proposal what flew of all axes."""
        return self._parameters.old

    @property
    def _parameters(self) -> ProposedParameters:
        parts = [one.parameters for one in self.axes.values()]
        proposed = [part for part in parts if part.new]
        return ProposedParameters.joined(proposed or parts)

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        return {
            "kind": self.kind,
            "verdict": self.verdict,
            "old": self.old,
            "new": self.new,
            "axes": {axis: one.content() for axis, one in self.axes.items()},
            "unread": dict(self.unread),
            "settings": self.settings.content(),
        }

    def write(self, folder: str | Path) -> list[Path]:
        """Write the page, `autopilot.json`, and one parameter file of all axes for each stage.

        **Returns:** their paths.
        """
        announce("parameter files")
        folder, first = Path(folder), next(iter(self.axes.values()))
        origin = first.provenance(self.settings)
        stored = write_json(
            folder / "autopilot.json", self.content() | {"provenance": origin.content()}
        )
        curves = (one.write_curve(folder) for one in self.axes.values())
        curve = next((paths for paths in curves if paths), [])
        files = self._parameters.write(folder)
        announce("the page")
        flown = first.flown
        overview = f"{flown.firmware} {'.'.join(map(str, flown.version))}, rate loops".strip()
        pages = [pilot_page(one, origin, overview) for one in self.axes.values()]
        page = write_pilot_page(folder / "autopilot.html", *pages)
        return [page, stored, *curve, *files]

    def __str__(self) -> str:
        parts = [str(one) for one in self.axes.values()]
        parts += [f"{axis}: {why}" for axis, why in self.unread.items()]
        if len(self.axes) > 1:
            parts.append(f"All axes:\n{self.verdict}")
        return "\n\n".join(parts)
