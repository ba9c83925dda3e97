"""What a design was shown to do on fresh members, and how that is printed."""

from collections.abc import Mapping
from typing import NotRequired, TypedDict

import equinox as eqx
import jax
import numpy as np
from jaxtyping import ArrayLike, Float, PyTree

from jaxquad.control import LADRC

from ._design_result import DesignResult, DesignSummary, Distance, summarise_design
from ._quantities import QUANTITIES


class Provenance(TypedDict):
    """What a certificate was made from."""

    members: int
    fresh: bool  # drawn for the certificate
    sampling: str  # "random", or "given" for members that the caller drew
    key: list[int] | None
    precision: str
    ensemble: list[str] | None
    device: str
    versions: dict[str, str]
    controller: NotRequired[dict[str, object]]


_NAMED = (
    "itae", "overshoot", "sensitivity_peak", "gain_margin", "gain_reduction", "phase_margin",
    "delay_margin",
)  # fmt: skip


def member_text(certificate: "Certificate", index: int) -> str:
    """The parameters of one member; values of different axes have slashes between them."""
    known = certificate.member(index)
    J = known["inertia"]
    parts = [f"J {_joined(J)} kg m^2"]
    if certificate.nominal is not None:
        parts[0] += f" = {_joined(J / certificate.nominal)} J0"
    if "lag" in known:
        parts.append(f"lag {_joined(1e3 * known['lag'])} ms")
    parts.append(f"KT {_joined(known['torque_gain'])}")
    if np.any(certificate.facts["delay"] > 0):
        parts.append(f"delay {_joined(1e3 * known['delay'])} ms")
    if not np.allclose(known["assumed_inertia"], 1):
        parts.append(f"scheduled at {_joined(known['assumed_inertia'])} J")
    return f"member {index}: {', '.join(parts)}"


def worst_lines(certificate: "Certificate") -> list[str]:
    """The worst value of each quantity and its member; a member is named once."""
    by_member: dict[int, list[str]] = {}
    for quantity in _NAMED:
        if quantity not in certificate.design.by_axis:
            continue
        worst = certificate.design.worst_member(quantity)
        if worst is not None:
            value = certificate.design.of(quantity)[worst]
            text = f"{QUANTITIES[quantity].title} {QUANTITIES[quantity].text(value)}"
            by_member.setdefault(worst, []).append(text)
    return [f"{', '.join(what)}: {member_text(certificate, k)}" for k, what in by_member.items()]


def _joined(values: Float[np.ndarray, "..."]) -> str:
    texts = [f"{x:.3g}" for x in np.atleast_1d(values)]
    return texts[0] if len(set(texts)) == 1 else "/".join(texts)


# Title, unit, quantity and statistic of each line of the table.
_LINES = (
    ("ITAE, deg s^2", "mean", "itae", "mean"),
    ("", "p95", "itae", "p95"),
    ("", "worst", "itae", "worst"),
    ("overshoot, %", "mean", "overshoot", "mean"),
    ("", "worst", "overshoot", "worst"),
    ("slowest pole, 1/s", "worst", "abscissa", "worst"),
    ("Ms", "mean", "sensitivity_peak", "mean"),
    ("", "worst", "sensitivity_peak", "worst"),
    ("gain margin, dB", "up, worst", "gain_margin", "worst"),
    ("", "down, worst", "gain_reduction", "worst"),
    ("phase margin, deg", "worst", "phase_margin", "worst"),
    ("delay margin, ms", "worst", "delay_margin", "worst"),
    ("activity, u^2/s", "mean", "activity_rate", "mean"),
    ("saturated, %", "mean", "saturation_share", "mean"),
    ("disturbance err., N m", "mean", "disturbance_rmse", "mean"),
)  # fmt: skip
_FIRST = 34


def describe(certificate: "Certificate") -> str:
    """The verdict, the limits, the designs side by side, the worst members, and the remarks."""
    lines = [verdict(certificate)]
    lines += [f"  {distance}" for distance in certificate.distances]
    lines += _table(certificate.summaries)
    lines += [f"  worst members of {certificate.name}:"]
    lines += [f"    {line}" for line in worst_lines(certificate)]
    lines += [f"  ! {remark}" for remark in certificate.remarks]
    return "\n".join([*lines, f"  {_provenance(certificate.provenance)}"])


