"""What `autopilot` found in a log: its report as text, its JSON, and the files that it writes."""

import dataclasses
import shlex
from collections import ChainMap
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from jaxquad._core import announce, Message, Number, plain_content, staged_files, write_file
from jaxquad.records import AXES
from jaxquad.records.firmware import firmware_names
from jaxquad.report import Provenance, provenance, write_json

from ._feed_forward import FeedForwardVerdict
from ._filter_bank import GyroNoise, SharedChange
from ._firmware import firmware_named
from ._flight_channels import FlownAutopilot, IdentifiedPlant
from ._identified_log import ThrottleVerdict
from ._law_check import LoopCheck
from ._page import FORWARD_STAYS, limits_text, pilot_page, PilotPage, write_pilot_page
from ._parameters import (
    change_table,
    find_parameter,
    parameter_file,
    ParameterChange,
    propose_changes,
    what_flew,
    write_parameter_files,
)
from ._rate_loops import DesignSettings, Kind, Stage, WAYS
from ._verdict import is_bounded


@dataclasses.dataclass(frozen=True)
class FilterVerdict:
    """What the search made of the filters."""

    text: str  # which freedom brought what, or why the filters stay
    flown: Mapping[str, float] = dataclasses.field(default_factory=dict)  # of those that change
    reason: str = ""  # why they change
    at_once: tuple[str, ...] = ()  # of a notch that is switched on, which has no third of the way
    gains_alone: Stage | None = None  # the best gains with the filters that flew
    shared: SharedChange | None = None

    def content(self) -> dict[str, object]:
        return {
            "text": self.text,
            "flown": dict(self.flown),
            "gains_alone": None if self.gains_alone is None else self.gains_alone._asdict(),
            "shared": None if self.shared is None else self.shared._asdict(),
        }


Search = Callable[["AutopilotProposal", Mapping[str, float]], "AutopilotProposal"]
_LIMITS = ("sensitivity", "resonance", "noise", "change")  # which no drawn plant depends on
_CURVE = "thrust_curve"
_FAR = 0.98  # of the factor by which a gain may change


def at_limit(old: Mapping[str, float], new: Mapping[str, float], change: float) -> dict[str, str]:
    """In words, which gains are at the factor within which they may `change`, or beyond it."""
    words = {}
    for name in [x for x in old if old[x] > 0 and new.get(x, 0.0) > 0]:
        factor = max(new[name] / old[name], old[name] / new[name])
        place = "at" if factor * _FAR <= change else "beyond"
        if factor >= _FAR * change:
            words[name] = f"{place} the limit of a factor of {change:g} (`change`)"
    return words


