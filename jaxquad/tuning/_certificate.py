"""What a design was shown to do on fresh members, and how that is printed."""

import functools as ft
from collections.abc import Iterable
from typing import NotRequired, TypedDict

import equinox as eqx
import jax
import numpy as np
from jaxtyping import ArrayLike, Float, PyTree

from jaxquad.control import LADRC

from ._design_result import (
    DesignResult,
    DesignSummary,
    LinearMembers,
    summarise_design,
    upper_bound,
)
from ._objective import QUANTITIES
from ._verdict import (
    Attainable,
    Distance,
    joined,
    judge_performance,
    judge_stability,
    Verdict,
)


class Provenance(TypedDict):
    """What a certificate was made from."""

    members: int
    linear_members: int  # further ones, which do not fly
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
    facts = certificate.member(index)
    J = facts["inertia"]
    parts = [f"J {_joined(J)} kg m^2"]
    if certificate.nominal is not None:
        parts[0] += f" = {_joined(J / certificate.nominal)} J0"
    if "lag" in facts:
        parts.append(f"lag {_joined(1e3 * facts['lag'])} ms")
    parts.append(f"KT {_joined(facts['torque_gain'])}")
    if np.any(certificate.facts["delay"] > 0):
        parts.append(f"delay {_joined(1e3 * facts['delay'])} ms")
    if not np.allclose(facts["assumed_inertia"], 1):
        parts.append(f"scheduled at {_joined(facts['assumed_inertia'])} J")
    return f"member {index}: {', '.join(parts)}"


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


def _table(rows: dict[str, DesignSummary]) -> list[str]:
    """A column for each design: shares of members first, then the statistics of `_LINES`."""
    widths = {name: max(len(name), 7) + 3 for name in rows}

    def line(title: str, which: str, cells: Iterable[str]) -> str:
        columns = "".join(f"{x:>{w}}" for x, w in zip(cells, widths.values(), strict=True))
        return f"  {title:<22}{which:<12}{columns}"

    def statistic(row: DesignSummary, quantity: str, which: str) -> str:
        linear = QUANTITIES[quantity].linear and quantity != "abscissa"
        if (linear and row.unstable) or quantity not in row.statistics:
            return "n/a"
        value = row.statistics[quantity]._asdict()[which]
        return QUANTITIES[quantity].text(value, unit=False)

    share = lambda x: "n/a" if x is None else f"{100 * x:.3g}"
    unstable = [None if x.unstable is None else x.unstable / x.members for x in rows.values()]
    at_most = [x.unstable_at_most for x in rows.values()]
    return [
        line("", "", rows),
        line("unstable, %", "found", map(share, unstable)),
        line("", "at most", map(share, at_most)),
        line("diverged, %", "", [share(x.diverged / x.members) for x in rows.values()]),
        line("lost, %", "", [share(x.lost / x.members) for x in rows.values()]),
        *(line(a, b, [statistic(x, q, s) for x in rows.values()]) for a, b, q, s in _LINES),
    ]


# No b0 stabilises a LADRC beyond this lag times wc, by wo / wc: docs/control.md.
_RATIOS, _ENDS = (3.0, 5.0, 10.0), (0.48, 0.44, 0.42)


def lag_remark(
    controller: PyTree, delay: ArrayLike, lag: Float[ArrayLike, "..."] | None
) -> str | None:
    """Compare lag times wc of a LADRC with the most that any b0 stabilises; None for others."""
    ladrc = find_ladrc(controller)
    if lag is None or ladrc is None:
        return None
    wc, wo = float(np.max(np.asarray(ladrc.wc))), float(np.max(np.asarray(ladrc.wo)))
    longest, late = float(np.max(np.asarray(lag))), float(np.max(np.asarray(delay)))
    end = float(np.interp(np.log(wo / wc), np.log(_RATIOS), _ENDS))
    text = f"lag x wc is up to {1e3 * longest:.3g} ms x {wc:.3g} rad/s = {longest * wc:.2g}"
    if late:
        text += f", {(longest + late) * wc:.2g} with the delay of {1e3 * late:.3g} ms"
    most = f"no b0 stabilises a LADRC beyond about {end:.2g} at wo/wc = {wo / wc:.3g}"
    if longest * wc >= end:
        return f"{text}: too large, {most}. Reduce wc below {end / longest:.3g} rad/s"
    return f"{text}; {most}, and margins end long before that. Reduce wc to recover margin"


def find_ladrc(controller: PyTree) -> LADRC | None:
    """The LADRC that a controller is made of, scheduled or not; None for others."""
    is_ladrc = lambda x: isinstance(x, LADRC)
    return next(filter(is_ladrc, jax.tree.leaves(controller, is_leaf=is_ladrc)), None)