def verdict(certificate: "Certificate") -> str:
    """One line: whether the certificate holds, or what fails first and by how much."""
    on = f"{certificate.members} {'fresh ' * certificate.provenance['fresh']}members"
    if certificate.holds:
        count = len(certificate.distances)
        met = ("", ", the limit is met")[count] if count < 2 else f", all {count} limits are met"
        return f"CERTIFICATE HOLDS on {on}: none is unstable{_proven(certificate)}{met}"
    first, *others = _failures(certificate)
    more = f"; and {len(others)} more" if others else ""
    return f"CERTIFICATE FAILS on {on}: {first}{more}"


def _proven(certificate: "Certificate") -> str:
    bound = certificate.summaries[certificate.name].unstable_at_most
    return (
        "" if bound is None else f" (proven: at most {100 * bound:.2g} % of all, 95 % confidence)"
    )


def _failures(certificate: "Certificate") -> list[str]:
    design, found = certificate.design, []
    if design.unstable is None:
        found.append("the controller has no method linear(), so its stability is not known")
    elif design.unstable.any():
        found.append(_count(design.unstable, "linearly unstable", certificate))
    if design.diverged.any():
        found.append(_count(design.diverged, "diverged in flight", certificate))
    if design.observer_instability:
        found.append(design.observer_instability)
    missed = [distance for distance in certificate.distances if not distance.met]
    for distance in sorted(missed, key=lambda d: -np.inf if np.isnan(d.percent) else d.percent):
        where = "" if distance.member is None else member_text(certificate, distance.member)
        found.append(f"{distance}{f' ({where})' if where else ''}")
    return found


def _count(which: np.ndarray, what: str, certificate: "Certificate") -> str:
    count, first = int(which.sum()), int(np.argmax(which))
    worst = certificate.design.worst_member("abscissa")  # None without a linear form
    where = member_text(certificate, first if worst is None or not which[worst] else worst)
    return f"{count} of {which.size} ({count / which.size:.1%}) {what} ({where})"


def _table(rows: dict[str, DesignSummary]) -> list[str]:
    widths = {name: max(len(name), 7) + 3 for name in rows}
    head = " " * (_FIRST + 2) + "".join(f"{name:>{widths[name]}}" for name in rows)
    lines = [head, *_counts(rows, widths)]
    for title, which, quantity, statistic in _LINES:
        cells = "".join(
            f"{_cell(row, quantity, statistic):>{widths[name]}}" for name, row in rows.items()
        )
        lines.append(f"  {title:<22}{which:<12}{cells}")
    return lines


def _counts(rows: dict[str, DesignSummary], widths: dict[str, int]) -> list[str]:
    share = lambda x: "n/a" if x is None else f"{100 * x:.3g}"
    values = {
        ("unstable, %", "found"): [
            None if row.unstable is None else row.unstable / row.members for row in rows.values()
        ],
        ("", "at most"): [row.unstable_at_most for row in rows.values()],
        ("diverged, %", ""): [row.diverged / row.members for row in rows.values()],
    }
    return [
        f"  {title:<22}{which:<12}"
        + "".join(f"{share(x):>{w}}" for x, w in zip(numbers, widths.values(), strict=True))
        for (title, which), numbers in values.items()
    ]


def _cell(row: DesignSummary, quantity: str, statistic: str) -> str:
    linear = QUANTITIES[quantity].linear and quantity != "abscissa"
    unknown = linear and row.unstable
    if unknown or quantity not in row.statistics:
        return "n/a"
    return QUANTITIES[quantity].text(row.statistics[quantity]._asdict()[statistic], unit=False)


def _provenance(known: Provenance) -> str:
    versions = ", ".join(f"{name} {version}" for name, version in known["versions"].items())
    return f"{known['members']} members, {known['sampling']}, key {known['key']}; {versions}"


# No b0 stabilises a LADRC beyond this lag times wc, by wo / wc: docs/control.md.
_RATIOS, _ENDS = (3.0, 5.0, 10.0), (0.48, 0.44, 0.42)