@dataclasses.dataclass(frozen=True)
class AutopilotProposal:
    """What `autopilot` found in a log, and what it proposes; `str()` is its report as text."""

    # "kept": what flew is as good. "cannot tell": the log does not show the plant or the loop. "not
    # to be flown": no gains keep the limits.
    kind: Kind
    verdict: str  # in words, and what to do
    settings: DesignSettings
    identification: IdentifiedPlant  # in the firmware's units, the gyro's filters divided out
    flown: FlownAutopilot
    reproduction: LoopCheck | None  # that loop and plant compared with the flight
    # On fresh plants: what flew, a third of the way and all of it. Empty where the log cannot tell.
    stages: tuple[Stage, ...] = ()
    new: Mapping[str, float] = dataclasses.field(default_factory=dict)  # what is proposed, if any
    filters: FilterVerdict | None = None  # what freeing them brings; None without a search
    sticks: FeedForwardVerdict | None = None  # None of a firmware whose feed-forward stays
    noise: GyroNoise | None = None  # of the gyros, where the log shows it
    throttle: ThrottleVerdict | None = None  # where gains hold, and the thrust curve, apart
    search: "Search | None" = dataclasses.field(default=None, repr=False, compare=False)

    def retuned(
        self, filters: Mapping[str, float] | None = None, /, **limits: Number
    ) -> "AutopilotProposal":
        """The search and the certificate again, within other limits, on the plants that are drawn.

        **Arguments:**

        - `filters`: new ones that another axis has changed.
        - `limits`: any of `sensitivity`, `resonance`, `noise` and `change`.

        **Raises:** ValueError where the log tells no plant to search on, and for other settings,
        which need `jq.workflows.autopilot` again.
        """
        if self.search is None:
            raise ValueError(f"there is nothing to tune again: {self.verdict}")
        if others := [name for name in limits if name not in _LIMITS]:
            raise ValueError(
                f"`{others[0]}` is no limit of the search: give one of {', '.join(_LIMITS)}, or "
                "run autopilot again"
            )
        settings = dataclasses.replace(self.settings, **limits)  # pyright: ignore[reportArgumentType]
        return self.search(dataclasses.replace(self, settings=settings), filters or {})

    @property
    def in_short(self) -> str:
        """What a pilot feels of the new gains, or did not fly; else empty."""
        if not self.new:
            flight = self.flown.flight
            if self.kind == "cannot tell" and flight is not None and flight.rests:
                return flight.rest_text.capitalize()
            return ""
        after = self.stages[-1]
        return (
            f"A gust turns it {after.rejection:.2f} times as far as with what flew; the motors get "
            f"{after.noise:.2f} times the noise"
        )

    @property
    def title(self) -> str:
        """Firmware, version and axis."""
        name, version = self.flown.firmware, ".".join(map(str, self.flown.version))
        return f"{name} {version}, rate loop of {AXES[self.flown.axis]}".replace(" ,", ",")

    @property
    def old(self) -> dict[str, float]:
        """What flew, of the gains and of filters that change."""
        angle = self.flown.angle
        around = {} if angle is None or angle.name not in self.new else {angle.name: angle.value}
        filters = {} if self.filters is None else dict(self.filters.flown)
        ahead = {} if self.sticks is None else self.sticks.flown
        return self.flown.old | ahead | filters | around

    @property
    def at_once(self) -> tuple[str, ...]:
        """Those of the new parameters that have no third of the way."""
        flight = self.flown.flight
        swings = 0.0 if flight is None else float(np.mean(flight.limited))
        if self.stages and (self.stages[1].stable < 1 or is_bounded(self.stages[0], swings)):
            return tuple(self.new)
        return () if self.filters is None else self.filters.at_once

    @property
    def shared_filters(self) -> dict[str, float]:
        """New filters that the other axes have, too."""
        if self.filters is None or not self.new:
            return {}
        rows = firmware_named(self.flown.firmware).parameters
        return {name: self.new[name] for name in self.filters.flown if rows[name].axis < 0}

    @property
    def changes(self) -> tuple[ParameterChange, ...]:
        """From what flew to the proposal."""
        new, reasons = self.new, self._reasons
        return propose_changes(
            self.flown.firmware, self.old, new, reasons=reasons, beyond=list(new)
        )

    @property
    def _reasons(self) -> dict[str, str]:
        if not self.stages:
            return {}
        before, *_, after = self.stages
        why = (
            f"effect of a step of torque {after.rejection:.2f}, command noise {after.noise:.2f} of "
            f"what flew; Ms {before.peak:.2f} -> {after.peak:.2f}"
        )
        reasons = dict.fromkeys(self.new, why)
        old = self.flown.old
        if self.sticks is not None:
            old = old | self.sticks.flown
            reasons |= dict.fromkeys(self.sticks.flown, self.sticks.reason)
        for name, text in at_limit(old, self.new, self.settings.change).items():
            reasons[name] += f"\n{text}"
        if self.filters is not None:
            reasons |= dict.fromkeys(self.filters.flown, self.filters.reason)
        if before.angle is not None and after.angle is not None:
            reasons[after.angle.parameter] = (
                f"Ms of the angle loop {before.angle.peak:.2f} -> {after.angle.peak:.2f}"
            )
        return {name: reason for name, reason in reasons.items() if name in self.new}

    def content(self) -> dict[str, object]:
        """All of it, for JSON."""
        fit = self.identification.fit
        plant: dict[str, object] = {"verdict": fit.verdict.summary}
        if fit.verdict.fitted:
            numbers = lambda values: dict(zip(fit.names, map(float, values), strict=True))
            plant |= numbers(fit.values) | {
                "standard_errors": numbers(fit.standard_errors),
                "intervals_95": {name: list(map(float, fit.interval(name))) for name in fit.names},
                "units": dict(zip(fit.names, fit.parameter_units, strict=True)),
                "band_rad_s": list(self.identification.band),
                "misfit_over_errors": float(np.sqrt(fit.chi_squared)),
            }
        part = lambda x: None if x is None else x.content()
        content = {
            "kind": self.kind,
            "verdict": self.verdict,
            "firmware": self.flown.firmware,
            "version": self.flown.version,
            "axis": AXES[self.flown.axis],
            "flown": self.flown.loop.parameters(),
            "unmodelled": self.flown.loop.unmodelled,
            "gyro_filters": self.flown.filters_text,
            "old": self.old,
            "new": dict(self.new),
            "stages": [stage.content() for stage in self.stages],
            "filters": part(self.filters),
            "feed_forward": part(self.sticks),
            "noise": part(self.noise),
            "throttle": part(self.throttle),
            "reproduction": part(self.reproduction),
            "plant": plant,
            "settings": self.settings.content(),
            "identified_with": self.identification.settings.content(),
        }
        return {key: plain_content(value) for key, value in content.items()}

    def write(self, folder: str | Path) -> list[Path]:
        """Write the page, `autopilot.json`, and parameter files: without a proposal what flew.

        **Returns:** their paths.
        """
        return _write_axes(Path(folder), self, [self])

    def __str__(self) -> str:
        flown, lines = self.flown, [self.title]
        lines += [f"  {name} = {value:.6g}" for name, value in self.old.items()]
        lines += [f"  not modelled: {text}" for text in flown.loop.unmodelled]
        lines += [f"  {flown.filters_text}"] if flown.filters_text else []
        plant = "plant up to the gyro's filters, in the firmware's units"
        lines += ["", f"{plant}:\n{self.identification.fit}"]
        again = self.reproduction
        if again is not None and again.kind == "flown":  # else the verdict says it
            lines += ["", f"flown loop: {again.verdict}"]
        if self.stages:
            relaxed, angle = self.stages[0].relaxed is not None, self.stages[0].angle
            heads = "stable   worst Ms   resonance   crossover   delay margin   torque   noise"
            heads += "   Ms held" if relaxed else ""
            heads += "" if angle is None else "   Ms angle"
            lines += ["", f"{'on fresh plants':<20} {heads}"]
            for name, stage in zip(WAYS, self.stages, strict=False):
                row = _STAGE.format(name, *stage.cells())
                row += "" if stage.relaxed is None else f" {stage.relaxed:9.2f}"
                lines.append(row + ("" if stage.angle is None else f" {stage.angle.peak:10.2f}"))
            lines += [_OF_STAGES, *([_OF_HELD] if relaxed else [])]
            if angle is not None:
                flew = "as it flew" if angle.closed else "which was open in this flight"
                which = f"{angle.parameter} {angle.value:.3g}, {flew}"
                lines.append(f"(Ms angle: of the angle loop around it, {which})")
        throttle, curve = self.throttle, None
        if throttle is not None:
            curve = throttle.curve
            lines += ["", f"throttle: {throttle.text}"]
            if throttle.gains is not None:  # without other firmwares' parameters
                names = tuple(firmware_named(x).thrust_curve or "-" for x in firmware_names())
                lines += [x for x in str(throttle.gains).splitlines() if not x.startswith(names)]
        if throttle is not None and throttle.gains is not None and self.stages:
            row = lambda name, numbers: f"{name:<20} " + " ".join(f"{x:6.2f}" for x in numbers)
            lines += ["", row("worst Ms at throttle", throttle.logged)]
            lines += [row(x, stage.peaks) for x, stage in zip(WAYS, self.stages, strict=False)]
        if self.filters is not None:
            lines += ["", f"filters: {self.filters.text}"]
        if self.sticks is not None:
            lines += ["", f"feed-forward: {self.sticks.text}"]
        if self.kind == "proposed":
            lines += ["", change_table(self.changes).rstrip(), ""]
            stays = "" if self.sticks is not None else f"; {FORWARD_STAYS}"
            lines.append(f"{limits_text(self.settings)}{stays}")
        if curve is not None:
            lines += ["", f"thrust curve: {curve.text}"]
            if curve.change is not None:
                lines += ["", change_table([curve.change]).rstrip()]
        below = "it does not determine the plant (above)"
        return "\n".join([*lines, "", Message(self.verdict).in_words(lambda summary: below)])