class Certificate(eqx.Module):
    """What a design was shown to do on members of an ensemble that its tuner never saw.

    Three verdicts, each with the numbers and with what to do:

    - `stability`: no member is linearly unstable (by the exact poles), none diverged in flight, no
        observer is unstable by itself (it would run away in saturation), and every limit is met.
    - `performance`: every member stays in the range of the model, and makes less than half the
        error of doing nothing (the command 0) and less than twice that of its linear loop; the
        drive holds the disturbance, the encoder tells the manoeuvre, the command is at its limit
        for less than a quarter of the time and not ten times as busy as at the start, and wc and wo
        lie within the identified band. It is not decided on fewer than 64 members, or without
        spread.
    - `convergence`: the tuning ended at a stationary point; not asked of gains that were given.

    It `holds` if none of them fails, and `str()` begins with them. None of n members drawn at
    random proves a share: with 95 % confidence at most 1.2 % of all for the 256 that fly, 0.13 %
    for the linear loops of these and of 2048 further members (Clopper-Pearson), and no more than
    that. Each verdict and each limit says what its share covers. Likewise the worst of n members
    is no bound: at most that share of all goes beyond it.

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
    idle: DesignResult  # the same flights with the command 0
    start: DesignResult | None = None  # with the gains that the tuning started from
    error: str = eqx.field(static=True, default="itae")  # by which performance is measured
    convergence: Verdict = Verdict("CONVERGENCE", None, "the gains were given, not tuned here")
    further: LinearMembers | None = None  # of whom the linear loop alone was analysed
    attainable: Attainable | None = None  # what the same plants allow
    unsupported: tuple[tuple[str, str], ...] = ()  # bandwidths beyond the band; what to do

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
        """How many members flew."""
        return self.design.members

    @property
    def stable(self) -> bool:
        """No member is linearly unstable, none diverged, and no observer is unstable by itself."""
        design, observer = self.design, self.design.observer_instability
        tail = 0 if self.further is None else self.further.design.unstable_count
        return not (design.unstable_count != 0 or tail or design.diverged.any() or observer)

    @property
    def stability(self) -> Verdict:
        """Whether all members are stable and within the limits."""
        place = lambda index: member_text(self, index)
        return judge_stability(self.design, self.distances, self.further, self.independent, place)

    @property
    def performance(self) -> Verdict:
        """Whether the design is of use, against doing nothing and beside its start."""
        return judge_performance(self)

    @property
    def verdicts(self) -> tuple[Verdict, Verdict, Verdict]:
        """Stability, performance and convergence."""
        return self.stability, self.performance, self.convergence

    @property
    def holds(self) -> bool:
        """Whether no verdict fails and performance is decided: only then it may be flown."""
        return self.performance.holds is True and False not in [x.holds for x in self.verdicts]

    @property
    def independent(self) -> bool:
        """Whether the members were drawn independently, as a confidence bound presumes."""
        return self.provenance["sampling"] == "random"

    @property
    def summaries(self) -> dict[str, DesignSummary]:
        """Statistics of each design over the members."""
        summarise = ft.partial(summarise_design, independent=self.independent)
        return {name: summarise(design) for name, design in self.designs.items()}

    def member(self, index: int) -> dict[str, Float[np.ndarray, " axes"]]:
        """The parameters of one member, per axis, in SI units; further ones follow those flown."""
        facts = self.facts
        if index >= self.members and self.further is not None:
            facts, index = self.further.facts, index - self.members
        return {name: values[:, index] for name, values in facts.items()}

    def content(self) -> dict[str, object]:
        """Everything, arrays per member included, for `jaxquad.report.write_json`."""
        baselines = {"doing nothing": self.idle}
        baselines |= {} if self.start is None else {"start": self.start}
        summarise = ft.partial(summarise_design, independent=self.independent)
        return {
            "certificate": self._headline,
            "holds": self.holds,
            "verdicts": [verdict._asdict() for verdict in self.verdicts],
            "provenance": self.provenance,
            "limits": [distance.content() for distance in self.distances],
            "designs": {name: row.content() for name, row in self.summaries.items()},
            "baselines": {name: summarise(x).content() for name, x in baselines.items()},
            "attainable": None if self.attainable is None else self.attainable._asdict(),
            "error": self.error,
            "remarks": self.remarks,
            "members": self.facts | {"nominal_inertia": self.nominal},
            "per_member": {name: design.content() for name, design in self.designs.items()},
            "further": None if self.further is None else self.further.content(),
        }

    @property
    def _headline(self) -> str:
        """Whether the design may be flown, or which of the three verdicts fails."""
        on = f"{self.members} {'fresh ' * self.provenance['fresh']}members"
        if self.further is not None:
            on += f" ({self.members + self.further.design.members} linear loops)"
        failed = [v.name for v in self.verdicts if v.holds is False]
        if failed:
            return f"CERTIFICATE FAILS on {on}, not to be flown: {joined(failed)}"
        if self.performance.holds is None:
            return f"CERTIFICATE OPEN on {on}, not to be flown: PERFORMANCE is not decided"
        holding = [v.name for v in self.verdicts if v.holds is not None]
        return f"CERTIFICATE HOLDS on {on}: {joined(holding)}"

    def __str__(self) -> str:
        lines = [self._headline, *(f"  {verdict}" for verdict in self.verdicts)]
        lines += [f"  ! {remark}" for remark in self.remarks]
        lines += [f"  {distance}" for distance in self.distances]
        lines += _table(self.summaries)
        if self.independent:
            most = 100 * upper_bound(0, self.members)
            lines.append(
                f"  worst: of {self.members} members; at most {most:.2g} % of all are beyond it "
                "(95 % confidence)"
            )
        lines += [f"  worst members of {self.name}:"]
        by_member: dict[int, list[str]] = {}  # each is named once
        for name in _NAMED:
            worst = self.design.worst_member(name) if name in self.design.by_axis else None
            if worst is not None:
                shown, value = QUANTITIES[name], self.design.of(name)[worst]
                by_member.setdefault(worst, []).append(f"{shown.title} {shown.text(value)}")
        lines += [f"    {', '.join(x)}: {member_text(self, k)}" for k, x in by_member.items()]
        source = self.provenance
        versions = ", ".join(f"{name} {version}" for name, version in source["versions"].items())
        loops = f" and {source['linear_members']} linear loops" if source["linear_members"] else ""
        count = f"{source['members']} members{loops}"
        lines.append(f"  {count}, {source['sampling']}, key {source['key']}; {versions}")
        return "\n".join(lines)