def lag_remark(
    controller: PyTree, delay: ArrayLike, lag: Float[ArrayLike, "..."] | None
) -> str | None:
    """Compare lag times wc of a LADRC with the most that any b0 stabilises; None for others."""
    ladrc = _find_ladrc(controller)
    if lag is None or ladrc is None:
        return None
    wc, wo = float(np.max(np.asarray(ladrc.wc))), float(np.max(np.asarray(ladrc.wo)))
    longest, late = float(np.max(np.asarray(lag))), float(np.max(np.asarray(delay)))
    end = float(np.interp(np.log(wo / wc), np.log(_RATIOS), _ENDS))
    text = f"lag x wc is up to {1e3 * longest:.3g} ms x {wc:.3g} rad/s = {longest * wc:.2g}"
    if late:
        text += f", {(longest + late) * wc:.2g} with the delay of {1e3 * late:.3g} ms"
    if longest * wc >= end:
        return (
            f"{text}: too large, no b0 stabilises a LADRC beyond about {end:.2g} at wo/wc = "
            f"{wo / wc:.3g}. Reduce wc below {end / longest:.3g} rad/s"
        )
    return (
        f"{text}; no b0 stabilises a LADRC beyond about {end:.2g} at wo/wc = {wo / wc:.3g}, and "
        "margins end long before that. Reduce wc to recover margin"
    )


def _find_ladrc(controller: PyTree) -> LADRC | None:
    is_ladrc = lambda x: isinstance(x, LADRC)
    return next(filter(is_ladrc, jax.tree.leaves(controller, is_leaf=is_ladrc)), None)


class Certificate(eqx.Module):
    """What a design was shown to do on members of an ensemble that its tuner never saw.

    It `holds` if no member is linearly unstable (by the exact poles), none diverged in flight, no
    observer is unstable by itself (it would run away in saturation), and every limit is met. The
    first line of `str()` says so, or what failed, by how much and in which member. None unstable of
    n members drawn at random proves a share: at most 1.2 % with 95 % confidence for n = 256
    (Clopper-Pearson), and no more than that.

    The first of the `designs` is the one that is certified; the others are its peers on the same
    members and noise. Numbers of the linear loop leave out members that are unstable, which
    `summaries` counts. Of several axes each member counts by its worst one, except for the
    integrals in `summaries`, which are sums. Numbers are in SI units, those in print in degrees.
    """

    designs: dict[str, DesignResult]  # by name; what is certified comes first
    distances: tuple[Distance, ...]  # to each limit
    # inertia, torque_gain, lag and delay in SI units; assumed_inertia over the true one
    facts: dict[str, Float[np.ndarray, "axes members"]]
    nominal: Float[np.ndarray, " axes"] | None  # inertia, kg m^2; None if it is not known
    provenance: Provenance
    remarks: tuple[str, ...]

    @property
    def name(self) -> str:
        """The name of the design that is certified."""
        return next(iter(self.designs))

    @property
    def design(self) -> DesignResult:
        """The numbers of the design that is certified."""
        return self.designs[self.name]

    @property
    def members(self) -> int:
        """How many members there are."""
        return self.design.members

    @property
    def stable(self) -> bool:
        """No member is linearly unstable, none diverged, and no observer is unstable by itself."""
        design, observer = self.design, self.design.observer_instability
        return design.unstable_count == 0 and not design.diverged.any() and not observer

    @property
    def holds(self) -> bool:
        """Whether the design is stable on all members and meets every limit."""
        return self.stable and all(distance.met for distance in self.distances)

    @property
    def independent(self) -> bool:
        """Whether the members were drawn independently, as a confidence bound presumes."""
        return self.provenance["sampling"] == "random"

    @property
    def summaries(self) -> dict[str, DesignSummary]:
        """Statistics of each design over the members."""
        known = self.independent
        return {name: summarise_design(x, independent=known) for name, x in self.designs.items()}

    def member(self, index: int) -> dict[str, Float[np.ndarray, " axes"]]:
        """The parameters of one member, per axis, in SI units."""
        return {name: values[:, index] for name, values in self.facts.items()}

    def content(self) -> dict[str, object]:
        """Everything, arrays per member included, for `jaxquad.report.write_json`."""
        return {
            "certificate": verdict(self),
            "holds": self.holds,
            "provenance": self.provenance,
            "limits": [distance._asdict() | {"met": distance.met} for distance in self.distances],
            "designs": {name: row.content() for name, row in self.summaries.items()},
            "remarks": self.remarks,
            "members": self.facts | {"nominal_inertia": self.nominal},
            "per_member": {name: _arrays(design) for name, design in self.designs.items()},
        }

    def __str__(self) -> str:
        return describe(self)


def _arrays(design: DesignResult) -> Mapping[str, object]:
    flags = {"unstable": design.unstable, "diverged": design.diverged}
    return flags | {name: design.of(name) for name in design.by_axis}