_STAGE = "{:<20} {:>5} % {:>9} {:>9}   {:>8} Hz {:>9} ms {:>8} {:>7}"
_OF_STAGES = """(fresh plants: drawn from what the log leaves possible, not tuned on; Ms and
resonance: peaks of |S| and of the response to the set-point; torque: the rate after a step of
torque, noise: that of the command, both over those of what flew)"""
_OF_HELD = "(Ms held: without the integral, which iterm_relax holds while the set-point moves)"


_ORDER: tuple[Kind, ...] = ("proposed", "kept", "not to be flown", "cannot tell")


@dataclasses.dataclass(frozen=True)
class AxesProposal:
    """What `autopilot` found for each axis of a log; `str()` is its report as text."""

    settings: DesignSettings
    axes: Mapping[str, AutopilotProposal]  # by the axis' name
    unread: Mapping[str, str] = dataclasses.field(default_factory=dict)  # why one is not there

    def retuned(
        self, listener: Callable[[str, AutopilotProposal], None] = lambda axis, one: None, /,
        **limits: Number,
    ) -> "AxesProposal":  # fmt: skip
        """`AutopilotProposal.retuned` of each axis that a search was made for.

        `listener` hears each of them as soon as it is there.
        """
        axes: dict[str, AutopilotProposal] = {}
        filters: Mapping[str, float] = {}
        for axis, one in self.axes.items():
            if one.search is not None:
                one = one.retuned(filters, **limits)
                listener(axis, one)
            axes[axis] = one
            filters = filters or axes[axis].shared_filters
        settings = dataclasses.replace(self.settings, **limits)  # pyright: ignore[reportArgumentType]
        return dataclasses.replace(self, settings=settings, axes=axes)

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
        new = ChainMap(*(dict(one.new) for one in self.axes.values()))
        return {name: new[name] for name in self.old if name in new}

    @property
    def old(self) -> dict[str, float]:
        """What flew of them; without a proposal what flew of all axes."""
        axes = self.axes.values()
        parts = [one.old for one in axes if one.new] or [one.old for one in axes]
        first = ChainMap(*parts)
        return {name: first[name] for part in parts for name in part}

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
        return _write_axes(Path(folder), self, [*self.axes.values()])

    def __str__(self) -> str:
        parts = [str(one) for one in self.axes.values()]
        parts += [f"{axis}: {why}" for axis, why in self.unread.items()]
        if len(self.axes) > 1:
            parts.append(f"All axes:\n{self.verdict}")
        return "\n\n".join(parts)


def _write_axes(
    folder: Path, result: AutopilotProposal | AxesProposal, axes: Sequence[AutopilotProposal]
) -> list[Path]:
    """With the thrust curve, and one parameter file of all axes for each stage."""
    flown, old, new = axes[0].flown, result.old, result.new
    firmware, version = flown.firmware, flown.version or (2025, 12)
    overview = f"{firmware} {'.'.join(map(str, flown.version))}, rate loops".strip()
    log, settings = axes[0].identification.paths[0], result.settings
    flew = what_flew(log.name)

    def write(stem: Path, changes: Sequence[ParameterChange], title: str, revert: bool) -> Path:
        text = parameter_file(
            firmware, changes, revert=revert, version=version, profile=None, title=title,
            raised=[axis for axis in AXES if f"d_max_{axis}" in old],
        )  # fmt: skip
        return write_file(stem.with_suffix(f".{firmware_named(firmware).suffix}"), text)

    def files(folder: Path) -> list[Path]:
        curves = (one.throttle.curve for one in axes if one.throttle is not None)
        written, curve = [], next((x for x in curves if x is not None and x.change), None)
        if curve is not None and curve.change is not None:  # never in a file with gains
            title = f"{curve.name} alone: all loops and the throttle at hover change with it"
            written = [
                write(folder / _CURVE, [curve.change], f"{title}; from {flew}", False),
                write(folder / f"{_CURVE}_revert", [curve.change], flew, True),
            ]
        if not new:
            rows = [(find_parameter(firmware, name), x) for name, x in old.items()]
            same = [ParameterChange(row, x, x) for row, x in rows]
            return [write(folder / "proposal_revert", same, flew, True), *written]
        parts = [one for one in axes if one.new]
        files = write_parameter_files(
            folder, firmware, old, new, beyond=list(new),
            reasons={name: x for one in reversed(parts) for name, x in one._reasons.items()},
            at_once=[name for one in parts for name in one.at_once],
            version=version, profile=None, log=log.name,
        )  # fmt: skip
        return [*files.stages, files.revert, files.table, *written]

    pages = lambda origin: [pilot_page(one, origin, overview) for one in axes]
    return write_result(folder, log, settings, result.content(), files, pages)


def write_result(
    folder: Path, log: Path, settings: DesignSettings, content: Mapping[str, object],
    files: Callable[[Path], Sequence[Path]], pages: Callable[[Provenance], Sequence[PilotPage]],
) -> list[Path]:  # fmt: skip
    """The page, the JSON with where it is from, and what `files` writes: all, or nothing."""
    announce("parameter files")
    stated = {k: v for k, v in settings.content().items() if v is not None}
    words = ["jaxquad", "autopilot", str(log), *settings.words()]
    origin = provenance(log, command=shlex.join(words), settings=stated)
    with_origin = {**content, "provenance": origin.content()}
    with staged_files(folder) as draft:
        stored, written = write_json(draft / "autopilot.json", with_origin), files(draft)
        announce("the page")
        loaded = {x.name: x.read_text(encoding="utf-8") for x in written if x.suffix != ".md"}
        page = write_pilot_page(draft / "autopilot.html", *pages(origin), files=loaded)
    return [folder / path.name for path in (page, stored, *written)]
